"""Places by number: their descriptions, their lines and grounds, what stands in them, and how they are filmed."""

from dataclasses import replace

import numpy as np
import pytest

from twin.errors import InputError
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.mesh_rays import Surface
from twin.reality import filming
from twin.reality.__main__ import scene_toml
from twin.reality.place_sampling import sample_place
from twin.reality.place_spec import CLEARANCE, FREE_HALF_WIDTH, GRADE_STEP, SETTINGS, tasks
from twin.reality.sampled_place import build
from twin.reality.sampled_road import SampledRoad
from twin.reality.truth import TrueFilm, Truth, fingerprint

NUMBERS = range(1, 201)  # descriptions alone
BUILT = (2, 3, 5, 12)
MOVING = (5, 12)  # with cars and small things


@pytest.fixture(scope="module")
def places():
    return {number: build(sample_place(number)) for number in BUILT}


def test_descriptions_are_within_their_ranges():
    settings = set()
    for number in NUMBERS:
        spec = sample_place(number)
        settings.add(spec.setting)
        section, film = spec.section, spec.film
        assert 2.4 < section.width <= 7.001 and section.right >= 1.2, number
        assert abs(section.crossfall) <= 0.04 and max(map(abs, spec.line.grades)) <= 0.08
        for piece in spec.line.pieces:
            assert piece.curvature == 0.0 or 6.0 <= 1.0 / abs(piece.curvature) <= 40.0, number
            # The verge ends before the center of the bend.
            side, edge = (0, section.left) if piece.curvature > 0.0 else (1, section.right)
            reach = edge + section.curb_width + section.sides[side].width
            assert reach * abs(piece.curvature) < 1.0 and section.sides[side].width > 1.0, number
        assert sum(piece.length for piece in spec.line.pieces) > spec.line.length
        assert 0.29 <= film.speed / film.fps <= 2.01 and 0.4 <= film.camera_height <= 1.7, number
        assert 55.0 <= np.rad2deg(film.fov) <= 95.0 and 1 <= len(spec.lights) <= 3
        assert abs(film.stated_height - film.camera_height) <= 2.0 * film.height_tolerance + 0.006
        assert not (film.carrier == "phone" and film.calibrated)
        assert film.passes[0].name == "out" and len({one.name for one in film.passes}) == len(film.passes)
        for start, length in tasks(spec.line).values():
            assert start >= 0.0 and start + length <= 0.97 * spec.line.length
    assert settings == set(SETTINGS)
    with pytest.raises(InputError, match="place 0: expected 1 or more"):
        sample_place(0)


def test_a_number_is_one_place_and_two_numbers_are_two(places):
    assert sample_place(7) == sample_place(7) and sample_place(7) != sample_place(8)
    again = build(sample_place(5))
    assert fingerprint(again) == fingerprint(places[5]) != fingerprint(places[3])
    for one, other in zip(again.objects, places[5].objects, strict=True):
        assert one.name == other.name and np.array_equal(one.part.vertices, other.part.vertices)


def test_the_line_is_smooth_and_projects_back():
    for number in range(1, 31):
        road = SampledRoad(sample_place(number))
        stations = np.arange(-5.0, road.end, 0.05)
        steps = np.diff(road.at(stations), axis=0)
        assert np.allclose(np.linalg.norm(steps, axis=1), 0.05, rtol=1e-3)
        assert np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))).max() < 0.05 / 6.0 + 1e-6
        lateral = np.random.default_rng(number).uniform(-2.0, 2.0, len(stations))
        back = road.project(road.at(stations, lateral))
        assert np.allclose(back[0], stations, atol=1e-5) and np.allclose(back[1], lateral, atol=1e-6)


def test_slope_and_crossfall_are_as_drawn():
    for number in range(1, 31):
        spec = sample_place(number)
        road = SampledRoad(spec)
        stations = np.arange(0.0, spec.line.length, 0.5)
        height = road.ground_height(road.at(stations))
        slope = np.gradient(height, stations)
        grades = spec.line.grades
        uneven = slope - np.interp(stations, np.arange(len(grades)) * GRADE_STEP, grades)
        assert np.abs(uneven).max() < 0.035
        assert np.sqrt(np.mean(uneven**2)) < 0.015
        section = spec.section
        edges = road.ground_height(road.at(30.0, np.array([section.left - 0.01, -section.right + 0.01])))
        if section.shape == "camber":
            assert (edges[0] - edges[1]) / section.width == pytest.approx(section.crossfall, abs=0.002)
        else:
            middle = road.ground_height(road.at(30.0, 0.5 * (section.left - section.right)))
            fall = 0.5 * (2 * middle - edges[0] - edges[1]) / (0.5 * section.width)
            assert 0.6 * section.crossfall < fall <= section.crossfall + 1e-6


@pytest.mark.parametrize("number", BUILT)
def test_nothing_stands_in_the_way(places, number):
    """Solid shapes keep off the road, the free corridor and the mouths of side roads; obstacles are solid."""
    place = places[number]
    road, spec = place.route, sample_place(number)
    for obj in place.objects:
        for solid in obj.solids:
            half = np.array(solid.half[:2]) if solid.kind == "box" else np.full(2, solid.half[0])
            share = np.linspace(-1.0, 1.0, 9)
            grid = np.stack(np.meshgrid(share, share), -1).reshape(-1, 2) * half
            c, s = np.cos(solid.yaw), np.sin(solid.yaw)
            station, lateral = road.project(grid @ np.array([[c, s], [-s, c]]) + solid.center[:2])
            assert np.abs(lateral).min() > FREE_HALF_WIDTH, obj.name
            inside = (station > -6.0) & (station < spec.line.length)
            assert (road.edges(lateral)[inside] > 0.0).all(), obj.name
            for mouth in spec.line.mouths:
                clear = np.abs(station - mouth.station) > mouth.width / 2
                assert (clear | (lateral * mouth.side < 0.0)).all(), obj.name
    bodies = ("house_", "car_", "tree_", "lamp_", "sign_", "bin_", "bench_", "cabinet_", "stone_", "pole_")
    parts = ("_leaves", "_glass", "_trim", "_roof", "_day", "_lit")
    for obj in place.objects:
        if obj.name.startswith(bodies) and not obj.name.endswith(parts):
            assert obj.solids, obj.name
    assert CLEARANCE > 0.0 and len({obj.name for obj in place.objects}) == len(place.objects)


@pytest.mark.parametrize("number", MOVING)
def test_on_test_days_movable_things_have_moved_and_nothing_else(places, number):
    """They stand up to 1.5 m along the road from where they were filmed, in nobody's way; nothing else changes."""
    filmed, later = places[number], build(sample_place(number), displaced=True)
    assert [obj.name for obj in filmed.objects] == [obj.name for obj in later.objects]
    moved = []
    for before, after in zip(filmed.objects, later.objects, strict=True):
        if np.array_equal(before.part.vertices, after.part.vertices):
            continue
        moved.append(before.name)
        ends = [filmed.route.project(obj.part.vertices[:, :2].mean(0)) for obj in (before, after)]
        assert abs(ends[1][0] - ends[0][0]) < 1.6 and abs(ends[1][1] - ends[0][1]) < 0.1, before.name
    movable = [obj.name for obj in filmed.objects if obj.name.startswith(("car_", "cone_", "bin_", "crate_"))]
    assert moved == movable and any(name.startswith("car_") for name in moved) and len(moved) >= 3
    solids = [(obj.name, solid) for obj in later.objects for solid in obj.solids if solid.kind == "box"]
    for name, solid in solids:
        if name.startswith("car_"):
            others = [one for other, one in solids if other != name]
            gaps = [np.hypot(*(one.center - solid.center)[:2]) - np.hypot(*one.half[:2]) for one in others]
            assert min(gaps) > 0.0, name


@pytest.mark.parametrize("number", BUILT)
def test_the_ground_mesh_is_the_true_ground(places, number):
    """A ray straight down meets the mesh at the ground's stated height, on road and verge."""
    place, spec = places[number], sample_place(number)
    parts = [obj.part for obj in place.objects if obj.kind == "ground"]
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    surface = Surface(np.concatenate([part.vertices for part in parts]), faces)
    rng = np.random.default_rng(0)
    station, lateral = rng.uniform(0.0, spec.line.length, 3000), rng.uniform(-4.0, 4.0, 3000)
    away = place.route.edges(lateral)
    keep = (away < -0.1) | ((away > spec.section.curb_width + 0.1) & (away < spec.section.curb_width + 1.0))
    xy = place.route.at(station, lateral)[keep]
    z = place.route.ground_height(xy)
    origin = np.column_stack([xy, z + 3.0])
    found = 3.0 - surface.cast(origin, np.tile([0.0, 0.0, -1.0], (len(origin), 1)))
    assert np.quantile(np.abs(found), 0.97) < 0.02 and np.abs(found).max() < 0.2


def test_the_films_of_a_place_have_their_height_and_passes(places):
    for number, place in places.items():
        spec = sample_place(number)
        plan = filming.FilmingPlan.of(spec)
        for one in plan.passes:
            _, poses = filming.trajectory(plan, place.route, "sun", one)
            xy = poses[:, :2, 3]
            height = poses[:, 2, 3] - place.route.ground_height(xy)
            assert height.mean() == pytest.approx(spec.film.camera_height, abs=0.01)
            station, lateral = place.route.project(xy)
            assert np.abs(lateral - one.lateral).max() < 0.31
            assert (np.diff(station)[2:-2] < 0.0).all() == one.backwards
            ahead = np.stack([np.cos(place.route.heading(station)), np.sin(place.route.heading(station))], 1)
            facing = (poses[:, :2, 2] * ahead).sum(1)
            assert (facing < 0.0).all() if one.backwards else (facing > 0.0).all()
        text = scene_toml(plan, "x", spec)
        assert text.startswith(f"# A generated place, filmed by twin reality film --place {number} --out THIS_FOLDER\n")
        assert ("PINHOLE" in text) == spec.film.calibrated
        assert text.count("[[source]]") == len(plan.passes) * len(plan.lightings)
        assert text.count("[[task]]") == len(tasks(spec.line))


@pytest.mark.parametrize("number", [3, 5])  # with and without a pass in the left lane
def test_traffic_drives_through_nothing(places, number):
    """Moving cars keep off the camera's track and off parked cars, in every pass; parked cars keep off the camera."""
    place, plan = places[number], filming.FilmingPlan.of(sample_place(number))
    parked = [solid for car in filming.parked_cars(place, plan.start, plan.length) for solid in car.solids]
    stood = place.route.project(np.array([one.center[:2] for one in parked]))[1]
    beside = [np.hypot(*one.half[:2]) if one.half[0] < one.half[1] else one.half[1] for one in parked]
    assert len(parked) >= 4 and any(one.lateral > 1.0 for one in plan.passes) == (number == 3)
    for one in plan.passes:
        name = filming.film_name("sun", one)
        times, poses = filming.trajectory(plan, place.route, name, one)
        track = place.route.project(poses[:, :2, 3])[1]
        assert np.abs(track[:, None] - stood).min() > max(beside) + 0.4
        cars = [mover for mover in filming.movers(place, name, times, poses) if "car" in mover.name]
        assert len(cars) == 2
        for car in cars:
            feet = np.array([car.pose(time)[0] for time in times])
            seen = feet[:, 2] > -40.0
            half = float(np.ptp(car.part.vertices[:, 1])) / 2
            lateral = place.route.project(feet[seen, :2])[1]
            assert seen.any() and np.abs(lateral - track[seen]).min() > half + 0.4
            assert np.abs(lateral[:, None] - stood).min() > half + max(beside)


def test_depth_agrees_with_rays_onto_the_ground(places):
    """Points of the road in a small picture lie on the true ground."""
    place = places[5]
    plan = replace(filming.FilmingPlan.of(sample_place(5)), width=160, height=90, oversize=1.0)
    lighting = plan.lightings[0]
    _, poses = filming.trajectory(plan, place.route, lighting)
    pose = poses[len(poses) // 3]
    light, depth = filming.Renderer(lighting, place, plan)(pose)
    rays = unproject(pixel_grid(160, 90), plan.intrinsics)
    points = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    _, lateral = place.route.project(points[..., :2])
    road = (place.route.edges(lateral) < -0.2) & (depth > 0.0) & (depth < 12.0)
    error = points[road][:, 2] - place.route.ground_height(points[road][:, :2])
    assert road.sum() > 1500 and np.quantile(np.abs(error), 0.98) < 0.015
    assert 0.05 < light.mean() < 0.9


def test_truth_of_a_drawn_place_survives_saving(places, tmp_path):
    spec = sample_place(2)
    films = {}
    plan = filming.FilmingPlan.of(spec)
    for one in plan.passes:
        name = filming.film_name("sun", one)
        times, poses = filming.trajectory(plan, places[2].route, name, one)
        films[name] = TrueFilm(times, poses, np.zeros(0, np.int64), np.zeros((0, 9, 16), np.float16))
    names = dict.fromkeys(films, "sun")
    truth = Truth(
        SampledRoad(spec), 0.0, plan.length, 1.5, plan.intrinsics, spec.film.size, films, 2, names, plan.camera_height
    )
    truth.save(tmp_path)
    back = Truth.load(tmp_path)
    assert back.number == 2 and back.lighting(name) == "sun" and back.camera_height == spec.film.camera_height
    assert np.array_equal(back.films[name].camera_to_world, films[name].camera_to_world)
