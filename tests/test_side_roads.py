"""Side roads: lines that turn off the driven line, their ground, what stands beside them, and their films."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from test_end_to_end import QUICK

from twin import commands
from twin.config_file import load_config
from twin.geometry.mesh_rays import Surface
from twin.mjcf.world import World
from twin.reality import __main__ as verb
from twin.reality import filming
from twin.reality.place_sampling import sample_place
from twin.reality.place_spec import FREE_HALF_WIDTH, MOUTH_REACH
from twin.reality.sampled_place import build
from twin.reality.sampled_road import SampledRoad
from twin.reality.side_roads import LEAD, SIDE_VERGE, SideLine
from twin.reality.true_world import near_stretch
from twin.reality.truth import HALF_WIDTH, Truth, corridor
from twin.scene import SceneDir

PLACE = 28  # has two side roads, one on each side
NUMBERS = range(1, 50)


@pytest.fixture(scope="module")
def spec():
    return sample_place(PLACE, side_roads=True)


@pytest.fixture(scope="module")
def place(spec):
    return build(spec)


@pytest.fixture(scope="module")
def plain():
    """The place without its side roads."""
    return build(sample_place(PLACE))


def _lines(number):
    spec = sample_place(number, side_roads=True)
    road = SampledRoad(spec)
    return road, [(axis, SideLine(road, axis)) for axis in road.side_axes]


def test_all_but_the_line_is_that_of_the_place():
    found = 0
    for number in NUMBERS:
        plain, spec = sample_place(number), sample_place(number, side_roads=True)
        found += len(spec.line.side_roads)
        assert not plain.line.side_roads and replace(spec, line=plain.line) == plain
        assert replace(spec.line, side_roads=(), mouths=plain.line.mouths) == plain.line
        for mouth, wide in zip(plain.line.mouths, spec.line.mouths, strict=True):
            assert (mouth.station, mouth.side) == (wide.station, wide.side) and mouth.width <= wide.width
        assert {one.mouth for one in spec.line.side_roads} <= {*spec.line.mouths}
        assert [one.name for one in spec.line.side_roads] == [f"side_{k + 1}" for k in range(len(spec.line.side_roads))]
    assert found > 15


@pytest.mark.parametrize(("numbers", "length"), [(NUMBERS, 0.0), ([60], 0.0), ([3, 7, 8, 19], 600.0)])
def test_no_other_side_road_crosses_one(numbers, length):
    """Side roads that are not filmed are in the place, too."""
    for number in numbers:
        spec = sample_place(number, length, side_roads=True)
        road, filmed = SampledRoad(spec), [one.mouth for one in spec.line.side_roads]
        for mouth in (one for one in spec.line.mouths if one not in filmed):
            edge = (spec.section.left if mouth.side > 0 else spec.section.right) + spec.section.curb_width
            across = mouth.station + 0.5 * mouth.width * np.linspace(-1.0, 1.0, 9)
            xy = road.at(across[:, None], mouth.side * (edge + np.arange(0.0, MOUTH_REACH, 0.25)))
            for axis in road.side_axes:
                assert not axis.occupied(xy, 0.0).any(), (number, axis.one.name)


def test_a_side_line_is_smooth_and_projects_back():
    """It begins on the driven line, turns with its radius, ends on the axis, and is continuous in heading."""
    rng = np.random.default_rng(0)
    for number in NUMBERS:
        road, lines = _lines(number)
        for axis, line in lines:
            one = axis.one
            stations = np.arange(0.0, line.length, 0.05)
            xy = line.at(stations)
            steps = np.diff(xy, axis=0)
            assert np.allclose(np.linalg.norm(steps, axis=1), 0.05, rtol=1e-3), number
            turns = np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))
            assert np.abs(turns).max() < 0.05 / min(one.radius, 6.0) + 1e-3, number
            assert np.allclose(np.unwrap(line.heading(stations[:-1])), np.unwrap(np.arctan2(*steps.T[::-1])), atol=0.02)
            on_road, off_road = road.project(xy[stations < LEAD])
            assert np.abs(off_road).max() < 1e-6 and np.ptp(on_road) == pytest.approx(LEAD, abs=0.06)
            out, across = axis.project(xy[stations > line.turn_end])
            assert np.abs(across).max() < 1e-6 and out[-1] == pytest.approx(one.driven, abs=0.06)
            lateral = rng.uniform(-1.5, 1.5, len(stations))
            back = line.project(line.at(stations, lateral))
            assert np.allclose(back[0], stations, atol=1e-5) and np.allclose(back[1], lateral, atol=1e-6), number


def test_points_far_from_a_side_line_are_not_on_it():
    """A projected distance is never less than the true distance, whichever part of the road a point is at."""
    rng = np.random.default_rng(1)
    for number in (PLACE, 7, 30, 33):
        for _, line in _lines(number)[1]:
            xy = line.at(rng.uniform(0.0, line.length, 300)) + rng.normal(0.0, 15.0, (300, 2))
            dense = line.at(np.arange(-150.0, line.length + 60.0, 0.1))
            true = np.linalg.norm(xy[:, None] - dense, axis=-1).min(1)
            assert (np.abs(line.project(xy)[1]) > true - 0.06).all()


def test_nothing_stands_on_side_roads_and_things_stand_beside_them(place, spec):
    road = place.route
    solids = [(obj.name, solid) for obj in place.objects for solid in obj.solids]
    beside = dict.fromkeys((one.name for one in spec.line.side_roads), 0)
    for name, solid in solids:
        half = np.array(solid.half[:2]) if solid.kind == "box" else np.full(2, solid.half[0])
        grid = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 9)]), -1).reshape(-1, 2) * half
        c, s = np.cos(solid.yaw), np.sin(solid.yaw)
        xy = grid @ np.array([[c, s], [-s, c]]) + solid.center[:2]
        for axis in road.side_axes:
            at, line = axis.project(xy), SideLine(road, axis)
            assert not axis.occupied(xy, 0.0).any(), name
            station, lateral = line.project(xy)
            inside = (station > 0.0) & (station < line.length)
            assert (np.abs(lateral)[inside] > FREE_HALF_WIDTH).all(), name
            beside[axis.one.name] += bool((np.abs(at[1]) < 12.0).any() and (at[0] > 14.0).any())
    assert min(beside.values()) >= 5, beside
    assert len({obj.name for obj in place.objects}) == len(place.objects)


def test_what_stood_beside_the_driven_line_stands_there_still(place, plain):
    """Only solids in the way of a filmed side road are missing or moved."""

    def centers(one):
        return np.array([solid.center[:2] for obj in one.objects for solid in obj.solids])

    before, now = centers(plain), centers(place)
    kept = np.linalg.norm(before[:, None] - now, axis=-1).min(1) < 1e-6
    away = np.min([np.abs(axis.project(before)[1]) for axis in place.route.side_axes], axis=0)
    assert kept.mean() > 0.9 and kept[away > 12.0].mean() > 0.98 and len(now) > len(before)


def test_a_house_has_the_same_windows_with_and_without_side_roads(place, plain):
    """The real test shows the place without its side roads."""
    without, there = (
        {obj.name: obj.part for obj in one.objects if obj.name.startswith("house_")} for one in (plain, place)
    )
    both = without.keys() & there.keys()
    assert len(both) > 20 and len(both) > 0.8 * len(without)
    for name in both:  # the ground, and so the height, may differ beside a side road
        assert np.array_equal(without[name].vertices[:, :2], there[name].vertices[:, :2]), name
        assert np.array_equal(without[name].uv, there[name].uv), name


def test_the_ground_mesh_is_the_true_ground(place, spec):
    """A ray straight down meets surface, curbs and verges of a side road at the ground's height."""
    parts = [obj.part for obj in place.objects if obj.kind == "ground"]
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    surface = Surface(np.concatenate([part.vertices for part in parts]), faces)
    rng = np.random.default_rng(0)
    for axis in place.route.side_axes:
        one, line = axis.one, SideLine(place.route, axis)
        lateral = rng.uniform(-FREE_HALF_WIDTH, FREE_HALF_WIDTH, 1500)
        driven = line.at(rng.uniform(0.0, line.length, 1500), lateral)
        edge = 0.5 * one.mouth.width + spec.section.curb_width
        verge = rng.choice([-1.0, 1.0], 1500) * rng.uniform(edge + 0.05, edge + SIDE_VERGE - 0.1, 1500)
        xy = np.concatenate([driven, axis.at(rng.uniform(14.0, one.length - 0.5, 1500), verge)])
        z = place.route.ground_height(xy)
        found = 3.0 - surface.cast(np.column_stack([xy, z + 3.0]), np.tile([0.0, 0.0, -1.0], (len(xy), 1)))
        assert np.quantile(np.abs(found), 0.97) < 0.025 and np.abs(found).max() < 0.2
        low, high = place.route.ground_height(axis.at(25.0, 0.5 * one.mouth.width + np.array([-0.001, 0.001])))
        assert high - low == pytest.approx(spec.section.curb_height, abs=0.002)


def test_a_long_road_has_textures_for_its_side_roads():
    """Parts of a long place that are rendered alone have all the textures that they use."""
    spec = sample_place(PLACE, 160.0, side_roads=True)
    assert spec.line.side_roads and spec.line.length == 160.0
    part = near_stretch(build(spec), 0.0, 50.0)
    used = {obj.texture for obj in part.objects} - {"lamp_glass", "windows_by_day", "windows_by_night"}
    assert "side_1" in used and used <= {*part.textures()}


@pytest.fixture
def filmed(tmp_path, monkeypatch, spec):
    """A scene of tiny films with gray pictures, and its truth."""
    no_depth = np.zeros(0, np.int64), np.zeros((0, 36, 64), np.float16)
    monkeypatch.setattr(verb, "depth_maps", lambda *_: no_depth)
    plan = replace(filming.FilmingPlan.of(spec), lightings=("sun",), length=12.0, width=64, height=36, oversize=1.0)
    gray = np.full((36, 64, 3), 0.3, np.float32), np.ones((36, 64), np.float32)
    root = tmp_path / "scene"
    return root, verb.film(plan, root, PLACE, renderer_of=lambda *_: lambda pose: gray, side_roads=True)


def test_films_and_settings_of_side_roads(filmed, place, spec):
    root, truth = filmed
    assert {path.stem for path in (root / "input").glob("*.mp4")} == {"sun", "sun_side_1"} == set(truth.films)
    config = load_config(root / "scene.toml")
    assert [source.path for source in config.source] == ["input/sun.mp4", "input/sun_side_1.mp4"]
    assert config.route.passes == ("sun",)
    assert [(one.name, one.passes) for one in config.branch] == [("side_1", ("sun_side_1",))]
    assert [(one.name, one.route) for one in config.task if one.route] == [("into_side_1", "side_1")]
    assert "--place 28 --side-roads --tiny --lightings sun --out" in (root / "scene.toml").read_text()
    back = Truth.load(root / "truth")
    assert back.side_roads == truth.side_roads == {"side_1": 20.0}
    line, start, length = back.lines["side_1"]
    assert (start, length) == (0.0, 20.0)
    poses = back.films["sun_side_1"].camera_to_world
    station, lateral = line.project(poses[:, :2, 3])
    assert np.abs(lateral).max() < 0.35 and station.min() < 0.5 and station.max() > 19.5
    facing = np.stack([np.cos(line.heading(station)), np.sin(line.heading(station))], 1)
    assert ((poses[:, :2, 2] * facing).sum(1) > 0.5).all()
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.8


def test_the_true_corridor_covers_all_lines(filmed):
    _, truth = filmed
    points = corridor(truth, HALF_WIDTH)[:, :2]
    off = {name: np.abs(line.project(points)[1]) for name, (line, _, _) in truth.lines.items()}
    assert (np.minimum(*off.values()) < HALF_WIDTH + 0.01).all()
    far = truth.lines["side_1"][0].at(19.0)
    assert np.linalg.norm(points - far, axis=1).min() < 0.3 and abs(truth.route.project(far)[1]) > 4.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--place", "0"], "--side-roads: the demo's street has none; give a --place from 1 on"),
        (["--place", "28", "--traffic"], "walkers and cars keep to the main road; leave one of them out"),
        (["--place", "1"], "m of place 1 has room for a film; choose one of the places 2, 4, 5,"),
        (["--place", "7", "--tiny"], "choose one of the places 2, 28, or film without --tiny"),
    ],
)
def test_what_cannot_be_filmed_is_refused(given, said, tmp_path, capsys):
    assert commands.main("reality", ["film", "--side-roads", "--out", str(tmp_path / "x"), *given]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1 and not (tmp_path / "x").exists()


def test_a_truth_with_an_unknown_side_road_is_refused(filmed):
    root, _ = filmed
    path = root / "truth" / "truth.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"side_roads": {"side_9": 20.0}}))
    with pytest.raises(verb.InputError, match=r"KeyError: 'side_9'\); film again"):
        Truth.load(root / "truth")


def test_a_task_of_such_a_scene_is_refused_by_the_real_test(filmed):
    with pytest.raises(verb.InputError, match="was filmed with --side-roads"):
        verb.scene_task("task.json", filmed[0], PLACE)


@pytest.mark.slow
def test_films_of_a_crossing_become_one_place_with_two_routes(tmp_path):
    root = tmp_path / "scene"
    options = ["--place", str(PLACE), "--side-roads", "--tiny", "--lightings", "sun"]
    assert commands.main("reality", ["film", *options, "--out", str(root)]) == 0
    settings = [word for setting in QUICK for word in ("--set", setting)]
    done = subprocess.run([sys.executable, "-m", "twin.build", str(root), *settings], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert commands.main("reality", ["compare", str(root)]) == 0
    report = json.loads((root / "build/report.json").read_text())
    assert report["cameras"]["registered"] >= 0.9 * report["cameras"]["total"]
    assert report["truth"]["ate_m"] < 0.1 and report["truth"]["route_median_m_side_1"] < 0.3
    assert report["review"]["follower"]["reached_goal"] and report["review"]["branches"]["side_1"]["reached_goal"]
    world = World.load(SceneDir(root).stage("mjcf"))
    assert list(world.branches) == ["side_1"]
    page = (root / "build/report.html").read_text()
    assert "branch side_1" in page and "goal of branch side_1 reached" in page
