"""The second renderer of the reality (`benchmarks/cycles`): its light, its sky, and how its trials are compared."""

import importlib.util
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from twin.errors import InputError
from twin.evaluation.trials import Trial
from twin.geometry.poses import look_at
from twin.reality import campus_road, true_world
from twin.reality.lighting import weather
from twin.reality.rasterizer import Rasterizer

FOLDER = Path(__file__).parents[1] / "benchmarks" / "cycles"
PYTHON = Path(os.environ.get("TWIN_BPY_PYTHON", ""))
SIZE = (80, 45)
INTRINSICS = np.array([44.0, 44.0, 40.6, 22.0])


@pytest.fixture
def cycles(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, str(FOLDER)])
    names = ("cycles_renderer", "place_record", "place_scores", "protocol", "record")
    spec = importlib.util.spec_from_file_location("cycles_command", FOLDER / "__main__.py")
    command = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(command)
    yield SimpleNamespace(command=command, renderer=sys.modules["cycles_renderer"])
    for name in names:
        sys.modules.pop(name, None)


def _trial(policy, day, seed, success):
    return Trial(policy, "whole", day, seed, "goal" if success else "collision", 3.0, 30)


def test_the_sky_has_every_direction_where_the_rasterizer_has_it(cycles):
    """The sky above the ground, seen in four directions."""
    light = weather("day_3")
    place = campus_road.build()
    ground = [one for one in place.objects if one.kind == "ground"]
    spec = true_world.world_spec(replace(light, occlusion=0.0), replace(place, objects=ground))
    sky = cycles.renderer.sky_picture(place.sky(light))
    rasterizer = Rasterizer(spec.compile(), INTRINSICS, SIZE, ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)))
    for ahead in ((1, 0, 1.5), (-1, 0.2, 1.5), (0.1, 1, 1.5), (0, -1, 1.5)):
        eye = np.array([0.0, 0.0, 500.0])
        pose = look_at(eye, eye + np.array(ahead, float))
        direction = pose[:3, 2]
        row = int((0.5 - np.arcsin(direction[2]) / np.pi) * len(sky))
        column = int((0.5 - np.arctan2(direction[1], direction[0]) / (2 * np.pi)) * sky.shape[1])
        picture = rasterizer(pose)[0]
        seen = picture[round(INTRINSICS[3] - 0.5), round(INTRINSICS[2] - 0.5)]
        np.testing.assert_allclose(sky[row, column], seen, atol=0.04)


def test_a_uniform_sky_lights_a_white_surface_with_its_own_radiance(cycles):
    sky = np.full((256, 512, 3), [0.2, 0.5, 0.9], np.float32)
    np.testing.assert_allclose(cycles.renderer.light_from_above(sky), [0.2, 0.5, 0.9], rtol=1e-3)
    sky[128:] = 7.0  # what is below the horizon does not count
    np.testing.assert_allclose(cycles.renderer.light_from_above(sky), [0.2, 0.5, 0.9], rtol=1e-3)


def test_the_draw_is_a_fixed_share_that_depends_on_the_place_alone(cycles):
    trials = [_trial(policy, f"day_{d}", seed, True) for policy in "abc" for d in range(4) for seed in range(5)]
    first = cycles.command.drawn(trials, 0.1, 100)
    assert len(first) == len(set(first)) == 6
    assert cycles.command.drawn(trials[::-1], 0.1, 100) == first
    assert cycles.command.drawn(trials, 0.1, 101) != first


def test_trials_are_compared_with_the_recorded_ones_of_the_same_start(cycles):
    own = [_trial(policy, "day_1", seed, policy == "good") for policy in ("good", "bad") for seed in range(4)]
    again = [_trial("good", "day_1", 0, True), _trial("good", "day_1", 3, False), _trial("bad", "day_1", 2, False)]
    found = cycles.command.compare(100, own, again)
    assert (found.trials, found.agree, found.own, found.cycles) == (3, 2, 2, 1)
    assert found.spearman is None  # two policies
    six = [_trial(policy, "day_1", seed, seed < ord(policy) - 97) for policy in "abcdef" for seed in range(6)]
    assert cycles.command.compare(100, six, six[::-1]).spearman == pytest.approx(1.0)


def test_an_interpreter_without_bpy_is_reported(cycles):
    place = campus_road.build()
    with pytest.raises(InputError, match="give a Python interpreter that can import bpy"):
        cycles.renderer.CyclesRenderer(Path("/nowhere/python"), weather("day_3"), place, INTRINSICS, SIZE)
    renderer = cycles.renderer.CyclesRenderer(Path(sys.executable), weather("day_3"), place, INTRINSICS, SIZE)
    with pytest.raises(InputError, match="Cycles ended with status 1: ModuleNotFoundError: No module named 'bpy'"):
        renderer(np.eye(4))
    renderer.close()


@pytest.mark.skipif(not PYTHON.is_file(), reason="TWIN_BPY_PYTHON names no interpreter with bpy")
def test_cycles_and_the_rasterizer_see_the_same_place(cycles):
    place, light = campus_road.build(), weather("day_3")
    rasterizer = Rasterizer(true_world.world_spec(light, place).compile(), INTRINSICS, SIZE)
    renderer = cycles.renderer.CyclesRenderer(PYTHON, light, place, INTRINSICS, SIZE)
    for x in (2.0, 12.0):
        pose = look_at(np.array([x, 0.0, 0.6]), np.array([x + 4.0, 0.0, 0.4]))
        (own, depth), (other, same_depth) = rasterizer(pose), renderer(pose)
        np.testing.assert_array_equal(depth, same_depth)
        gray = [picture.mean(-1) - picture.mean() for picture in (own, other)]
        here = (gray[0] * gray[1]).sum() / np.linalg.norm(gray[0]) / np.linalg.norm(gray[1])
        shifted = [np.roll(gray[1], shift, axis) for axis in (0, 1) for shift in (-2, 2)]
        assert here > 0.8
        assert all((gray[0] * one).sum() / np.linalg.norm(gray[0]) / np.linalg.norm(one) < here for one in shifted)
        assert 0.7 < other.mean() / own.mean() < 1.3
    renderer.close()


def test_trials_are_drawn_from_a_complete_place_only(cycles, tmp_path):
    """After an interruption, a draw from the recorded part would be another one than that from all trials."""
    command = cycles.command
    protocol = command.read_protocol()
    place = protocol.places[0]
    record = tmp_path / protocol.name / f"place_{place}"
    command.keep(record / command.TRIALS, [_trial("varied", protocol.days_of(place)[0], 1, True)])
    given = SimpleNamespace(minutes=1.0, places=[place], results=tmp_path)
    with pytest.raises(InputError, match=f"place_{place} is not complete; first run .* at place {place} to"):
        command._repeat(protocol, given)
