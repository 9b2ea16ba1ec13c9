"""The exported scene has the heights, parts, colors and intrinsics of its sources, and its folder can be moved."""

import re
import zipfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from tiny_world import box, export, tiny_config, tiny_ground, tiny_route, tiny_scene, tiny_world

from twin.config import BranchConfig, RouteConfig, SceneConfig, TaskConfig
from twin.env.drivers import follow_route
from twin.env.physics import HuskyPhysics
from twin.env.route_segments import RouteSegment, scene_tasks
from twin.errors import InputError
from twin.geometry.cameras import Cameras, depth_determined, project
from twin.geometry.images import read_image
from twin.geometry.polyline import arc_lengths, corridor_edges, heading_at, nearest_on_route, point_at, total_turn
from twin.geometry.route import BRANCH
from twin.mjcf.scene_xml import (
    add_ground,
    camera_pose,
    check_portable,
    covered_by_ground,
    face_texture,
    film_camera,
    rest_pose,
)
from twin.mjcf.world import World
from twin.report import build_report, figures
from twin.robot import BASE_HEIGHT, CAMERA_SIZE, HuskyParams
from twin.scene import SceneDir


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export(tiny_scene(tmp_path_factory.mktemp("scene")), tiny_config(half_width=0.8))


def ray_down(model, data, xy, groups=(1, 0, 0, 0, 0, 0)) -> float:
    """Height of the topmost geom of the given groups at xy."""
    hit = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(
        model, data, np.array([*xy, 20.0]), np.array([0.0, 0.0, -1.0]), np.array(groups, np.uint8), 1, -1, hit
    )
    return 20.0 - distance


def test_metrics_are_those_of_the_scene(exported):
    _, metrics = exported
    assert metrics["parts"] == 2
    assert metrics["route_length_m"] == pytest.approx(arc_lengths(tiny_route())[-1])
    assert metrics["turn_deg"] == pytest.approx(-90, abs=3)
    assert metrics["spawn_touched"] == []
    # The nearest box's near edge is 1.9 m to the left, the robot's tire 0.34 m.
    assert 1.5 < metrics["spawn_clearance_m"] < 4.0
    assert metrics["spawn_drift_m"] < 0.001


def test_heights_are_right_to_a_millimeter(exported):
    folder, _ = exported
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground = tiny_ground()
    rng = np.random.default_rng(1)
    rows, columns = ground.height.shape
    for row, column in zip(rng.integers(1, rows - 1, 40), rng.integers(1, columns - 1, 40), strict=True):
        xy = ground.origin + ground.cell * np.array([column, row]) + 1e-4
        assert ray_down(model, data, xy) == pytest.approx(ground.height[row, column], abs=1e-3)


def test_coarse_height_field_keeps_nodes_and_colors_in_place(tmp_path):
    """The coarse field's nodes are nodes of the fine one; the texture has a texel per fine cell."""
    ground = tiny_ground()
    rgb = np.random.default_rng(5).integers(0, 255, (*ground.height.shape, 3)).astype(np.uint8)
    ground = type(ground)(ground.height, ground.origin, ground.cell, ground.measured, rgb)
    coarse = ground.coarsened(0.3)
    rows, columns = coarse.height.shape
    assert coarse.cell == pytest.approx(0.3) and (rows - 1) * 3 <= ground.height.shape[0] - 1 < rows * 3
    nodes = ground.origin + 0.3 * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1)
    np.testing.assert_allclose(coarse.height, ground.at(nodes), atol=1e-12)
    spec = mujoco.MjSpec()
    spec.modelfiledir = spec.texturedir = str(tmp_path)
    add_ground(spec, ground, tmp_path, 0.3)
    texture = read_image(tmp_path / "ground.png")
    assert texture.shape[:2] == ((rows - 1) * 3, (columns - 1) * 3)
    corners = rgb[4:6, 7:9].reshape(4, 3).astype(int)
    np.testing.assert_array_equal(texture[-1 - 4, 7], (corners.sum(0) + 2) // 4)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for row, column in ((1, 1), (5, 9), (rows - 2, columns - 2)):
        assert ray_down(model, data, nodes[row, column] + 1e-5) == pytest.approx(coarse.height[row, column], abs=1e-4)


def test_level_ground_is_level(tmp_path):
    """A height field without relief must not be divided by its range."""
    scene = tiny_scene(tmp_path)
    ground = tiny_ground()
    flat = type(ground)(np.full_like(ground.height, 0.7), ground.origin, ground.cell, ground.measured, ground.rgb)
    flat.save(scene.stage("mesh"))
    out, _ = export(scene)
    model = World.load(out).model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert ray_down(model, data, (1.03, -0.52)) == pytest.approx(0.7, abs=1e-4)
    assert World.load(out).spawn[2] == pytest.approx(0.7 + BASE_HEIGHT, abs=0.004)


def test_parts_keep_their_places(exported):
    """MuJoCo moves a mesh to its own center and axes; in the world its corners must be back in place."""
    folder, _ = exported
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = data.geom("part_0001")
    mesh = model.mesh("part_0001")
    vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    world = vertices @ geom.xmat.reshape(3, 3).T + geom.xpos
    expected = box((4.0, -3.0, 0.8), (0.6, 0.6, 0.8))
    gaps = np.linalg.norm(world[:, None] - expected[None], axis=-1)
    assert gaps.min(0).max() < 1e-4 and gaps.min(1).max() < 1e-4
    assert ray_down(model, data, (4.0, -3.0), groups=(0, 0, 0, 1, 0, 0)) == pytest.approx(1.2, abs=1e-4)


def test_geoms_are_in_their_documented_groups(exported):
    folder, _ = exported
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    group = {model.geom(i).name: model.geom_group[i] for i in range(model.ngeom)}
    assert group["ground"] == 0 and group["visual"] == 2 and group["part_0000"] == 3 and group["rear_left_tyre"] == 4
    silent = np.isin(model.geom_group, [1, 2])
    assert not model.geom_contype[silent].any() and not model.geom_conaffinity[silent].any()
    assert {model.site(i).name for i in range(model.nsite)} >= {"goal", "route_000", "corridor_left_003"}
    assert (model.site_group == 4).all()


def test_loads_from_a_zip_unpacked_elsewhere(exported, tmp_path):
    folder, _ = exported
    archive = tmp_path / "scene.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in folder.rglob("*"):
            file.write(path, path.relative_to(folder))
    with zipfile.ZipFile(archive) as file:
        file.extractall(tmp_path / "there")
    world = World.load(tmp_path / "there")
    model = world.model()
    assert model.nkey == 1 and model.nu == 2
    text = (tmp_path / "there" / "scene.xml").read_text()
    files = re.findall(r'file="([^"]*)"', text)
    assert files and all("/" not in name and ".." not in name for name in files)
    assert str(folder) not in text and str(folder) not in (folder / "world.json").read_text()


def test_world_save_and_load_round_trip(exported):
    folder, _ = exported
    world = World.load(folder)
    np.testing.assert_allclose(world.route[:, :2], tiny_route())
    np.testing.assert_allclose(world.goal, world.route[-1])
    assert world.half_width == 0.8
    assert world.spawn[3] == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose(world.intrinsics, [125.0, 127.5, 82.5, 42.5])


def test_camera_is_that_of_the_first_training_frame(exported):
    folder, _ = exported
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    pixel = model.cam_sensorsize[0] / model.cam_resolution[0]
    np.testing.assert_allclose(model.cam_intrinsic[0, :2] / pixel, [125.0, 127.5], rtol=1e-5)
    assert model.cam_resolution[0].tolist() == [160, 90]


def test_camera_of_another_shape_keeps_square_pixels(exported):
    from twin.geometry.cameras import Cameras
    from twin.scene import SceneDir

    cameras = Cameras.load(SceneDir(exported[0].parent.parent).stage("metric"))
    tall = type(cameras)(**{**vars(cameras), "sizes": np.tile([640, 480], (3, 1))})
    # 640 × 480 becomes 160 × 120, of which 15 rows go at the top and at the bottom.
    np.testing.assert_allclose(film_camera(tall).resized(CAMERA_SIZE).intrinsics, [125.0, 127.5, 82.5, 42.5 - 15.0])


def test_without_a_route_there_is_no_robot(tmp_path):
    scene = tiny_scene(tmp_path, route=False)
    out, metrics = export(scene)
    assert not metrics["has_route"] and "no route" in metrics["note"]
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    assert model.nu == 0 and model.nq == 0 and model.geom("part_0001").id >= 0
    assert not scene.has_route


@pytest.mark.parametrize(
    ("xy", "words"),
    [(tiny_route() - [2.5, 0.0], r"0\.50 m from the edge"), (tiny_route()[:4], r"is 0\.75 m long")],
)
def test_a_route_that_is_too_short_or_starts_off_the_ground_is_refused(tmp_path, xy, words):
    scene = tiny_scene(tmp_path)
    np.savez(scene.stage("mesh") / "route.npz", xy=xy, z=tiny_ground().at(xy))
    with pytest.raises(InputError, match=words):
        export(scene)


def filmed_from(tmp_path: Path, first: float, config: SceneConfig | None = None) -> tuple[World, float, Cameras]:
    """The tiny scene, filmed every 0.3 m along x from `first` [m] to 6 m, 1.2 m above ground, with a level camera.

    The lowest ray of a frame meets level ground 2.4 m ahead.
    """
    scene = tiny_scene(tmp_path)
    x = np.arange(first, 6.0, 0.3)
    pose = np.zeros((len(x), 4, 4))
    pose[:, :3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down and ahead
    pose[:, :2, 3] = np.stack([x, np.zeros(len(x))], 1)
    pose[:, 2, 3], pose[:, 3, 3] = tiny_ground().at(pose[:, :2, 3]) + 1.2, 1.0
    cameras = Cameras(
        names=tuple(f"day/{i:06d}" for i in range(len(x))),
        camera_to_world=pose,
        intrinsics=np.tile([360.0, 360.0, 320.0, 180.0], (len(x), 1)),
        sizes=np.tile([640, 360], (len(x), 1)),
        lightings=("day",) * len(x),
        sources=("day",) * len(x),
        times=np.arange(len(x), dtype=float),
        held_out=np.zeros(len(x), bool),
        images=scene.stage("cameras") / "images",
    )
    cameras.save(scene.stage("metric"))
    out, metrics = export(scene, config)
    return World.load(out), metrics["route_start_m"], cameras


def test_route_starts_where_the_robot_sees_ground_that_a_film_shows_twice(tmp_path):
    world, start, cameras = filmed_from(tmp_path, 0.0)
    # The robot's lowest ray meets level ground 1.2 m ahead of its base, so at x = 1.2 m it sees what is filmed. A hill,
    # the margin of the picture, and the second frame 0.3 m after the first add to it.
    assert 1.2 <= start <= 2.3 and world.start == start
    assert world.length == pytest.approx(arc_lengths(tiny_route())[-1] - start)
    np.testing.assert_allclose(world.route[:, :2], tiny_route())  # stations count from the first frame
    np.testing.assert_allclose(world.spawn[:2], [start, 0.0], atol=0.03)
    x, y = np.meshgrid(np.arange(start + 0.05, 6.0, 0.05), np.linspace(-1.0, 1.0, 21))
    points = np.stack([x, y, tiny_ground().at(np.stack([x, y], -1))], -1).reshape(-1, 3)
    slope = (tiny_ground().at(np.array([start + 0.25, 0.0])) - tiny_ground().at(np.array([start - 0.25, 0.0]))) / 0.5
    ahead = np.array([1.0, 0.0, slope]) / np.hypot(1.0, slope)
    base = np.stack([ahead, [0.0, 1.0, 0.0], np.cross(ahead, [0.0, 1.0, 0.0])], 1)
    pixels, depth = project(points, camera_pose(world.robot, np.array(world.spawn[:3]), base), world.intrinsics)
    shown = (depth > 0.0) & (pixels >= 0.0).all(1) & (pixels <= CAMERA_SIZE).all(1)
    assert shown.sum() > 500 and depth_determined(cameras, points[shown]).all()
    assert not depth_determined(cameras, points[x.ravel() < 2.2]).any()


def test_a_route_starts_at_the_first_frame_if_the_film_begins_earlier_or_the_user_gave_points(tmp_path):
    assert filmed_from(tmp_path / "earlier", -3.0)[1] == 0.0
    given = replace(tiny_config(), route=RouteConfig(points=((0.0, 0.0), (5.0, 0.0))))
    world, start, _ = filmed_from(tmp_path / "given", 0.0, given)
    assert start == world.start == 0.0 and world.spawn[0] == pytest.approx(0.0, abs=0.03)


def test_a_route_that_shows_unfilmed_ground_for_too_long_starts_at_the_first_frame(tmp_path):
    world, start, _ = filmed_from(tmp_path, 3.0)  # the route is 10.5 m long: it may start 2.6 m further along
    assert start == world.start == 0.0


def test_no_task_begins_before_the_start(tmp_path):
    world, start, _ = filmed_from(tmp_path, 0.0)
    end = world.start + world.length
    assert scene_tasks(world)["route"] == RouteSegment("route", start, world.length)
    asked = tuple(TaskConfig(*one) for one in (("early", 0.0, 5.0), ("late", 3.0, 5.0), ("all", 0.0, end)))
    found = scene_tasks(world, asked)
    assert (found["early"].start, found["early"].end) == (start, pytest.approx(5.0))
    assert found["late"] == RouteSegment("late", 3.0, 5.0)
    assert found["all"].end == pytest.approx(end)
    with pytest.raises(
        InputError, match=rf"from 0 m to 2 m, but its route is .* long, and robots start at {start:.2f} m"
    ):
        scene_tasks(world, (TaskConfig("before", 0.0, 2.0),))  # of which less than a meter is left
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot))
    assert drive.outcome == "goal" and drive.progress[0] == pytest.approx(start, abs=0.05)


def test_maps_draw_the_route_from_its_start(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "place_map", lambda *given: drawn.append(given[5]))
    monkeypatch.setattr(figures, "ground_map", lambda *given: drawn.append(given[2]))
    monkeypatch.setattr(figures, "svg", str)
    world, start, _ = filmed_from(tmp_path, 0.0)
    build_report._map_charts(SceneDir(tmp_path), {})
    assert len(drawn) == 2
    for route in drawn:
        assert route[0] == pytest.approx([start, 0.0]) and len(route) == (arc_lengths(world.route) >= start).sum()


def test_a_branch_has_its_own_start(tmp_path):
    """A branch along the route, which is filmed from its beginning on, but named by passes."""
    scene = tiny_scene(tmp_path / "place")
    route = np.column_stack([tiny_route(), tiny_ground().at(tiny_route())])
    np.savez(
        scene.stage("mesh") / "route.npz",
        xy=route[:, :2],
        z=route[:, 2],
        **{f"{BRANCH}side": route, f"{BRANCH}given": route[4:]},
    )
    filmed_from(tmp_path / "film", 0.0)[2].save(scene.stage("metric"))
    sides = BranchConfig(passes=("day:1",), name="side"), BranchConfig(points=((1.0, 0.0), (5.0, 0.0)), name="given")
    world = World.load(export(scene, replace(tiny_config(), branch=sides))[0])
    assert world.along("side").start == world.start > 1.0 and world.along("given").start == 0.0
    assert {name: (one.start, one.route) for name, one in scene_tasks(world).items() if one.route} == {
        "side": (world.start, "side"), "given": (0.0, "given")
    }  # fmt: skip
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), branch="side")
    np.testing.assert_allclose(drive.base_to_world[0, :2, 3], [world.start, 0.0], atol=0.05)


def test_geoms_touched_at_the_start_are_reported(tmp_path):
    scene = tiny_scene(tmp_path, boxes=((0.0, 0.62, 0.8),))  # 2 cm into the left tires
    assert export(scene)[1]["spawn_touched"] == ["part_0000"]


def test_a_start_inside_a_part_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not rest"):
        export(tiny_scene(tmp_path, boxes=((0.4, 0.3, 0.5),)))


def on_a_slope(tmp_path, degrees: float, robot: HuskyParams, **scene_arguments):
    """The tiny scene on a plane that falls towards the robot's back, and the error that its export raises."""
    scene = tiny_scene(tmp_path, **scene_arguments)
    flat = tiny_ground()
    x = np.broadcast_to(np.arange(flat.height.shape[1]) * flat.cell, flat.height.shape)
    ground = type(flat)(np.tan(np.radians(degrees)) * x, flat.origin, flat.cell, flat.measured, flat.rgb)
    ground.save(scene.stage("mesh"))
    np.savez(scene.stage("mesh") / "route.npz", xy=tiny_route(), z=ground.at(tiny_route()))
    return export(scene, replace(tiny_config(), robot=robot))


SOFT = HuskyParams(friction=0.25, spin_friction=0.02, slip_stiffness=1 / 40, ground_viscosity=5.0)
"""A robot fitted on soft ground, whose tires creep down any slope."""


@pytest.mark.parametrize("degrees", [2.0, 5.0, 12.0])
@pytest.mark.parametrize("servo_gain", [HuskyParams.servo_gain, 20.0])
def test_a_robot_fitted_on_soft_ground_starts_on_a_slope(tmp_path, degrees, servo_gain):
    out, metrics = on_a_slope(tmp_path, degrees, replace(SOFT, servo_gain=servo_gain))
    world = World.load(out)
    start = tiny_route()[0] - [BASE_HEIGHT * np.sin(np.radians(degrees)), 0.0]  # wheels at the route's start
    assert np.hypot(*(world.spawn[:2] - start)) < 0.005  # and not where it would have crept to
    assert metrics["spawn_drift_m"] > 0.004  # it creeps, and the metrics say so
    assert world.model().opt.impratio == pytest.approx(1 / 40)  # the exported tires are as soft as the fitted ones


def test_a_start_inside_a_part_is_refused_on_soft_ground(tmp_path):
    with pytest.raises(InputError, match=r"an obstacle is there: raise mesh\.obstacle_height"):
        on_a_slope(tmp_path, 2.0, SOFT, boxes=((0.4, 0.3, 0.2),))


def test_a_start_too_steep_for_the_tires_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"falls by 18\.0°, expected at most 14\.0° .*friction 0\.25.*"):
        on_a_slope(tmp_path, 18.0, SOFT)


@pytest.mark.parametrize(
    ("written", "instead"),
    [
        ('impratio="10"', 'impratio="0.01"'),
        ('<geom name="ground" pos="', '<geom name="ground" margin="0.02" pos="'),
        ('cone="elliptic"', 'cone="pyramidal"'),
    ],
)
def test_a_copy_that_moves_differently_is_a_bug(tmp_path, written, instead):
    """The start is steep, so that the robot's weight loads the tires."""
    out, _ = on_a_slope(tmp_path, 25.0, HuskyParams())
    built = World.load(out).model()
    assert check_portable(out, built)["spawn_drift_m"] < 0.005
    text = (out / "scene.xml").read_text()
    assert text.count(written) == 1
    (out / "scene.xml").write_text(text.replace(written, instead))
    with pytest.raises(RuntimeError, match="moves differently"):
        check_portable(out, built)


def test_rest_pose_follows_the_slope():
    ground = tiny_ground()
    grid_x, _ = np.meshgrid(*(np.arange(n) * ground.cell for n in ground.height.shape[::-1]))
    ramp = type(ground)(0.1 * grid_x, np.zeros(2), ground.cell, ground.measured, ground.rgb)
    position, quaternion = rest_pose(ramp.at, np.array([5.0, 5.0]), np.pi / 2)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    up = np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    np.testing.assert_allclose(rotation.reshape(3, 3)[:, 2], up, atol=1e-9)
    np.testing.assert_allclose(rotation.reshape(3, 3)[:, 0], [0.0, 1.0, 0.0], atol=1e-9)  # climbs to its right
    np.testing.assert_allclose(position, np.array([5.0, 5.0, 0.5]) + BASE_HEIGHT * up, atol=1e-9)


def test_texels_interpolate_corner_colors_exactly():
    """Bilinear lookup in the texture equals linear interpolation of the corners' colors."""
    rng = np.random.default_rng(2)
    colors = rng.integers(60, 120, (7, 3, 3)).astype(np.uint8)  # no clamping of the fourth texel
    texture, texcoords = face_texture(colors)
    height, width, _ = texture.shape
    for face in range(7):
        weights = rng.dirichlet(np.ones(3))
        u, v = weights @ texcoords[face] * [width, height] - 0.5
        i, j = int(v), int(u)
        a, b = v - i, u - j
        patch = texture[i : i + 2, j : j + 2].astype(float)
        value = (1 - a) * ((1 - b) * patch[0, 0] + b * patch[0, 1]) + a * ((1 - b) * patch[1, 0] + b * patch[1, 1])
        np.testing.assert_allclose(value, weights @ colors[face], atol=1e-6)


def test_texture_coordinates_survive_the_obj(exported):
    """The color looked up through the compiled model is the mesh's own color at a face's corner."""
    folder, _ = exported
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    with np.load(folder.parent / "4_mesh" / "visual.npz") as data:
        vertices, faces, colors = data["vertices"], data["faces"], data["colors"]
    faces = faces[~covered_by_ground(vertices, tiny_ground())[faces].all(1)]
    mesh = model.mesh("visual")
    assert mesh.facenum[0] == len(faces)
    texture = read_image(folder / "assets" / "visual.png")
    height, width, _ = texture.shape
    corner = model.mesh_facetexcoord[mesh.faceadr[0] : mesh.faceadr[0] + len(faces)]
    uv = model.mesh_texcoord[mesh.texcoordadr[0] :][corner]  # MuJoCo flips OBJ's v, so that it counts from the top
    column, row = (uv * [width, height]).astype(int).transpose(2, 0, 1)
    np.testing.assert_array_equal(texture[row, column], colors[faces])


def test_vertices_near_the_ground_are_covered():
    ground = tiny_ground()
    points = np.array([[1.0, 1.0, 0.05], [1.0, 1.0, 0.5], [1.0, 1.0, -1.0], [50.0, 1.0, 0.0]])
    points[:3, 2] += ground.at(points[:3, :2])
    assert covered_by_ground(points, ground).tolist() == [True, False, True, False]


def test_nearest_on_route_equals_dense_samples():
    route = tiny_route()
    s_dense = np.linspace(0, arc_lengths(route)[-1], 20001)
    dense = point_at(route, s_dense)
    points = np.random.default_rng(3).uniform([-1, -5], [10, 2], (60, 2))
    s, error = nearest_on_route(route, points)
    gaps = np.linalg.norm(points[:, None] - dense[None], axis=-1)
    np.testing.assert_allclose(np.abs(error), gaps.min(1), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(point_at(route, s) - points, axis=1), np.abs(error), atol=1e-9)


def test_left_of_the_route_is_positive():
    route = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    s, error = nearest_on_route(route, np.array([[5.0, 1.0], [5.0, -1.0], [9.0, 5.0]]))
    np.testing.assert_allclose(s, [5.0, 5.0, 15.0])
    np.testing.assert_allclose(error, [1.0, -1.0, 1.0])
    # On a route that meets itself, only the surroundings of the previous point are searched.
    loop = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.1]])
    assert nearest_on_route(loop, np.array([0.02, 0.2]))[0] == pytest.approx(15.8)
    assert nearest_on_route(loop, np.array([0.02, 0.2]), last=0.0)[0] == pytest.approx(0.02)


def test_headings_turns_and_corridor_edges_equal_closed_forms():
    route = tiny_route()
    assert heading_at(route, 0.0) == pytest.approx(0.0)
    assert heading_at(route, 100.0) == pytest.approx(-np.pi / 2, abs=0.05)
    circle = np.stack([np.cos(np.linspace(0, 4 * np.pi, 400)), np.sin(np.linspace(0, 4 * np.pi, 400))], 1) * 5
    assert total_turn(circle) == pytest.approx(4 * np.pi, rel=0.06)  # two full turns, less the averaging at the ends
    left, right = corridor_edges(np.column_stack([route, np.zeros(len(route))]), 1.0)
    np.testing.assert_allclose(left[3], [route[3, 0], 1.0, 0.0])
    np.testing.assert_allclose(right[3], [route[3, 0], -1.0, 0.0])


def test_tiny_world_is_a_drivable_model(tmp_path):
    world = tiny_world(tmp_path)
    data = mujoco.MjData(world.model())
    mujoco.mj_resetDataKeyframe(world.model(), data, 0)
    np.testing.assert_allclose(data.qpos[:3], world.spawn[:3], atol=1e-4)


def test_projection_is_vectorized():
    """The route has uneven segments and meets itself; each point has its own previous point."""
    rng = np.random.default_rng(0)
    angle = np.sort(rng.uniform(0.0, 4.0 * np.pi, 160))
    route = np.stack([3.0 * np.sin(angle), 2.0 * np.sin(2.0 * angle)], -1)  # an eight, twice around
    middle = rng.uniform(0.0, arc_lengths(route)[-1], 50)
    last = middle + rng.uniform(-2.0, 0.5, 50)
    points = point_at(route, middle) + rng.normal(scale=0.5, size=(50, 2))
    together = np.stack(nearest_on_route(route, points, last), -1)
    alone = [nearest_on_route(route, points[i], last[i]) for i in range(50)]
    np.testing.assert_array_equal(together, alone)
    assert (np.abs(together[:, 0] - nearest_on_route(route, points)[0]) > 1.0).any()  # elsewhere it is nearer still
