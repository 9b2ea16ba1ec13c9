"""Long places: the lengthened line, what stands beside it, and its rendering one stretch at a time."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from twin import commands
from twin.errors import InputError
from twin.files import read_json
from twin.geometry.cameras import pixel_grid, unproject
from twin.reality import filming
from twin.reality.__main__ import scene_task, scene_toml
from twin.reality.place_sampling import MAX_FRAMES, sample_place
from twin.reality.place_spec import GRADE_STEP, LONGEST_DRAWN, RUN_IN, RUN_OUT
from twin.reality.sampled_place import build
from twin.reality.sampled_road import SampledRoad
from twin.reality.true_world import StretchRenderer, is_long, near_stretch
from twin.reality.truth import TrueFilm, Truth

PLACE, LENGTH = 12, 160.0


def _area(part):
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


@pytest.fixture(scope="module")
def place():
    return build(sample_place(PLACE, LENGTH))


@pytest.mark.parametrize(("length", "numbers"), [(100.0, range(1, 41)), (300.0, range(1, 41)), (2000.0, range(1, 5))])
def test_a_lengthened_line_begins_as_drawn_and_does_not_come_back(length, numbers):
    for number in numbers:
        short, spec = sample_place(number), sample_place(number, length)
        known = len(short.line.pieces)
        assert spec.line.length == length and spec.section == short.section and spec.lights == short.lights
        assert spec.line.pieces[:known] == short.line.pieces
        assert spec.line.grades[: len(short.line.grades)] == short.line.grades
        assert sum(piece.length for piece in spec.line.pieces) >= length + RUN_OUT
        assert (len(spec.line.grades) - 1) * GRADE_STEP >= length + RUN_OUT
        assert max(map(abs, spec.line.grades)) == max(map(abs, short.line.grades))
        for piece in spec.line.pieces:
            assert piece.curvature == 0.0 or 6.0 <= 1.0 / abs(piece.curvature) <= 40.0, number
        stations = np.arange(-RUN_IN, length + RUN_OUT)
        xy = SampledRoad(spec).at(stations)
        drawn = sum(piece.length for piece in short.line.pieces)
        for k in np.flatnonzero(stations > drawn).tolist():
            before = xy[stations < stations[k] - 65.0]
            assert not len(before) or np.hypot(*(before - xy[k]).T).min() > 30.0, (number, stations[k])
        for mouth in spec.line.mouths:
            assert mouth.width / 2 < mouth.station < length, number


def test_without_a_length_nothing_changes():
    for number in range(1, 41):
        assert (
            sample_place(number, 20.0) == sample_place(number, sample_place(number).line.length) == sample_place(number)
        ), number
        assert sample_place(number).line.length <= LONGEST_DRAWN
    assert not is_long(build(sample_place(PLACE)))


def test_a_long_film_takes_no_more_frames_than_its_speed_asks_for():
    for number in range(1, 41):
        film = sample_place(number, 300.0).film
        wanted = 300.0 * len(film.passes) * len(sample_place(number).lights) / MAX_FRAMES
        spacing = film.speed / film.fps
        assert spacing <= 2.01 and (film.fps == np.ceil(film.speed / 2.0) or spacing > 0.66 * wanted), number
        assert film.size == sample_place(number).film.size


def test_things_stand_as_densely_far_along_as_at_the_start(place):
    """Every 50 m of road have at least a third of the mean number of solids per 50 m."""
    solids = [solid.center[:2] for obj in place.objects for solid in obj.solids]
    station, lateral = place.route.project(np.array(solids))
    counts = np.histogram(station[np.abs(lateral) < 20.0], np.arange(0.0, 151.0, 50.0))[0]
    assert counts.min() > counts.mean() / 3.0 and counts.min() >= 5


def test_parts_of_road_and_land_meet(place):
    """The ground meshes have no gap where two parts of the road meet, and tiles of land surround the road."""
    bands = place.layout.bands
    names = [name for name in bands if name.startswith("road")]
    assert len(names) > 1 and len(place.layout.lands) > 1
    for one, other in pairwise(names):
        assert bands[one][1] == bands[other][0]
        edges = [next(obj for obj in place.objects if obj.name == name).part.vertices for name in (one, other)]
        rows = [edge.reshape(15, -1, 3) for edge in edges]
        assert np.array_equal(rows[0][:, -1], rows[1][:, 0])
    stations = np.arange(0.0, LENGTH, 5.0)
    for lateral in (-40.0, 40.0):
        for x, y in place.route.at(stations, lateral).tolist():
            assert any(x0 <= x <= x1 and y0 <= y <= y1 for x0, x1, y0, y1 in place.layout.lands.values())
    assert {*place.layout.wet} >= {*bands, *place.layout.lands}


def test_a_stretch_has_what_is_near_and_sharp_textures_there(place, monkeypatch):
    monkeypatch.setattr("twin.reality.true_world._SIGHT", 50.0)
    monkeypatch.setattr("twin.reality.true_world._SHARP", 20.0)
    part, whole = near_stretch(place, 0.0, 10.0), place.textures()
    kept = {obj.name for obj in part.objects}
    last = f"road_{sum(name.startswith('road') for name in place.layout.bands) - 1}"
    assert "road" in kept and last not in kept and 0 < len(kept) < len(place.objects)
    assert {*part.layout.bands} < {*place.layout.bands} and len(part.lamp_heads) <= 24
    images = part.textures()
    assert {obj.texture for obj in part.objects} & {*whole} <= {*images} and images["road"] is whole["road"]
    full = {obj.name: obj.part for obj in place.objects}
    thinned = [obj for obj in part.objects if obj.part is not full[obj.name]]
    assert thinned and all(obj.kind == "foliage" for obj in thinned)
    for obj in thinned:
        assert len(obj.part.faces) == 2 * -(-len(full[obj.name].faces) // 8)
        assert _area(obj.part) == pytest.approx(_area(full[obj.name]), rel=0.2)
    shrunk = [name for name, image in images.items() if image.shape != whole[name].shape]
    assert shrunk and all(images[name].shape[1] == max(1, whole[name].shape[1] // 4) for name in shrunk)


def test_a_frame_far_along_shows_the_road_and_things_beside_it(place):
    """At 130 m, the road is below the horizon, solid objects are beside it, and the depth equals that of cast rays."""
    plan = replace(filming.FilmingPlan.of(sample_place(PLACE, LENGTH)), width=160, height=92, oversize=1.0)
    lighting = plan.lightings[0]
    _, poses = filming.trajectory(plan, place.route, lighting)
    pose = poses[np.argmin(np.abs(place.route.project(poses[:, :2, 3])[0] - 130.0))]
    render = StretchRenderer(place, lambda part: filming.Renderer(lighting, part, plan))
    light, depth = render(pose)
    points = (unproject(pixel_grid(160, 92), plan.intrinsics) * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    station, lateral = place.route.project(points[..., :2])
    seen = (depth > 0.0) & (depth < 40.0)
    height = points[..., 2] - place.route.ground_height(points[..., :2])
    road = seen & (place.route.edges(lateral) < 0.0) & (station > 130.0) & (np.abs(height) < 0.05)
    assert road[60:].mean() > 0.2 and road[:20].mean() == 0.0
    assert (seen & (height > 0.5) & (place.route.edges(lateral) > 0.0)).mean() > 0.02
    assert 0.05 < light.mean() < 0.9 and light[60:].std() > 0.005
    frames, maps = filming.depth_maps(lighting, place, replace(plan, width=640, height=368), pose[None])
    assert frames.tolist() == [0] and maps.shape == (1, 92, 160)
    assert np.mean(np.abs(maps[0] - depth) < 0.02 * depth + 0.02) > 0.95  # far trees have fewer leaves


def test_the_truth_of_a_long_place_has_its_length(place, tmp_path):
    plan = filming.FilmingPlan.of(sample_place(PLACE, LENGTH))
    times, poses = filming.trajectory(plan, place.route, "sun")
    film = TrueFilm(times, poses, np.zeros(0, np.int64), np.zeros((0, 9, 16), np.float16))
    road = SampledRoad(sample_place(PLACE, LENGTH))
    truth = Truth(road, 0.0, LENGTH, 1.5, plan.intrinsics, (640, 360), {"sun": film}, PLACE, {"sun": "sun"})
    truth.save(tmp_path / "truth")
    assert read_json(tmp_path / "truth" / "truth.json")["road_length"] == LENGTH
    back = Truth.load(tmp_path / "truth")
    assert back.route.length == back.road_length == LENGTH and back.length == LENGTH
    short = replace(plan, length=12.0, lightings=plan.lightings[:1])
    said = f"--place {PLACE} --length 160 --traffic --tiny --lightings {plan.lightings[0]} --out"
    assert said in scene_toml(short, "x", sample_place(PLACE, LENGTH), back.road_length, (), True)
    assert f"--place {PLACE} --length 160 --out" in scene_toml(plan, "x", sample_place(PLACE, LENGTH), back.road_length)
    with pytest.raises(InputError, match="a road of 160 m, the given place a longer or shorter one; give --length 160"):
        scene_task("task.json", tmp_path, PLACE)


@pytest.mark.parametrize(("given", "said"), [(("12", "10"), "expected 20 to 2000"), (("0", "100"), "demo's road")])
def test_a_length_that_cannot_be_is_refused(given, said, tmp_path, capsys):
    assert (
        commands.main("reality", ["film", "--place", given[0], "--length", given[1], "--out", str(tmp_path / "x")]) != 0
    )
    assert said in capsys.readouterr().err and not (tmp_path / "x").exists()
