"""The simulated reality: its road, its place, its films, and the comparison of a build with it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from twin.assets.ground import Ground
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.cameras import Cameras, pixel_grid, unproject
from twin.geometry.mesh_rays import Surface
from twin.geometry.poses import Similarity, umeyama
from twin.reality import campus_road, filming, primitives
from twin.reality import truth as truth_module
from twin.reality.__main__ import TINY, film
from twin.reality.campus_road import RoadLine
from twin.reality.lighting import LIGHTINGS
from twin.reality.sky import sky_cube_map
from twin.reality.truth import (
    HALF_WIDTH,
    TrueFilm,
    Truth,
    align_poses,
    camera_errors,
    compare,
    fingerprint,
    intrudes,
    matched_poses,
    measure,
    mesh_quality,
)
from twin.scene import SceneDir

DEMO = Path(__file__).parent.parent / "scenes" / "demo"

_IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def campus():
    return campus_road.build()


@pytest.fixture(scope="module")
def truth(campus):
    plan = filming.FilmingPlan(lightings=("sun", "night"))
    films = {}
    for name in plan.lightings:
        times, poses = filming.trajectory(plan, campus.route, name)
        films[name] = TrueFilm(times, poses, np.zeros(0, np.int64), np.zeros((0, 90, 160), np.float16))
    return Truth(campus.route, plan.start, plan.length, HALF_WIDTH, plan.intrinsics, (640, 360), films)


def test_place_0_is_the_demos(campus):
    """Its fingerprint equals the one that films of the demo's place have stored since."""
    shipped = read_json(DEMO / "truth" / "truth.json")
    assert fingerprint(campus) == pytest.approx(shipped["fingerprint"], abs=1e-9)
    assert campus.number == 0 and "place" not in shipped


def test_route_projects_back():
    road = RoadLine()
    rng = np.random.default_rng(0)
    station, lateral = rng.uniform(-5.0, 80.0, 2000), rng.uniform(-3.0, 3.0, 2000)
    back_station, back_lateral = road.project(road.at(station, lateral))
    assert np.allclose(back_station, station, atol=1e-9)
    assert np.allclose(back_lateral, lateral, atol=1e-9)


def test_route_runs_straight_then_right_at_unit_speed():
    road = RoadLine()
    station = np.linspace(0.0, 60.0, 6001)
    xy = road.at(station)
    steps = np.diff(xy, axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), 0.01, rtol=1e-5)
    assert np.allclose(np.arctan2(steps[:, 1], steps[:, 0]), road.heading(station[:-1] + 0.005), atol=1e-3)
    assert np.allclose(xy[3000], [30.0, 0.0])
    assert road.heading(60.0) == pytest.approx(-np.pi / 2)


def test_ground_is_gentle_but_not_flat():
    road = RoadLine()
    station = np.linspace(0.0, 60.0, 601)
    middle = road.ground_height(road.at(station))
    assert 0.06 < np.ptp(middle) < 0.3
    assert np.abs(np.gradient(middle, station)).max() < 0.05
    across = campus_road.cross_profile(np.linspace(-2.9, 2.9, 59))
    assert across.max() - across.min() > 0.03  # crowned
    assert np.abs(np.diff(across)).max() < 0.005


def test_nothing_solid_in_the_corridor(campus):
    for obj in campus.objects:
        if obj.kind not in ("obstacle", "foliage"):
            continue
        mesh = trimesh.Trimesh(obj.part.vertices, obj.part.faces, process=False)
        points = np.concatenate([mesh.vertices, mesh.triangles_center])
        station, lateral = campus.route.project(points[:, :2])
        low = points[:, 2] - campus.route.ground_height(points[:, :2]) < 2.2
        inside = low & (np.abs(lateral) < 1.6) & (station > -2.0) & (station < 65.0)
        assert not inside.any(), obj.name


def test_what_blocks_is_solid(campus):
    """Every obstacle that is large enough to stop a robot has a collision shape at its place."""
    for obj in campus.objects:
        if obj.kind != "obstacle" or obj.name.endswith(("_trim", "_glass", "_day", "_lit")):
            continue
        assert obj.solids, obj.name
        center = np.mean([s.center for s in obj.solids], 0)
        assert np.linalg.norm(center[:2] - obj.part.vertices[:, :2].mean(0)) < 1.6, obj.name


def test_trajectories_are_what_a_cart_does():
    plan, road = filming.FilmingPlan(), RoadLine()
    paths = {}
    for name in LIGHTINGS:
        times, poses = filming.trajectory(plan, road, name)
        again = filming.trajectory(plan, road, name)
        assert np.array_equal(poses, again[1])
        paths[name] = poses[:, :3, 3]
        xy = poses[:, :2, 3]
        height = poses[:, 2, 3] - road.ground_height(xy)
        assert abs(height.mean() - filming.CAMERA_HEIGHT) < 0.005
        assert np.abs(height - filming.CAMERA_HEIGHT).max() < 0.02
        assert np.abs(road.project(xy)[1]).max() <= 0.3 + 1e-9
        assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
        down = np.rad2deg(np.arcsin(-poses[:, 2, 2]))
        assert abs(down.mean() - 8.0) < 0.5
        assert np.allclose(np.diff(times), 1.0 / plan.fps)
    shortest = min(len(p) for p in paths.values())
    assert np.abs(paths["sun"][:shortest] - paths["night"][:shortest]).max() > 0.05


def test_poses_at_a_later_time_belong_to_the_same_film():
    plan, road = filming.FilmingPlan(), RoadLine()
    times, poses = filming.trajectory(plan, road, "sun")
    again, later = filming.trajectory(plan, road, "sun", later=1.0 / plan.fps)
    assert np.array_equal(times, again)
    inner = slice(1, -2)  # the heading at both ends is that of the film's first and last step
    np.testing.assert_allclose(later[:-1][inner], poses[1:][inner], atol=1e-9)


def test_a_rolling_shutter_reads_each_row_at_its_time():
    """A camera that yaws sees the far rows of a vertical edge displaced against each other."""
    plan = filming.FilmingPlan(width=320, height=180)
    light = np.zeros((180, 320, 3), np.float32)
    light[:, 160:] = 1.0
    rays = unproject(pixel_grid(320, 180), plan.intrinsics).astype(np.float32)
    depth = np.zeros((180, 320), np.float32)  # the sky, which a translation does not move
    yaw = 0.02  # to the right, so that the edge moves to the left from the first row to the last one
    read = filming.read_rows(light, depth, rays, plan.intrinsics, np.array([0.0, yaw, 0.0, 0.1, 0.1, 0.1]))
    edge = 320 - read[..., 0].sum(1)
    rows = (np.arange(180) + 0.5) / 180 - 0.5
    np.testing.assert_allclose(edge, 160 - plan.intrinsics[0] * yaw * rows, atol=0.1)


def test_sky_is_seamless_and_brighter_by_day():
    day, night = (sky_cube_map(LIGHTINGS[name], 1, 64).reshape(6, 64, 64, 3).astype(float) for name in ("sun", "night"))
    assert day.mean() > 2 * night.mean()
    # +X and −Z share an edge of the cube map (columns), up to one texel's difference.
    assert np.abs(day[0][:, -1] - day[5][:, 0]).mean() < 12.0


def test_truth_survives_saving(truth, tmp_path):
    truth.save(tmp_path)
    back = Truth.load(tmp_path)
    assert np.array_equal(back.films["sun"].camera_to_world, truth.films["sun"].camera_to_world)
    assert np.allclose(back.poses("night", truth.films["night"].times), truth.films["night"].camera_to_world)
    between = back.poses("sun", np.array([0.125]))
    assert np.allclose(between[0, :3, 3], truth.films["sun"].camera_to_world[:2, :3, 3].mean(0))


def test_a_truth_that_was_cut_off_is_one_line(truth, tmp_path):
    truth.save(tmp_path)
    (tmp_path / "truth.npz").write_bytes((tmp_path / "truth.npz").read_bytes()[:2000])
    with pytest.raises(InputError, match=r"truth\.npz is damaged"):
        Truth.load(tmp_path)
    truth.save(tmp_path)
    (tmp_path / "truth.json").write_text("{}")
    with pytest.raises(InputError, match=r"is damaged \(KeyError.*film again"):
        Truth.load(tmp_path)
    truth.save(tmp_path)
    whole = read_json(tmp_path / "truth.json")
    for wrong, said in (([1.0], "another version of the place"), ("abc", "is damaged"), ({}, "is damaged")):
        write_json(tmp_path / "truth.json", whole | {"fingerprint": wrong})
        with pytest.raises(InputError, match=f"{said}.*film again"):
            Truth.load(tmp_path)


def fake_build(truth: Truth, root: Path, warp: Similarity, lift: float = 0.0) -> SceneDir:
    """A build that equals the truth, moved by `warp`, its ground raised by `lift`; its parts are the true solids."""
    scene = SceneDir(root)
    truth.save(scene.truth)
    for stage in ("metric", "mesh"):
        scene.stage(stage).mkdir(parents=True)
    poses = np.concatenate([f.camera_to_world for f in truth.films.values()])
    names = [name for name, f in truth.films.items() for _ in f.times]
    n = len(poses)
    cameras = Cameras(
        names=tuple(f"{name}/{k:06d}" for k, name in enumerate(names)),
        camera_to_world=warp.poses(poses),
        intrinsics=np.tile(truth.intrinsics, (n, 1)),
        sizes=np.tile(truth.size, (n, 1)),
        lightings=tuple(names),
        sources=tuple(names),
        times=np.concatenate([f.times for f in truth.films.values()]),
        held_out=np.zeros(n, bool),
        images=scene.build / "images",
    )
    cameras.save(scene.stage("metric"))
    x, y = np.meshgrid(np.arange(-5.0, 50.0, 0.1), np.arange(-40.0, 8.0, 0.1))
    height = truth.ground_height(np.stack([x, y], -1)) + lift
    Ground(height, np.array([-5.0, -40.0]), 0.1, np.ones(x.shape, bool), np.zeros((*x.shape, 3), np.uint8)).save(
        scene.stage("mesh")
    )
    hulls = []
    for obj in truth.place.objects:
        for solid in obj.solids:
            if solid.kind == "box":
                hull = trimesh.creation.box(2 * np.array(solid.half))
            else:
                hull = trimesh.creation.cylinder(solid.half[0], 2 * solid.half[1], sections=16)
            hull.apply_transform(trimesh.transformations.rotation_matrix(solid.yaw, [0, 0, 1]))
            hulls.append((warp.points(hull.vertices + solid.center), hull.faces))
    np.savez(
        scene.stage("mesh") / "parts.npz",
        vertices=np.concatenate([v for v, _ in hulls]).astype(np.float32),
        faces=np.concatenate([f for _, f in hulls]).astype(np.int32),
        vertex_start=np.cumsum([0] + [len(v) for v, _ in hulls]),
        face_start=np.cumsum([0] + [len(f) for _, f in hulls]),
    )
    return scene


def test_a_perfect_build_has_no_error(truth, tmp_path):
    found = measure(fake_build(truth, tmp_path, _IDENTITY))["figures"]
    assert found["ate_m"] < 1e-9
    assert abs(found["scale_error"]) < 1e-9
    assert found["tilt_deg"] < 1e-5
    assert found["ground_median_m"] < 0.002
    assert found["obstacle_median_m"] < 0.05  # the solids stand for the things to within that
    assert found["corridor_intrusions"] == 0
    assert found["depth_median_m"] is None


def test_errors_are_measured(truth, tmp_path):
    found = measure(fake_build(truth, tmp_path / "lift", _IDENTITY, lift=0.07))["figures"]
    assert found["ground_median_m"] == pytest.approx(0.07, abs=0.002)
    assert found["ground_bias_m"] == pytest.approx(0.07, abs=0.002)
    tilt = np.deg2rad(2.0)
    rotation = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    poses = np.concatenate([f.camera_to_world for f in truth.films.values()])
    moved = Similarity(1.03, rotation, np.array([3.0, -2.0, 0.5])).poses(poses)
    errors = camera_errors(moved, poses)
    assert errors["scale_error"] == pytest.approx(0.03)
    assert errors["tilt_deg"] == pytest.approx(2.0, abs=0.01)
    assert errors["ate_m"] < 1e-9
    assert errors["ate_rigid_m"] > 0.2


@pytest.mark.parametrize("off", [0.0, 0.04, 0.07, 5.0])
def test_a_shifted_mesh_is_as_far_off_as_it_was_shifted(off):
    x, y = np.random.default_rng(0).uniform(0.2, 3.8, (2, 500))
    square = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 4.0, 0.0], [0.0, 4.0, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    points, lift = np.stack([x, y, 0.0 * x], 1), np.array([0.0, 0.0, off])
    true, mesh = Surface(square, faces), Surface(square + lift, faces)
    found = mesh_quality(true.distance(points + lift), mesh.distance(points))
    assert found["mesh_accuracy_median_m"] == pytest.approx(off, abs=1e-6)
    assert found["mesh_chamfer_m"] == pytest.approx(min(off, 1.0), abs=1e-6)  # what is missing counts one meter
    assert found["mesh_completeness_5cm"] == (off <= 0.05)
    assert found["mesh_completeness_10cm"] == (off <= 0.1)


def save_visual(scene: SceneDir, truth: Truth, kinds: set[str]) -> None:
    """A visual mesh that is the truth's objects of some kinds."""
    part = primitives.join([t.part for t in truth.place.objects if t.kind in kinds])
    np.savez(scene.stage("mesh") / "visual.npz", vertices=part.vertices, faces=part.faces)


def test_a_place_without_leaves_is_measured(truth, campus, tmp_path):
    scene = fake_build(truth, tmp_path, _IDENTITY)
    save_visual(scene, truth, {"ground"})
    bare = replace(truth)
    vars(bare)["place"] = replace(campus, objects=[one for one in campus.objects if one.kind != "foliage"])
    found = truth_module._surface_errors(scene.stage("mesh"), bare, _IDENTITY, truth.films["sun"].camera_to_world[:4])
    assert found["mesh_completeness_10cm_ground"] == 1.0 and "mesh_completeness_10cm_foliage" not in found


def test_a_mesh_that_is_the_truth_is_complete_and_one_without_houses_is_not(truth, tmp_path):
    found = []
    for name, kinds in (("all", {"ground", "obstacle", "foliage"}), ("flat", {"ground"})):
        scene = fake_build(truth, tmp_path / name, _IDENTITY)
        save_visual(scene, truth, kinds)
        found.append(measure(scene)["figures"])
    whole, flat = found
    assert whole["mesh_chamfer_m"] < 1e-3 and whole["mesh_completeness_5cm"] == 1.0
    assert flat["mesh_accuracy_mean_m"] < 1e-3  # what there is, is right
    assert flat["mesh_completeness_10cm_ground"] == 1.0
    assert flat["mesh_completeness_10cm_obstacle"] < 0.5
    assert flat["mesh_completeness_10cm"] < whole["mesh_completeness_10cm"]


def test_a_scene_without_truth_is_not_compared(tmp_path):
    with pytest.raises(InputError, match="has no truth"):
        compare(SceneDir(tmp_path))


def test_filming_that_was_stopped_begins_anew(tmp_path):
    """It must not take its own folder for another's, nor leave films beside an older film's truth."""
    plan = replace(TINY, length=3.0, lightings=("sun",), samples=1)
    out, gray = tmp_path / "place", np.full((plan.height, plan.width, 3), 0.5, np.float32)

    def stopped(pose):
        raise KeyboardInterrupt

    def shot(pose):
        return gray, np.full(gray.shape[:2], 5.0, np.float32)

    for _ in range(2):  # stopped in an empty folder, then over a finished film
        with pytest.raises(KeyboardInterrupt):
            film(plan, out, renderer_of=lambda lighting, place: stopped)
        with pytest.raises(InputError, match="has no truth"):
            compare(SceneDir(out))
        assert not (out / "scene.toml").exists() and not (out / "truth" / "truth.json").exists()
        film(plan, out, renderer_of=lambda lighting, place: shot)
        assert Truth.load(out / "truth").length == 3.0 and not (out / "scene.old.toml").exists()
    mine = (out / "scene.toml").read_text() + "# mine\n"
    (out / "scene.toml").write_text(mine)
    film(plan, out, renderer_of=lambda lighting, place: shot)
    assert (out / "scene.old.toml").read_text() == mine != (out / "scene.toml").read_text()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    with pytest.raises(InputError, match="has no truth/, so this command did not write it"):
        film(plan, tmp_path / "other")


def test_a_source_that_the_truth_does_not_have_is_refused(truth, tmp_path):
    cameras = Cameras.load(fake_build(truth, tmp_path, _IDENTITY).stage("metric"))
    other = replace(cameras, sources=("phone",) * len(cameras), lightings=("dusk",) * len(cameras))
    with pytest.raises(InputError, match="source phone: the truth has only the films sun, night; leave this source"):
        matched_poses(truth, other)
    # Another film under a filmed lighting has other poses.
    other = replace(cameras, sources=("phone",) * len(cameras))
    with pytest.raises(InputError, match="source phone: the truth has only the films sun, night; leave this source"):
        matched_poses(truth, other)


def test_rigid_alignment_holds_on_a_straight_drive(truth):
    """Camera centers on one line do not determine the roll; the cameras' axes do."""
    poses = truth.films["sun"].camera_to_world[:30]
    line = poses.copy()
    line[:, 1:3, 3] = 0.0
    found = align_poses(line, line)
    assert np.allclose(found.rotation, np.eye(3), atol=1e-9)
    assert np.linalg.matrix_rank(line[:, :3, 3] - line[:, :3, 3].mean(0), tol=1e-6) == 1
    assert umeyama(poses[:, :3, 3], poses[:, :3, 3]).scale == pytest.approx(1.0)


@pytest.mark.parametrize(("lateral", "height", "expected"), [(0.0, 0.3, True), (2.2, 0.3, False), (1.6, 0.3, True)])
def test_intrusion(truth, lateral, height, expected):
    center = truth.route.at(20.0, lateral)
    block = trimesh.creation.box([0.3, 0.3, height])
    base = float(truth.ground_height(center))
    vertices = np.asarray(block.vertices) + np.append(center, base + height / 2)
    assert intrudes(vertices, np.asarray(block.faces, np.int32), truth) is expected
    assert not intrudes(vertices - [0.0, 0.0, height - 0.03], np.asarray(block.faces, np.int32), truth)


@pytest.mark.slow
@pytest.mark.parametrize("lighting", sorted(LIGHTINGS))
def test_frames_are_true_and_rich(campus, lighting):
    """Depth of the road is that of the true ground; SIFT finds the whole picture and the road, under every lighting."""
    plan = filming.FilmingPlan()
    render = filming.Renderer(lighting, campus, plan)
    times, poses = filming.trajectory(plan, campus.route, lighting)
    frame = len(times) // 5
    light, depth = render(poses[frame])
    # The first of the 2 × 2 samples of a pixel lies a quarter of a pixel right of and below its corner.
    rays = unproject(pixel_grid(640, 360) - 0.25, plan.intrinsics)
    points = (rays * depth[..., None]) @ poses[frame][:3, :3].T + poses[frame][:3, 3]
    road = np.abs(campus.route.project(points[..., :2])[1]) < 1.5
    road &= (depth > 0) & (depth < 15)
    error = points[road][:, 2] - campus.route.ground_height(points[road][:, :2])
    assert road.sum() > 20_000
    assert np.quantile(np.abs(error), 0.99) < 0.004
    image = filming.sensor_image(np.random.default_rng(0), light, LIGHTINGS[lighting], 1.0)
    keypoints = cv2.SIFT_create(contrastThreshold=0.02).detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    at = np.array([k.pt for k in keypoints]).astype(int)
    on_road = road[at[:, 1].clip(0, 359), at[:, 0].clip(0, 639)].sum()
    assert len(keypoints) > 600
    assert on_road > 60


@pytest.mark.slow
def test_the_demo_is_this_world(campus):
    """The generator still renders the frames of the shipped films."""
    av = pytest.importorskip("av")
    truth = Truth.load(DEMO / "truth")
    for name in truth.films:
        with av.open(str(DEMO / "input" / f"{name}.mp4")) as container:
            shipped = next(container.decode(video=0)).to_ndarray(format="rgb24").astype(float)
        plan = filming.FilmingPlan()
        times, poses = filming.trajectory(plan, campus.route, name)
        assert np.allclose(poses, truth.films[name].camera_to_world, atol=1e-9)
        light, _ = filming.Renderer(name, campus, plan)(poses[0])
        frame = filming.sensor_image(
            np.random.default_rng(0), light, LIGHTINGS[name], filming.exposures(LIGHTINGS[name], times)[0]
        )
        error = cv2.GaussianBlur(frame.astype(float) - shipped, (0, 0), 2.0)
        assert np.sqrt((error**2).mean()) < 4.0


def test_films_repeat_byte_for_byte(tmp_path):
    """The encoder, fed the same frames, writes the same file."""
    rng = np.random.default_rng(4)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (180, 400, 3)).astype(np.float32), (0, 0), 2.0)
    noise = rng.normal(0, 2, (12, 180, 320, 3))
    frames = [np.clip(picture[:, 5 * k : 5 * k + 320] + noise[k], 0, 255).astype(np.uint8) for k in range(12)]
    plan = filming.FilmingPlan(width=320, height=180)
    for name in ("a.mp4", "b.mp4", "c.mp4"):
        filming.write_video(iter(frames), plan, tmp_path / name)
    whole = (tmp_path / "a.mp4").read_bytes()
    assert {(tmp_path / name).read_bytes() for name in ("b.mp4", "c.mp4")} == {whole}
    with pytest.raises(KeyboardInterrupt):
        filming.write_video(_interrupted(frames[:3]), plan, tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").read_bytes() == whole and len(list(tmp_path.iterdir())) == 3


def _interrupted(frames):
    yield from frames
    raise KeyboardInterrupt
