"""The rasterizer of the simulated reality against rays cast one by one, and against the film's renderer."""

# mypy: disable-error-code="valid-type"

from dataclasses import replace

import cv2
import numpy as np
import pytest
import warp as wp

from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.images import psnr
from twin.geometry.mesh_rays import Surface
from twin.reality import campus_road, filming, true_world
from twin.reality.rasterizer import SAMPLES, Rasterizer, ShadowMap, flatten, render_shadow_map, sun_visibility

PLAN = replace(filming.FilmingPlan(), width=160, height=90)


@pytest.fixture(scope="module")
def campus():
    return campus_road.build()


@pytest.fixture(scope="module")
def sunny(campus):
    return true_world.world_spec("sun", campus).compile()


def robot_poses(campus, lighting="sun", every=40):
    """The poses of the film's camera, lowered to a robot's height."""
    poses = filming.trajectory(filming.FilmingPlan(), campus.route, lighting)[1][::every].copy()
    poses[:, 2, 3] -= 0.6
    return poses


def test_depth_is_that_of_rays(campus, sunny):
    """The depth of a pixel's first sample is that of a ray through it; it is sky where the ray hits nothing."""
    raster, flat = Rasterizer(sunny, PLAN.intrinsics, (160, 90)), flatten(sunny)
    surface = Surface(flat.corners.reshape(-1, 3).astype(float), np.arange(3 * len(flat.corners)).reshape(-1, 3))
    first = (pixel_grid(160, 90) - 0.5 + 0.5 / SAMPLES).reshape(-1, 2)
    for pose in robot_poses(campus):
        rays = unproject(first, PLAN.intrinsics)
        depth = raster(pose)[1].ravel()
        cast = surface.cast(np.repeat(pose[None, :3, 3], len(rays), 0), rays @ pose[:3, :3].T)
        assert np.mean((depth == 0.0) == (cast < 0.0)) > 0.9995
        both = (depth > 0.0) & (cast > 0.0)
        assert both.mean() > 0.5
        assert np.mean(np.abs(depth - cast)[both] < 1e-3 + 1e-4 * cast[both]) > 0.998  # leaves' edges


@wp.kernel
def _ask(shadows: ShadowMap, points: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    out[i] = sun_visibility(shadows, points[i], wp.vec3(0.0, 0.0, 1.0))


def test_shadows_are_where_rays_to_the_sun_are_blocked(campus, sunny):
    flat = flatten(sunny)
    station, lateral = np.meshgrid(np.linspace(0, 60, 400), np.linspace(-7.0, 7.0, 80))
    xy = campus.route.at(station, lateral).reshape(-1, 2)
    ground = np.column_stack([xy, campus.route.ground_height(xy)])
    shadows = render_shadow_map(wp.array(flat.corners, dtype=wp.vec3, device="cpu"), flat)
    out = wp.zeros(len(ground), dtype=float, device="cpu")
    points = wp.array((ground + np.array([0.0, 0.0, 0.01])).astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(_ask, len(ground), [shadows, points, out], device="cpu")
    surface = Surface(flat.corners.reshape(-1, 3).astype(float), np.arange(3 * len(flat.corners)).reshape(-1, 3))
    free = surface.openness(
        ground + np.array([0.0, 0.0, 0.02]), -flat.sun_directions[shadows.sun][None].astype(float), 100.0
    )
    right = np.abs(out.numpy() - free) < 0.5
    assert 0.2 < free.mean() < 0.9  # there is both
    assert right[free > 0.5].mean() > 0.98 and right[free < 0.5].mean() > 0.92  # shadows of leaves are ragged


def test_no_sun_casts_no_shadow(campus):
    flat = flatten(true_world.world_spec("overcast", campus).compile())
    assert render_shadow_map(wp.array(flat.corners[:1], dtype=wp.vec3, device="cpu"), flat).sun == -1


def test_pictures_repeat(campus, sunny):
    pose = robot_poses(campus)[0]
    one, other = (Rasterizer(sunny, PLAN.intrinsics, (160, 90)) for _ in range(2))
    assert np.array_equal(one(pose)[0], other(pose)[0])


@pytest.mark.slow
@pytest.mark.parametrize(("lighting", "least"), [("sun", 30.0), ("night", 35.0)])
def test_pictures_look_like_the_film(campus, lighting, least):
    """The rasterizer's pictures are nearer to the film's frames, scaled down, than small pictures of the film's own
    renderer.
    """
    model = true_world.world_spec(lighting, campus).compile()
    raster = Rasterizer(model, PLAN.intrinsics, (160, 90))
    large, small = filming.Renderer(lighting, campus, filming.FilmingPlan()), filming.Renderer(lighting, campus, PLAN)
    for pose in robot_poses(campus, lighting)[:2]:
        wanted = cv2.resize(large(pose)[0], (160, 90), interpolation=cv2.INTER_AREA)
        mine = raster(pose)[0]
        assert psnr(mine, wanted) > max(least, psnr(small(pose)[0], wanted))
        assert np.abs(mine.mean((0, 1)) - wanted.mean((0, 1))).max() < 0.01
