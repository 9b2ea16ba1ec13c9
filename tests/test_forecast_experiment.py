"""The forecast experiment over places: its protocol, its record and its scores (`benchmarks/forecast`)."""

import gzip
import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from twin.errors import InputError
from twin.evaluation.trials import EPISODE_COLUMNS, Trial, csv_text, read_trials
from twin.files import read_json, write_json, write_text

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "benchmarks" / "forecast"
PROTOCOL = tomllib.loads((FOLDER / "protocol.toml").read_text(encoding="utf-8"))
VERSION, PLACES = PROTOCOL["version"], PROTOCOL["places"]
SETUPS = ("varied", "short", "shorter", "not_randomised", "one_light", "simulator")
SEEN_EVERYWHERE = "held-out+randomised"


@pytest.fixture
def forecast(monkeypatch):
    """Modules of the experiment."""
    monkeypatch.syspath_prepend(str(FOLDER.parent))
    monkeypatch.syspath_prepend(str(FOLDER))
    names = ("protocol", "place_record", "place_scores")
    modules = {name: importlib.import_module(name) for name in names}
    spec = importlib.util.spec_from_file_location("forecast_command", FOLDER / "__main__.py")
    command = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(command)
    yield SimpleNamespace(**modules, command=command)
    for name in names:
        sys.modules.pop(name)


# ---- the protocol


def test_the_protocol_takes_places_that_nobody_looked_at(forecast):
    protocol = forecast.protocol.read_protocol()
    assert tuple(protocol.setups) == SETUPS and protocol.setups["varied"] == ()
    before = [forecast.protocol.read_protocol(path) for path in FOLDER.glob("results/*/protocol.toml")]
    assert before and {one.version for one in before} == set(range(1, protocol.version))
    used = [place for one in before for place in one.places]
    assert min(protocol.places) > max(used) and min(used) >= 100 and len(protocol.places) >= 6
    days = [day for place in protocol.places for day in protocol.days_of(place)]
    assert len(set(days)) == len(days) == 10 * len(protocol.places)
    assert protocol.options_of("one_light", ["low_sun", "night"]) == ["--lighting", "low_sun"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("\ntrials = 5", "\ntrials = 4", "trials = 4; expected 5 or more"),
        ("days = 10", "days = 11", "expected 1 to 10, the days of a place"),
        (f"places = [{PLACES[0]}, {PLACES[1]},", f"places = [{PLACES[0]}, {PLACES[0]},", "expected different numbers"),
        ("short = [", "varied = [", "Cannot overwrite a value"),
        (f"version = {VERSION}", f"version = {VERSION}\nday = 3", "unexpected keyword argument 'day'"),
        (f"version = {VERSION}", "", "missing 1 required positional argument: 'version'"),
    ],
)
def test_a_protocol_that_cannot_be_scored_is_refused(forecast, tmp_path, old, new, words):
    text = (FOLDER / "protocol.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "protocol.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        forecast.protocol.read_protocol(path)


# ---- one place, with commands that write what the real ones would


class StandIn:
    """Stands in for the commands: writes their files at once, and stops after `left` calls as if killed."""

    def __init__(self, forecast, left=1000, unplaced=()):
        self.forecast, self.left, self.unplaced, self.calls = forecast, left, unplaced, []

    def must(self, *arguments, cores=1):
        assert self(*arguments) == 0

    def __call__(self, *arguments, cores=1):
        if self.left == 0:
            raise self.forecast.command.TimeIsUp
        self.left -= 1
        words = [str(one) for one in arguments]
        verb = words[1] if words[0] == "twin.reality" else words[0].removeprefix("twin.")
        self.calls.append(verb)

        def after(name, end="--"):
            part = words[words.index(name) + 1 :]
            return part[: next((i for i, one in enumerate(part) if one.startswith(end)), len(part))]

        if verb == "film":
            write_text(_made(Path(after("--out")[0]) / "scene.toml"), "")
        elif verb == "build":
            fields = ("seed", "versions", "field", "metric", "truth", "cautions")
            write_json(_made(Path(words[1]) / "build" / "report.json"), dict.fromkeys(fields, 1))
        elif verb == "align":
            name = "align.json" if words[2].endswith("csv") else "camera.json"
            write_json(_made(Path(words[1]) / "alignment" / name), {})
        elif verb == "relight":
            return 2 if after("--name")[0] in self.unplaced else 0
        elif verb == "train":
            folder = _made(Path(words[1]) / "runs" / after("--run")[0] / "policy.json").parent
            write_json(folder / "policy.json", {"weights": after("--run")[0]})
            write_json(folder / "choice.json", {"steps": 1, "chosen": {}})
        elif verb == "validate":
            table = _made(Path(words[1]) / "validation" / "episodes.csv")
            before = read_trials(table) if table.exists() else []
            names = [Path(one).name for one in after("--policy")]
            _write(table, {*before, *_trials(names, after("--lightings"), int(after("--episodes")[0]))})
        elif verb == "drive":
            out = _made(Path(after("--out")[0]))
            days = [f"day_{n}" for n in after("--day")]
            _write(out.with_name(f"{out.stem}_trials.csv"), _trials([out.stem], days, int(after("--trials")[0])))
            write_json(out.with_name(f"{out.stem}_setup.json"), {"robot": after("--robot")[0]})
        elif verb == "export":
            write_json(Path(after("--task-file")[0]), {})
        return 0


def _made(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write(path, trials):
    write_text(path, csv_text(EPISODE_COLUMNS, [one.row() for one in trials]))


def _trials(policies, lightings, count):
    """Trials in which the first policy always succeeds, and every other policy in every second trial."""
    return [
        Trial(policy, "whole", lighting, k, "goal" if k % 2 or policy == SETUPS[0] else "collision", 3.0, 30, 0.5)
        for policy in policies
        for lighting in lightings
        for k in range(count)
    ]


@pytest.fixture
def filmed(monkeypatch, forecast):
    names = SimpleNamespace(names=["sun", "night"])
    scene = SimpleNamespace(field=lambda: SimpleNamespace(lightings_by_name=SimpleNamespace(filmed=lambda: names)))
    monkeypatch.setattr(forecast.command, "load_scene", lambda _: scene)


def _place(forecast, tmp_path, run, name="a"):
    protocol = forecast.protocol.read_protocol()
    return forecast.command.PlaceRun(protocol, PLACES[0], tmp_path / name, tmp_path / f"results_{name}", run, 1)


def test_a_place_that_cannot_be_built_is_recorded_as_failed_and_not_run_again(forecast, tmp_path, capsys):
    protocol = forecast.protocol.read_protocol()
    run = StandIn(forecast)
    run.must = lambda *arguments, cores=1: _fails_at(run, "twin.build", arguments, forecast.command.Refused)
    place = forecast.command.PlaceRun(protocol, PLACES[0], tmp_path / "work", tmp_path / "results", run, 1)
    with pytest.raises(InputError, match="no reconstructed point"):
        forecast.command.run_place(place, None)
    failure = {"step": "build", "message": "robot.mp4: no reconstructed point"}  # without the machine's folders
    assert read_json(tmp_path / "results" / f"version_{VERSION}" / f"place_{PLACES[0]}" / "failure.json") == failure
    forecast.command.run_place(place, None)
    assert run.calls == ["film"]
    found = forecast.place_scores.score(protocol, tmp_path / "results")
    assert found["places"][str(PLACES[0])] == "failed: build: robot.mp4: no reconstructed point"
    assert "failed: build: robot.mp4: no reconstructed point" in forecast.place_scores.tables(protocol, found)


def _fails_at(run, command, arguments, kind):
    if arguments[0] == command:
        raise kind(f"{arguments[1]}/robot.mp4: no reconstructed point")
    assert run(*arguments) == 0


def test_a_full_disk_leaves_the_place_unfinished(forecast, tmp_path, monkeypatch):
    monkeypatch.setattr(forecast.command.shutil, "disk_usage", lambda _: SimpleNamespace(free=2**30))
    place = forecast.command.PlaceRun(
        forecast.protocol.read_protocol(), PLACES[0], tmp_path / "work", tmp_path / "results", StandIn(forecast), 1
    )
    with pytest.raises(InputError, match=r"1\.0 GiB are free \(need 8 GiB\)"):
        forecast.command.run_place(place, None)
    assert not (place.record / "failure.json").exists()


def test_a_command_that_is_killed_leaves_the_place_unfinished(forecast, tmp_path):
    run = StandIn(forecast)
    run.must = lambda *arguments, cores=1: _fails_at(run, "twin.build", arguments, InputError)
    place = forecast.command.PlaceRun(
        forecast.protocol.read_protocol(), PLACES[0], tmp_path / "work", tmp_path / "results", run, 1
    )
    with pytest.raises(InputError):
        forecast.command.run_place(place, None)
    assert not place.record.exists()


def test_the_message_of_a_failed_command_is_kept(forecast, tmp_path):
    with pytest.raises(forecast.command.Refused, match=r"twin\.build ended with exit status 2: no scene.toml at"):
        forecast.command.Commands(5.0).must("twin.build", tmp_path / "nothing")


def test_policies_are_frozen_before_anything_drives_and_a_repeat_changes_nothing(forecast, filmed, tmp_path):
    run = StandIn(forecast)
    one = _place(forecast, tmp_path, run)
    forecast.command.run_place(one, None)
    assert run.calls[0] == "film" and run.calls.count("photo") == 10 and run.calls.count("train") == 6
    assert max(i for i, call in enumerate(run.calls) if call == "train") < run.calls.index("validate")
    assert max(i for i, call in enumerate(run.calls) if call == "validate") < run.calls.index("drive")
    assert set(read_json(one.record / "policies.json")) == set(SETUPS)
    assert read_json(one.record / "place.json")["setup"] == {"robot": str(PLACES[0])}
    before = {path.name: path.read_bytes() for path in one.record.iterdir()}
    forecast.command.run_place(one, None)
    assert before == {path.name: path.read_bytes() for path in one.record.iterdir()}
    record = forecast.place_record.read_place(one.record, PLACES[0], one.protocol)
    assert record.real.shape == (6, 10, 2) and record.real[0].tolist() == [[5, 5]] * 10
    assert record.twin[1].tolist() == [[2, 5]] * 10 and record.held_out.tolist() == [[20, 20]] + [[10, 20]] * 5


def test_an_experiment_stopped_at_every_command_ends_with_the_same_record(forecast, filmed, tmp_path):
    whole, pieces = _place(forecast, tmp_path, StandIn(forecast)), None
    forecast.command.run_place(whole, None)
    for _ in range(20):  # 13 commands are enough to repeat what is done and go a step further
        pieces = _place(forecast, tmp_path, StandIn(forecast, left=13), "b")
        try:
            forecast.command.run_place(pieces, None)
            break
        except forecast.command.TimeIsUp:
            pieces = None
    assert pieces is not None
    for path in whole.record.iterdir():
        assert path.read_bytes() == (pieces.record / path.name).read_bytes(), path.name


def test_a_day_whose_photo_cannot_be_placed_is_left_to_the_held_out_lightings(forecast, filmed, tmp_path):
    one = _place(forecast, tmp_path, StandIn(forecast, unplaced=(f"day_{PLACES[0]}3",)))
    forecast.command.run_place(one, None)
    record = forecast.place_record.read_place(one.record, PLACES[0], one.protocol)
    assert record.twin[1, 2].tolist() == [10, 20] and record.twin[1, 3].tolist() == [2, 5]


@pytest.mark.parametrize("name", ["trials.csv.gz", "episodes.csv.gz"])
def test_a_place_that_was_stopped_within_a_day_is_not_scored(forecast, filmed, tmp_path, name):
    one = _place(forecast, tmp_path, StandIn(forecast))
    forecast.command.run_place(one, None)
    trials = read_trials(one.record / name)
    (one.record / name).unlink()
    forecast.place_record.keep(one.record / name, trials[:-1])
    assert forecast.place_record.read_place(one.record, PLACES[0], one.protocol) is None
    assert forecast.place_scores.score(one.protocol, one.record.parents[1])["places"][str(PLACES[0])] == "trained"


def test_a_record_never_loses_or_changes_a_row(forecast, filmed, tmp_path):
    one = _place(forecast, tmp_path, StandIn(forecast))
    forecast.command.run_place(one, None)
    table = one.record / "trials.csv.gz"
    before, trials = table.read_bytes(), read_trials(table)
    changed = Trial(*(getattr(trials[0], name) for name in ("policy", "task", "lighting", "seed")), "stuck", 1.0, 9)
    for fewer in (trials[1:], [changed, *trials[1:]]):
        with pytest.raises(InputError, match=r"has 1 rows that the new table lacks.* it is kept"):
            forecast.place_record.keep(table, fewer)
        assert table.read_bytes() == before
    write_json(one.scene / "runs" / "short" / "policy.json", {"weights": "others"})
    with pytest.raises(InputError, match="has other policies than those trained now"):
        forecast.command.run_place(one, None)
    table.write_bytes(gzip.compress(b"nonsense"))
    with pytest.raises(InputError, match="header 'nonsense'"):
        read_trials(table)
    table.write_bytes(b"nonsense")
    with pytest.raises(InputError, match=r"is damaged .*; restore it"):
        read_trials(table)


@pytest.mark.parametrize("script", [[str(FOLDER)], [str(FOLDER.parent / "cycles"), "trials"]])
def test_a_place_that_the_protocol_lacks_is_refused(script, tmp_path):
    command = [sys.executable, *script, str(tmp_path), "--places", "9", "--results", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)  # else it would film the place
    assert done.returncode == 2 and done.stderr.startswith("error: place 9: the protocol has 118, 119, 120")


# ---- scores


def _records(forecast, protocol, results, look, places=6, noise=0.0):
    """Places whose policies have the rates 0, 0.2, ... 1 on the road, and `look(rates, day)` in the twin."""
    rng = np.random.default_rng(3)
    for place in protocol.places[:places]:
        order, days = rng.permutation(6), protocol.days_of(place)
        road, twin = [], []
        for policy, rate in zip(SETUPS, order / 5, strict=True):
            for k, day in enumerate(days):
                mine = np.clip(rate + noise * rng.standard_normal(), 0, 1)
                road += _counted(policy, day, round(5 * mine), 5)
                twin += _counted(policy, f"{day}+randomised", round(5 * look(mine, k)), 5)
            twin += _counted(policy, SEEN_EVERYWHERE, round(20 * look(rate, 0)), 20)
        folder = results / protocol.name / f"place_{place}"
        for name, trials in (("trials.csv.gz", road), ("episodes.csv.gz", twin)):
            forecast.place_record.keep(folder / name, trials)


def _counted(policy, lighting, won, count):
    return [Trial(policy, "whole", lighting, k, "goal" if k < won else "stuck", 1.0, 9) for k in range(count)]


def test_tables_may_be_cut_by_another_program(tmp_path):
    """As by `| head`: no traceback, and the scores are stored."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, str(FOLDER), "--tables", "--results", str(tmp_path)]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "") and list(tmp_path.glob("*/scores.json"))


def test_a_twin_that_agrees_with_the_road_reaches_what_is_wanted_and_beats_the_baselines(forecast, tmp_path):
    protocol = forecast.protocol.read_protocol()
    _records(forecast, protocol, tmp_path, lambda rate, _: rate, noise=0.2)
    found = forecast.place_scores.score(protocol, tmp_path)
    assert set(found["places"].values()) == {"complete"}
    best = found["ranking"][forecast.place_scores.TWIN]
    assert best["spearman_within"]["value"] > 0.99 and best["mmrv"]["value"] < 0.01
    assert {name: found["met"][name] for name in ("spearman_within", "spearman_over_all", "mmrv", "regret")} == {
        "spearman_within": True,
        "spearman_over_all": True,
        "mmrv": True,
        "regret": True,
    }
    assert found["met"]["log_score_better"] is True and found["met"]["varied_mean"] is False
    assert all(row["gain"]["low"] > 0 for name, row in found["days"].items() if row["gain"])
    text = forecast.place_scores.tables(protocol, found)
    assert "6 of 6 places are complete" in text and "spearman_within (0.85): reached" in text


def test_a_twin_that_says_nothing_is_not_better_than_a_baseline(forecast, tmp_path):
    protocol = forecast.protocol.read_protocol()
    _records(forecast, protocol, tmp_path, lambda rate, day: float(day % 2), noise=0.2)
    found = forecast.place_scores.score(protocol, tmp_path)
    assert found["met"]["log_score_better"] is False
    assert found["days"][forecast.place_scores.MEAN]["gain"]["high"] < 0


def test_a_twin_without_any_differences_has_no_rank_within_a_place(forecast, tmp_path):
    protocol = forecast.protocol.read_protocol()
    _records(forecast, protocol, tmp_path / "all", lambda *_: 0.0)
    for name in (forecast.place_scores.TWIN, forecast.place_scores.HELD_OUT):
        none = forecast.place_scores.score(protocol, tmp_path / "all")["ranking"][name]
        assert none["ranked"] == 6 and none["spearman_within"]["value"] == 0.0
        assert none["bias"]["value"] == pytest.approx(0.5)  # from ratios of counts: shrunk ones are not 0


def test_baselines_do_not_look_at_the_twin_or_at_the_own_place(forecast, tmp_path):
    protocol = forecast.protocol.read_protocol()
    setup, mean = forecast.place_scores.SETUP, forecast.place_scores.MEAN
    scores = []
    for name, look in (("a", lambda rate, _: rate), ("b", lambda rate, _: 1 - rate)):
        _records(forecast, protocol, tmp_path / name, look)
        scores.append(forecast.place_scores.score(protocol, tmp_path / name))
    assert scores[0]["ranking"][setup] == scores[1]["ranking"][setup]
    for name in (setup, mean):
        assert scores[0]["days"][name]["log"] == scores[1]["days"][name]["log"]
    assert scores[1]["ranking"][forecast.place_scores.TWIN]["spearman_within"]["value"] < -0.99


def test_few_places_have_no_intervals_and_what_is_incomplete_is_named(forecast, tmp_path):
    protocol = forecast.protocol.read_protocol()
    empty = forecast.place_scores.score(protocol, tmp_path)
    assert set(empty["places"].values()) == {"not begun"} and "ranking" not in empty
    _records(forecast, protocol, tmp_path, lambda rate, _: rate, places=2)
    (tmp_path / protocol.name / f"place_{PLACES[3]}").mkdir()
    found = forecast.place_scores.score(protocol, tmp_path)
    assert [found["places"][str(n)] for n in PLACES[:4]] == ["complete", "complete", "not begun", "begun"]
    best = found["ranking"][forecast.place_scores.TWIN]
    assert best["spearman_within"] == {"value": pytest.approx(1.0), "low": None, "high": None}
    assert found["met"]["log_score_better"] is None
    assert "2 of 6 places are complete" in forecast.place_scores.tables(protocol, found)


def test_at_the_deadline_or_by_a_signal_commands_are_ended(forecast):
    wait = ("timeit", "-n", "1", "-r", "1", "-s", "import time", "time.sleep(60)")
    began = time.monotonic()
    with pytest.raises(forecast.command.TimeIsUp):
        forecast.command.Commands(0.02)(*wait)
    commands = forecast.command.Commands(10)
    threading.Timer(1.0, commands.stop).start()
    with ThreadPoolExecutor(2) as pool, pytest.raises(forecast.command.TimeIsUp):
        list(pool.map(lambda _: commands(*wait), range(2)))
    assert time.monotonic() - began < 30
    with pytest.raises(forecast.command.TimeIsUp):
        commands(*wait)
