"""Benchmarks of the field, the environment and the Husky: budgets, targets, tables, and a run on the real captures.

`test_end_to_end.py` runs the benchmarks that need a built scene.
"""

import importlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from twin.evaluation.trials import EPISODE_COLUMNS, Trial, csv_text
from twin.files import write_json, write_text
from twin.geometry.poses import look_at
from twin.reality import lighting as lighting_module
from twin.reality.filming import FilmingPlan
from twin.reality.lighting import LIGHTINGS
from twin.reality.place_sampling import sample_place
from twin.reality.real_test import Setup
from twin.reality.road_task import true_route
from twin.reality.sampled_road import SampledRoad
from twin.robot import HuskyParams
from twin.scene import SceneDir

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_steps_fill_a_budget_and_leave_a_margin(scripts):
    from field_sections import Pace

    pace = Pace(overhead=20.0, step=0.1)
    assert pace.steps(60.0) == 370 and pace.overhead + 370 * pace.step == pytest.approx(57.0)
    assert pace.steps(10.0) == 1


@pytest.mark.parametrize("route", [25.37, 47.0, 71.2])
def test_stretches_lie_on_their_routes(scripts, route):
    import stretches

    found = [stretches.segment(k, route) for k in stretches.STRETCHES]
    assert found == [stretches.segment(k, route) for k in stretches.STRETCHES] and len(found) == 10
    for start, length in found:
        assert start >= 0.0 and start + length <= route + 0.05 and min(30.0, 25.3) <= length <= 60.0
    assert len(set(found)) == 1 if route < 30.0 else len(set(found)) > 5  # one that fills its route starts at 0


def test_a_stretch_is_measured_once_and_a_failed_one_counts(scripts, monkeypatch, tmp_path, capsys):
    import stretches
    from tiny_twin import tiny_twin

    ran, light = [], "held-out+randomised"

    def scripted(verb, *rest):
        ran.append(verb)
        place = tmp_path / "work" / "place_71"
        if "72" in map(str, rest) or "place_72" in str(rest):
            raise stretches.Failed("twin reality ended with exit status 2")
        if verb == "reality":
            tiny_twin(place)
        elif verb == "train":
            chosen = {"step": 3000, "successes": 39, "trials": 40}
            (place / "runs" / "stretch").mkdir(parents=True)
            write_json(place / "runs" / "stretch" / "choice.json", {"steps": 5000, "why": "reached", "chosen": chosen})
        elif verb == "validate":
            rows = [
                Trial("stretch", "stretch", name, k, "goal" if k else "collision", 3.0, 30)
                for name in (light, "held-out")
                for k in range(4)
            ]
            (place / "validation").mkdir()
            text = csv_text(EPISODE_COLUMNS, [row.row() for row in rows])
            write_text(place / "validation" / "episodes.csv", text)

    monkeypatch.setattr(stretches, "twin", scripted)
    record = tmp_path / "stretches.json"
    monkeypatch.setattr(
        sys, "argv", ["stretches", str(tmp_path / "work"), "--stretches", "1", "2", "--json", str(record)]
    )
    assert stretches.main() == 0
    first, second = json.loads(record.read_text())["stretches"]
    assert (first["name"], first["successes"], first["trials"], first["steps"]) == ("place_71", 3, 4, 5000)
    assert [one["cause"] for one in first["failures"]] == ["collision"] and first["minutes"] is not None
    assert 'name = "stretch"' in (tmp_path / "work" / "place_71" / "scene.toml").read_text()
    assert (second["name"], second["successes"], second["trials"]) == (
        "place_72",
        0,
        100,
    ) and "exit status 2" in second["error"]
    assert "3 of 104" in capsys.readouterr().out
    count = len(ran)
    assert stretches.main() == 0 and len(ran) == count  # recorded stretches are not run again


def test_a_score_over_its_budget_misses_its_target(scripts, monkeypatch):
    import field
    from sections import verdict

    def judged(name, figures):
        return verdict(name, figures, field.TARGETS)

    monkeypatch.setitem(field.TARGETS, "fox.psnr_60s", ("≥", 25.0))
    figures = {"fox.psnr_60s": 26.0, "fox.psnr_60s_unfitted": 25.0, "fox.seconds_60s": 59.0}
    assert judged("fox.psnr_60s", figures) == ("≥ 25", "yes")
    assert judged("fox.psnr_60s", figures | {"fox.psnr_60s": 24.0}) == ("≥ 25", "no")
    assert judged("fox.seconds_60s", figures) == ("≤ 60", "yes")
    overtime = figures | {"fox.seconds_60s": 61.0}
    assert judged("fox.psnr_60s", overtime)[1] == judged("fox.psnr_60s_unfitted", overtime)[1] == "no, took 61.0 s"
    differences = {"gpu.cpu_difference_mean": 1 / 255, "gpu.cpu_difference_max": 0.5}  # only the mean has a target
    assert judged("gpu.cpu_difference_mean", differences) == ("≤ 0.003922", "yes")
    assert judged("gpu.cpu_difference_max", differences) == ("", "")
    assert judged("bake.psnr_drop.sun", {"bake.psnr_drop.sun": 0.3}) == ("", "")


def test_a_missing_gpu_is_reported(scripts, monkeypatch, tmp_path):
    import env
    import warp
    from env_sections import gpu

    monkeypatch.setattr(warp, "is_cuda_available", lambda: False)
    found = gpu(tmp_path, True)
    assert list(found) == ["gpu.none"] and "no CUDA device" in found["gpu.none"]
    assert [name for name in env.TARGETS if name.startswith("gpu.")] == ["gpu.steps_per_s"]


def test_visual_vs_collision_drives_the_robot_of_the_scene(scripts, monkeypatch, tmp_path):
    import overlay

    class Called(Exception):
        pass

    def physics(model, params=None):
        raise Called(params)

    monkeypatch.setattr("twin.env.physics.HuskyPhysics", physics)
    world = SimpleNamespace(model=lambda: None, robot=HuskyParams(friction=0.5))
    opened = SimpleNamespace(world=lambda: world, field=lambda: None, scene=SceneDir(tmp_path))
    monkeypatch.setattr(overlay, "load_scene", lambda path: opened)
    with pytest.raises(Called) as called:
        overlay.visual_vs_collision(tmp_path)
    assert called.value.args == (world.robot,)


def test_a_route_is_compared_with_that_of_its_own_place(scripts, monkeypatch, tmp_path):
    import reality

    route = SampledRoad(sample_place(7))
    there = true_route(FilmingPlan.of(sample_place(7)), route)
    truth = SimpleNamespace(number=7, road_length=0.0, route=route)
    cameras = SimpleNamespace(camera_to_world=route_poses(there))
    monkeypatch.setattr(reality.Truth, "load", lambda _: truth)
    monkeypatch.setattr(reality.Cameras, "load", lambda _: cameras)
    monkeypatch.setattr(reality, "matched_poses", lambda *_: cameras.camera_to_world)
    opened = SimpleNamespace(scene=SceneDir(tmp_path), world=lambda: SimpleNamespace(route=there[20:]))
    monkeypatch.setattr(reality, "load_scene", lambda _: opened)
    found = dict(reality.places_of_tasks(tmp_path))
    assert found["reality.route_off_max_m"] < 1e-6
    along = np.linalg.norm(np.diff(there[:21, :2], axis=0), axis=1).sum()
    assert found["reality.route_begins_later_m"] == pytest.approx(along, abs=1e-6)


def route_poses(route):
    """Level poses (n, 4, 4) at the points of a route."""
    poses = np.tile(np.eye(4), (len(route), 1, 1))
    poses[:, :3, 3] = route
    return poses


def test_pictures_of_days_are_of_the_place_of_the_scene(scripts, monkeypatch, tmp_path, capsys):
    import day
    import sun

    class Taken(Exception):
        pass

    def pictures(setup, light):
        raise Taken(setup, light.name)

    poses = route_poses(np.array([[0.0, 0.0, 1.0], [5.0, 0.0, 1.0], [5.0, 2.0, 1.0]]))
    opened = SimpleNamespace(scene=SceneDir(tmp_path), radiance_field=lambda _: None, field=lambda: None)
    for script in (sun, day):
        monkeypatch.setattr(script, "load_scene", lambda _: opened)
        monkeypatch.setattr(script, "matched_poses", lambda *_: poses)
    monkeypatch.setattr(sun.Truth, "load", lambda _: SimpleNamespace(number=7, road_length=120.0))
    monkeypatch.setattr(sun.Cameras, "load", lambda _: SimpleNamespace(camera_to_world=poses))
    monkeypatch.setattr(sun, "shadow_casters", lambda *_: ())
    monkeypatch.setattr(sun, "day_pictures", pictures)
    monkeypatch.setattr(sys, "argv", ["sun", str(tmp_path), "--camera", "2", "--days", "21"])
    with pytest.raises(Taken) as taken:
        sun.main()
    assert taken.value.args == (Setup(7, 0, 2, 120.0), "day_21")
    monkeypatch.setattr(sys, "argv", ["day", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        day.main()
    assert stop.value.code == 2 and "is a film of place 7; expected one of place 0" in capsys.readouterr().err


def test_the_true_world_of_obstacles_has_the_light_and_the_haze_of_its_place(scripts, monkeypatch):
    """A white wall 20 m ahead, in the place's own `sun`: exposure 0.5 and haze of the horizon's color."""
    import overlay

    def world(lighting, place):
        spec = mujoco.MjSpec()
        spec.worldbody.add_camera(name="film")
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[50, 1, 50], pos=[0, 21, 0], rgba=[1, 1, 1, 1])
        lighting_module.add_lights(spec, place.lightings[lighting], np.zeros((0, 3)))
        return spec

    monkeypatch.setattr(overlay.reality, "world_spec", world)
    monkeypatch.setattr(overlay, "KINDS", ())
    pose = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.0, 5.0, 1.0]))
    light = replace(LIGHTINGS["sun"], horizon=(0.0, 0.0, 1.0), exposure=0.5, suns=(((0, 1, 0), (0, 0, 0), False),))
    seen = {}
    for visibility in (float("inf"), 5.0):
        place = SimpleNamespace(lightings={"sun": replace(light, visibility=visibility)})
        truth = SimpleNamespace(place=place, ground_height=lambda xy: 0.0)
        rgb, depth = overlay.TrueWorld(truth, "sun", np.array([80.0, 80.0, 80.0, 45.0])).render(pose, None, np.eye(4))
        assert depth[45, 80] == pytest.approx(20.0, abs=0.01)
        seen[visibility] = rgb[45, 80]
    np.testing.assert_allclose(seen[float("inf")], 0.5 * np.array(light.ambient), atol=0.01)
    through = np.exp(-20.0 / 5.0)
    np.testing.assert_allclose(seen[5.0][:2], through * seen[float("inf")][:2], atol=0.01)
    assert seen[5.0][2] > 0.45


def test_a_kept_folder_is_compared_with_the_commit_asked_for(scripts, monkeypatch, tmp_path, capsys):
    import sameness

    class Tree(sameness.Tree):
        def python(self, *arguments):
            (Path(arguments[-1]) / "truth").mkdir(parents=True)

        def build(self, scene):
            (scene / "build").mkdir()

        def digests(self, scene, lightings, work):
            return {"text": (self.root / "text").read_text()}

    def git(*arguments):
        subprocess.run(["git", "-C", str(root), "-c", "user.name=a", "-c", "user.email=a@a", *arguments], check=True)

    root = tmp_path / "root"
    root.mkdir()
    git("init", "-q")
    for text in ("old", "new"):
        (root / "text").write_text(text)
        git("add", "text")
        git("commit", "-q", "-m", text)
    monkeypatch.setattr(sameness, "Tree", Tree)
    monkeypatch.setattr(sameness, "_ROOT", root)
    for commit, status in (("HEAD", 0), ("HEAD~1", 1), ("HEAD", 0)):
        monkeypatch.setattr(sys, "argv", ["sameness", commit, "--work", str(tmp_path / "work")])
        assert sameness.main() == status
    assert "0 of 1 results equal those of HEAD~1" in capsys.readouterr().out


def test_scenes_of_one_name_do_not_share_a_record(scripts, monkeypatch, capsys):
    import poles

    monkeypatch.setattr(sys, "argv", ["poles", "old/place_7", "new/place_7"])
    with pytest.raises(SystemExit) as stop:
        poles.main()
    assert stop.value.code == 2 and "two scenes have the same folder name" in capsys.readouterr().err


def test_peak_memory_is_that_of_this_process(scripts):
    from fuzzing.cases import peak_memory

    before = peak_memory()
    block = bytearray(64 * 2**20)
    block[::4096] = b"x" * len(block[::4096])
    assert 32 * 2**20 < peak_memory() < before + 512 * 2**20


@pytest.mark.realdata
@pytest.mark.slow
def test_training_stops_within_its_time_budget(real_data, tmp_path):
    file = tmp_path / "figures.json"
    command = [sys.executable, BENCHMARKS / "field.py", "--quick", "--only", "fox", "gpu", "--data", real_data]
    done = subprocess.run([*map(str, command), "--json", str(file)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(file.read_text())
    assert figures["fox.n"] == 6 and figures["fox.steps_10s"] >= 1
    assert 5.0 < figures["fox.psnr_10s_unfitted"] < 40.0 and figures["fox.frame_size"] == "54x96"
    assert "fox.psnr_10s" in done.stdout and any(name.startswith("gpu.") for name in figures)


def test_the_husky_table_is_printed_and_written(tmp_path):
    file = tmp_path / "husky.json"
    command = [sys.executable, str(BENCHMARKS / "husky.py"), "--only", "A1", "B5", "--json", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = json.loads(file.read_text())["rows"]
    assert [row["id"] for row in rows] == ["A1", "B4", "B5", "B5"] and all(row["passed"] for row in rows)
    assert rows[-1]["high"] is None and rows[-1]["low"] == 0.0  # an open limit
    assert done.stdout.count(" pass\n") == 4 and "motor power / dissipated power" in done.stdout


@pytest.mark.parametrize(("script", "option"), [("husky", "--only"), ("intervals", "--shapes")])
def test_a_run_that_would_measure_nothing_is_refused(scripts, monkeypatch, capsys, script, option):
    monkeypatch.setattr(sys, "argv", [script, option, "b6"])
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(script).main()
    assert stop.value.code == 2 and "b6" in capsys.readouterr().err


def test_steps_per_second_count_the_fastest_repeat_of_each_piece(scripts, monkeypatch):
    import husky
    import mujoco

    clock, pieces = [0.0], []  # per drive, the pieces done

    def step(model, data, count):
        if count == 500:  # to get under way: does not count
            pieces.append(0)
            clock[0] += 1000.0
            return
        pieces[-1] += 1
        delayed = (len(pieces) + pieces[-1]) % 2  # by other work on the machine
        clock[0] += (3.0 if delayed else 1.0) * count / 4000

    monkeypatch.setattr(husky.mujoco, "mj_step", step)
    monkeypatch.setattr(husky.time, "perf_counter", lambda: clock[0])
    cart = "<body><joint name='x'/><geom size='.1'/></body>"
    motors = "<motor joint='x'/><motor joint='x'/>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{cart}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    assert husky.steps_per_second(model) == pytest.approx(4000)
