"""Visual against collision geometry: a field that shows the collision geometry itself, and fields that do not."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from tiny_world import tiny_world

from twin.assets.ground import Ground
from twin.geometry.cameras import FAR, Cameras, Rendering, intrinsics_for_size, pixel_grid, unproject
from twin.geometry.polyline import point_at
from twin.geometry.poses import look_at
from twin.mjcf.scene_xml import Parts
from twin.report.build_report import page
from twin.report.visual_vs_collision import (
    GeometryViews,
    compare_geometry,
    gap_row,
    geometry_section,
    render_views,
    view_poses,
)
from twin.scene import SceneDir

STATIONS = (0.0, 1.0, 2.0)


class SolidField:
    """A field that shows the collision geometry, by casting MuJoCo's rays one by one."""

    lightings = ("day",)

    def __init__(self, model: mujoco.MjModel):
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)

    def render(self, cameras, lighting, size):
        intrinsics, size = intrinsics_for_size(cameras, size)
        rays = unproject(pixel_grid(*size), intrinsics[0])
        pose = cameras.camera_to_world[0]
        lengths = np.linalg.norm(rays, axis=-1)
        world = (rays / lengths[..., None]) @ pose[:3, :3].T
        found, geom = np.empty(rays.shape[:2]), np.zeros(1, np.int32)
        groups = np.array([1, 0, 0, 1, 0, 0], np.uint8)
        for at in np.ndindex(found.shape):
            found[at] = mujoco.mj_ray(self.model, self.data, pose[:3, 3], world[at], groups, 1, -1, geom)
        depth = np.where(found >= 0.0, found / lengths, FAR).astype(np.float32)
        return Rendering(np.zeros((1, *depth.shape, 3), np.float32), depth[None], (depth < FAR)[None] * np.float32(1.0))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    root = tmp_path_factory.mktemp("seen") / "tiny"
    world = tiny_world(root)
    mesh = SceneDir(root).stage("mesh")
    eyes = np.array([point_at(world.route, s) + np.array([0.0, 0.013, 0.6]) for s in STATIONS])
    poses = np.array([look_at(eye, eye + np.array([1.0, 0.007, -0.1])) for eye in eyes])
    views = render_views(SolidField(world.model()), world, poses, "day")
    above = [look_at(np.array([3.0 + x, 0.0, 12.0]), np.array([3.01, 0.0, 0.0])) for x in (0.0, 1.0)]
    cameras = replace(
        Cameras.load(SceneDir(root).stage("metric")).select(np.array([1, 1])),
        camera_to_world=np.stack(above),
        intrinsics=np.tile([300.0, 300.0, 320.0, 180.0], (2, 1)),
        held_out=np.zeros(2, bool),
    )
    return world, views, cameras, Ground.load(mesh), Parts.load(mesh / "parts.npz")


def test_equal_geometries_have_no_gap(place):
    world, views, cameras, ground, parts = place
    found = compare_geometry(views, world, cameras, ground, parts)
    assert found["pixels"] > 5000 and found["views"] == 3
    assert found["median_m"] < 1e-3 and found["p90_m"] < 5e-3
    assert found["ground_p95_m"] < 0.01 and found["standing_median_m"] < 1e-3
    assert found["corridor_leak_m"] < 0.02 and found["corridor_ghost_m"] < 0.02
    assert found["leak_share"] == 0.0 and found["ghost_share"] == 0.0


def test_visible_geometry_without_collision_is_a_leak(place):
    world, views, cameras, ground, parts = place
    points = views.points(views.collision_depth, world.intrinsics)
    s_near = (np.abs(points[..., 0] - 2.5) < 0.4) & (np.abs(points[..., 1]) < 0.5) & views.is_ground
    assert s_near.sum() > 30
    # The ground there is seen as if it were 0.35 m higher, along the same rays.
    eye = views.camera_to_world[:, None, None, 2, 3]
    share = (eye - points[..., 2] - 0.35) / (eye - points[..., 2])
    raised = replace(views, visual_depth=np.where(s_near, views.visual_depth * share, views.visual_depth))
    found = compare_geometry(raised, world, cameras, ground, parts)
    assert found["corridor_leak_m"] == pytest.approx(0.35, abs=0.1)
    assert found["corridor_ghost_m"] < 0.02
    assert max(found["along"]["leak_m"][:3]) > 0.3 and max(found["along"]["leak_m"][4:]) < 0.05


def test_invisible_collision_geometry_is_a_ghost_and_unfilmed_ones_count_separately(place):
    world, views, cameras, ground, parts = place
    points = views.points(views.collision_depth, world.intrinsics)
    hole = (np.abs(points[..., 0] - 2.5) < 0.4) & (np.abs(points[..., 1]) < 0.5) & views.is_ground
    eye = views.camera_to_world[:, None, None, 2, 3]
    share = (eye - points[..., 2] + 0.28) / (eye - points[..., 2])
    sunk = replace(views, visual_depth=np.where(hole, views.visual_depth * share, views.visual_depth))
    found = compare_geometry(sunk, world, cameras, ground, parts)
    assert found["corridor_ghost_m"] == pytest.approx(0.28, abs=0.06)
    assert found["corridor_leak_m"] < 0.02 and found["unfilmed_ghost_m"] < 0.02
    elsewhere = cameras.camera_to_world.copy()
    elsewhere[:, 0, 3] += 100.0
    unfilmed = compare_geometry(sunk, world, replace(cameras, camera_to_world=elsewhere), ground, parts)
    assert unfilmed["corridor_ghost_m"] == 0.0 and unfilmed["unfilmed_ghost_m"] == pytest.approx(0.28, abs=0.06)


@pytest.fixture
def sunk(place):
    """Looks through a hole of 0.28 m in the ground before the robot."""
    world, views, *_ = place
    points = views.points(views.collision_depth, world.intrinsics)
    hole = (np.abs(points[..., 0] - 2.5) < 0.4) & (np.abs(points[..., 1]) < 0.5) & views.is_ground
    eye = views.camera_to_world[:, None, None, 2, 3]
    share = (eye - points[..., 2] + 0.28) / (eye - points[..., 2])
    return replace(views, visual_depth=np.where(hole, views.visual_depth * share, views.visual_depth))


@pytest.mark.parametrize(
    ("what", "two_directions"),
    [
        ("both", True),
        ("one frame", False),
        ("one of two is held out", False),
        ("standing still", False),
        ("a frame per film from the same place", False),
        ("a frame per film", False),
        ("three frames, two of them from one place", True),
    ],
)
def test_only_two_directions_of_one_film_determine_a_depth(place, sunk, what, two_directions):
    world, _, cameras, ground, parts = place
    still = cameras.camera_to_world[[0, 0]]
    films = ("a", "b")
    given = {
        "both": cameras,
        "one frame": cameras.select(np.array([0])),
        "one of two is held out": replace(cameras, held_out=np.array([False, True])),
        "standing still": replace(cameras, camera_to_world=still),
        "a frame per film from the same place": replace(cameras, camera_to_world=still, sources=films),
        "a frame per film": replace(cameras, sources=films),
        "three frames, two of them from one place": cameras.select(np.array([0, 0, 1])),
    }[what]
    found = compare_geometry(sunk, world, given, ground, parts)
    # A ghost is in one of the two figures, so one of the two cautions is always given.
    ghost, other = ("corridor_ghost_m", "unfilmed_ghost_m")[:: 1 if two_directions else -1]
    assert found[ghost] == pytest.approx(0.28, abs=0.06) and found[other] < 0.02
    cautions = [caution.what for caution in geometry_section({"seen_touched": found}).cautions]
    assert len(cautions) == 1 and ("from build to build" in cautions[0]) != two_directions


def test_a_part_that_is_not_seen_is_a_ghost_and_one_that_is_not_solid_a_leak(place):
    world, views, cameras, ground, parts = place
    part = ~views.is_ground & (views.collision_depth < 8.0)
    assert part.sum() > 50
    unseen = compare_geometry(
        replace(views, visual_depth=np.where(part, FAR, views.visual_depth)), world, cameras, ground, parts
    )
    assert unseen["ghost_share"] > 0.5 and unseen["leak_share"] in (None, 0.0)
    none = Parts([], [])
    leaky = compare_geometry(
        replace(views, collision_depth=np.where(part, FAR, views.collision_depth)), world, cameras, ground, none
    )
    assert leaky["leak_share"] is None or leaky["leak_share"] > 0.3
    far_off = replace(views, visual_depth=np.where(part, views.visual_depth - 0.6, views.visual_depth))
    assert compare_geometry(far_off, world, cameras, ground, parts)["leak_share"] > 0.5


def test_a_drive_has_a_view_every_two_meters():
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 10.0, 101)
    assert view_poses(poses)[:, 0, 3] == pytest.approx([0.0, 2.0, 4.0, 6.0, 8.0])


def test_the_build_page_shows_the_comparison(place, tmp_path):
    world, views, cameras, ground, parts = place
    found = compare_geometry(views, world, cameras, ground, parts)
    report = {"scene": "tiny", "seen_touched": found, "review": {"follower": None}}
    section = geometry_section(report)
    assert not section.cautions and any(fact.name == "largest collision-only in the corridor" for fact in section.facts)
    told = page(SceneDir(tmp_path), report)
    assert "Visual and collision geometry" in told and "Difference of visual and collision" in told
    large = geometry_section({"seen_touched": found | {"corridor_leak_m": 0.4, "unfilmed_ghost_m": 0.9}})
    assert large.cautions[0].what.startswith("Something in the corridor") and len(large.cautions) == 2
    just_over = geometry_section({"seen_touched": found | {"median_m": 0.0521}}).cautions
    median = "Visual and collision geometry differ by 0.052 m in the median, more than 0.05 m."
    assert [it.what for it in just_over] == [median]
    assert geometry_section({}).not_applicable
    assert gap_row(views, 0).shape[1] > 4 * 300
    assert isinstance(views, GeometryViews)
