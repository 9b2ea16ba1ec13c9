"""Training runs: resumption, refusals, and the tables and policies of a run."""

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from safetensors.torch import load_file
from tiny_twin import tiny_twin

import twin
from twin import commands, runtime
from twin import train as train_verb
from twin.config_file import load_config
from twin.env.domain_randomization import Ranges
from twin.env.route_segments import find_task
from twin.errors import InputError
from twin.evaluation.trials import csv_text
from twin.files import write_json
from twin.learn import selection, teacher, train_config, training
from twin.learn.policy import load_policy
from twin.learn.sb3_env import DriveVecEnv
from twin.learn.teacher import STATE_SCALES, Teacher, load_teacher, teacher_result, train_teacher
from twin.learn.train_config import TrainConfig
from twin.learn.training import TRAINING_EPISODE_COLUMNS, Segment, _keep_rows, check_same, checkpoint_folder
from twin.learn.training import train as train_policy
from twin.runtime import exclusive_lock


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return tiny_twin(tmp_path_factory.mktemp("twin"))


SHORT = TrainConfig(
    task="ahead",
    lighting="day",
    steps=240,
    worlds=4,
    starts=40,
    batch=16,
    buffer=400,
    convolutions=((8, 8, 8),),
    features=16,
    hidden=(16,),
    save_every=80,
    checkpoints=3,
    updates=0.25,
    teacher_steps=80,
    whole_worlds=4,
)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_run_killed_at_random_three_times_finishes(scene, tmp_path):
    """It is killed by SIGKILL. All steps are there, tables have no gap and no repetition, and the policy drives."""
    folder = tmp_path / "run"
    code = (
        "import sys, dataclasses; sys.path.insert(0, sys.argv[3])\n"
        "from pathlib import Path; import twin\n"
        "from twin.learn.training import train\n"
        "from test_training import SHORT\n"
        "train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), SHORT)\n"
    )
    command = [sys.executable, "-c", code, str(scene), str(folder), str(Path(__file__).parent)]
    rng = np.random.default_rng(0)
    for wanted in sorted(rng.choice([1, 2], 3)):
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        while process.poll() is None and len(rows_of(folder)) < wanted:
            time.sleep(0.02)
        time.sleep(float(rng.uniform(0.0, 0.3)))
        process.send_signal(signal.SIGKILL)
        process.wait()
    done = subprocess.run(command, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    head = json.loads((folder / "state" / "state.json").read_text())
    assert head["steps"] == SHORT.steps
    steps = [int(r["step"]) for r in rows(folder / "episodes.csv")]
    assert steps == sorted(steps) and max(steps, default=0) <= SHORT.steps
    seeds = [r["seed"] for r in rows(folder / "episodes.csv")]
    assert len(set(seeds)) == len(seeds)
    assert [int(r["step"]) for r in rows(folder / "log.csv")] == [80, 160, 240]
    assert head["buffer"]["written"] >= SHORT.steps // SHORT.worlds
    with np.load(folder / "state" / head["folder"] / "buffer.npz") as data:
        assert data["ages"].shape[0] == SHORT.worlds and data["states"].shape[2] == len(STATE_SCALES)
    assert load_policy(folder)(np.zeros((12, 90, 160), np.uint8)).shape == (1,)
    assert len(list((folder / "checkpoints").iterdir())) >= 2
    assert load_file(folder / "state" / head["folder"] / "tensors.safetensors")


def rows_of(folder: Path) -> list[dict[str, str]]:
    return rows(folder / "log.csv") if (folder / "log.csv").exists() else []


def test_a_run_is_resumed_with_its_configuration_and_road_alone(scene, tmp_path):
    from twin.learn.training import train as run

    built, toml = twin.load_scene(scene), scene / "scene.toml"
    run(built, tmp_path, replace(SHORT, steps=8), processes=1)
    before = {
        path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and "tensorboard" not in path.parts
    }
    for steps in (8, 4):  # it is finished
        run(built, tmp_path, replace(SHORT, steps=steps), processes=1)
    with pytest.raises(InputError, match=r"gamma = 0\.97"):
        run(built, tmp_path, replace(SHORT, gamma=0.9), processes=1)
    text = toml.read_text()
    try:
        toml.write_text(text + '\n[[obstacle]]\nkind = "cone"\nstation = 2.0\n')
        with pytest.raises(InputError, match="obstacles were changed"):
            run(built, tmp_path, replace(SHORT, steps=16), processes=1)
    finally:
        toml.write_text(text)
    assert before == {path: path.read_bytes() for path in before}
    run(built, tmp_path, replace(SHORT, steps=16), processes=1)
    assert json.loads((tmp_path / "state" / "state.json").read_text())["steps"] == 16


def test_the_default_number_of_steps_follows_from_the_length_of_the_task(scene, monkeypatch, capsys):
    def told(twin, folder, config, *_):
        raise InputError(f"{config.steps} steps")

    monkeypatch.setattr(train_verb, "_train", told)
    length = find_task("ahead", twin.load_scene(scene).world(), load_config(scene / "scene.toml").task).length
    monkeypatch.setattr(train_config, "steps_for", lambda asked: round(1000 * asked))
    for options, steps in (([], round(1000 * length)), (["--steps", "7"], 7), (["--preset", "gpu"], 60_000)):
        assert commands.main("train", [str(scene), "--run", "steps", "--task", "ahead", *options]) == 2
        assert f" {steps} steps" in capsys.readouterr().err


def test_the_verb_trains_and_refuses_what_it_cannot_begin_or_resume(scene, capsys, monkeypatch):
    for name, value in (("_BATCHES", (2,)), ("_TEST_EPISODES", 2), ("_ROUNDS", ((1, 2),)), ("FRESH_EPISODES", 3)):
        monkeypatch.setattr(selection, name, value)
    common = [str(scene), "--run", "one", "--quiet", "--worlds", "2", "--processes", "1", "--steps", "4"]
    common += ["--teacher-steps", "8"]
    assert commands.main("train", [*common, "--task", "strait"]) == 2
    assert commands.main("train", [*common, "--task", "ahead", "--lighting", "dusk"]) == 2
    told = capsys.readouterr().err
    assert told.count("error: ") == 2 and "dusk" in told
    assert not (scene / "runs/one/config.json").exists()
    assert commands.main("train", [*common, "--task", "ahead", "--observe", "simulator"]) == 0
    assert (scene / "runs/one/success.png").exists()
    trained = load_policy(scene / "runs/one").trained
    assert trained["observe"] == "simulator"
    assert trained["camera"] == list(twin.load_scene(scene).world().intrinsics)
    choice = json.loads((scene / "runs/one/choice.json").read_text())
    assert choice["steps"] == 4 and choice["chosen"]["trials"] == 3
    assert commands.main("train", [*common, "--task", "ahead", "--lighting", "day"]) == 2
    assert "error: " in capsys.readouterr().err


def test_two_trainings_of_one_run_do_not_mix(scene, capsys):
    with exclusive_lock(scene / "runs/.locked.lock", "x"):
        assert (
            commands.main("train", [str(scene), "--task", "ahead", "--run", "locked", "--quiet", "--steps", "4"]) == 2
        )
    assert "locked is being trained by process" in capsys.readouterr().err
    assert not (scene / "runs/locked").exists()


@pytest.mark.slow
def test_resumptions_have_episodes_of_their_own(scene, tmp_path, monkeypatch):
    given, whole = [], training.DriveVecEnv.seed

    def spy(worlds, seed=None):
        given.append(seed)
        return whole(worlds, seed)

    monkeypatch.setattr(training, "train_teacher", lambda *_: (Teacher(1), 0))
    monkeypatch.setattr(training.DriveVecEnv, "seed", spy)
    for seed in (0, 1):
        for steps in (8, 16, 24):
            training.train(twin.load_scene(scene), tmp_path / str(seed), replace(SHORT, seed=seed, steps=steps))
    assert len(given) == 12  # the environment is made with the run's seed, which is without effect
    worlds = [seed + i for seed in given[1::2] for i in range(SHORT.worlds)]
    assert len(set(worlds)) == len(worlds)
    others = [
        range(100),
        *(range(k * 1_000_000, k * 1_000_000 + 100_000) for k in (2, 3, 7)),
        range(1_000_000_000, 1_900_000_000),
    ]
    assert not any(seed in few for seed in worlds for few in others)


_WRONG: list[tuple[str, object]] = [
    *[("seed", -1), ("seed", 2**32), ("steps", 0), ("steps", 10**30), ("worlds", 0), ("worlds", 99_999_999)],
    *[("updates", 0.0), ("updates", float("nan")), ("entropy", float("inf")), ("steering", float("nan"))],
    *[("colours", -1.0), ("colours", float("nan")), ("batch", 0), ("buffer", 10**12), ("hidden", (10**9,))],
    *[("convolutions", ((0, 5, 3),)), ("worlds", True), ("gamma", "high"), ("observe", "eyes"), ("device", "tpu")],
]


@pytest.mark.parametrize(
    "wrong",
    [
        *({name: value} for name, value in _WRONG),
        {"lighting": "held-out"},
    ],
)
def test_impossible_configurations_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        TrainConfig(**wrong)


def test_a_training_without_the_gpu_it_needs_is_refused_before_it_begins(scene, tmp_path, monkeypatch):
    """stable-baselines3 would train on the CPU instead."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(InputError, match=r"device = 'cuda': no CUDA device is visible to torch; use --device cpu"):
        train_policy(twin.load_scene(scene), tmp_path / "run", replace(SHORT, device="cuda"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("sizes", [{"pool": 3}, {"hidden": 64}, {"convolutions": ((16, 90, 1),)}, {"features": 5000}])
def test_networks_that_do_not_exist_are_refused(sizes):
    with pytest.raises(InputError, match="no network of these sizes"):
        TrainConfig(**sizes)


def test_a_stopped_run_is_saved_and_resumes(scene, tmp_path):
    from twin.learn.training import train as run

    def interrupt(steps) -> None:
        if steps == 120:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        run(twin.load_scene(scene), tmp_path, SHORT, interrupt)
    head = json.loads((tmp_path / "state" / "state.json").read_text())
    assert (head["steps"], head["buffer"]["written"]) == (120, 31)
    seen = []
    run(twin.load_scene(scene), tmp_path, SHORT, seen.append, processes=1)
    assert seen[0] == 124 and seen[-1] == SHORT.steps
    checkpoints = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert checkpoints == ["000000080", "000000160", "000000240"]


def test_the_log_has_the_policys_errors(scene, tmp_path):
    config = replace(SHORT, steps=120, save_every=40, starts=0, updates=0.1)
    train_policy(twin.load_scene(scene), tmp_path, config, processes=1)
    errors = [(float(row["action_error"]), float(row["state_error"])) for row in rows(tmp_path / "log.csv")]
    assert len(errors) == 3 and all(0.0 < one < 3.0 for row in errors for one in row)


def test_all_but_some_environments_drive_short_episodes(scene, tmp_path):
    """With few and with many processes alike."""
    config = replace(SHORT, steps=160, whole_worlds=1, along_time=0.5, speed=0.2)
    for processes in (1, 2):
        train_policy(twin.load_scene(scene), tmp_path / str(processes), config, processes=processes)
    one, two = ([{**row, "wall_s": ""} for row in rows(tmp_path / n / "episodes.csv")] for n in "12")
    assert one == two
    assert len(one) >= 3 * (160 // 4 // 5 - 1)
    for row in one:
        assert float(row["start_m"]) > 0.0 and int(row["steps"]) <= 5
        assert (row["cause"] == "") == (row["steps"] == "5") or row["cause"] == "goal"


@pytest.mark.parametrize("whole", [0, 5])
def test_at_least_one_environment_drives_short_episodes(scene, tmp_path, whole):
    config = replace(SHORT, steps=24, worlds=2, whole_worlds=whole, along_time=0.2)
    train_policy(twin.load_scene(scene), tmp_path, config, processes=1)
    assert len(rows(tmp_path / "episodes.csv")) == pytest.approx(12 if whole == 0 else 6, abs=1 + (whole == 0))


def test_a_teacher_is_trained_once_and_repeatably(scene, tmp_path, monkeypatch):
    built = twin.load_scene(scene)
    given = []
    monkeypatch.setattr(training, "train_teacher", lambda *a: given.append(train_teacher(*a)) or given[-1])
    for steps in (8, 16):
        train_policy(built, tmp_path / "run", replace(SHORT, steps=steps), processes=1)
    assert len(given) == 1
    kept = load_teacher(tmp_path / "run/state", 1)
    again, successes = train_teacher(built, SHORT, processes=1)
    for a, b in zip(kept.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    assert teacher_result(tmp_path / "run/state") == {"successes": successes, "trials": SHORT.worlds}
    other, _ = train_teacher(built, replace(SHORT, seed=1), processes=1)
    assert not torch.equal(other.mean.weight, again.mean.weight)
    (tmp_path / "run/state/teacher.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match=r"teacher\.safetensors.*train again under another name"):
        train_policy(built, tmp_path / "run", replace(SHORT, steps=24), processes=1)


@pytest.mark.slow
def test_a_teacher_learns_to_drive(scene):
    config = TrainConfig(task="bend", lighting="day", teacher_steps=8_000)
    learnt, successes = train_teacher(twin.load_scene(scene), config, processes=1)
    assert successes == TrainConfig().worlds
    states = torch.zeros((2, len(STATE_SCALES)))
    states[:, 0], states[:, 2] = 1.0, torch.tensor([-0.5, 0.5])  # to the right of the route, and to the left
    left, right = learnt(states).ravel().tolist()
    assert left > 0.05 and right < -0.05


@pytest.mark.parametrize(("action", "cause", "cut"), [(0.0, "goal", True), (1.0, "out_of_bounds", False)])
def test_the_goal_is_no_terminal_state_for_a_teacher(scene, action, cause, cut):
    straight = {"start_along": 0.0, "start_offset": 0.0, "start_heading": 0.0}
    config = replace(SHORT, worlds=1)
    envs = teacher._StateVecEnv(twin.load_scene(scene), config, 0, 1, {**config.teacher_options(), **straight})
    envs.reset()
    over = [False]
    while not over[0]:
        _, _, over, infos = envs.step(np.full((1, 1), action, np.float32))
    assert (infos[0]["cause"], infos[0]["TimeLimit.truncated"]) == (cause, cut)
    assert np.abs(infos[0]["terminal_observation"]).max() <= 3.0
    envs.close()


def test_a_mistake_is_told_before_the_teacher_is_trained(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "train_teacher", lambda *_: pytest.fail("trained"))
    with pytest.raises(InputError, match="dusk"):
        train_policy(twin.load_scene(scene), tmp_path, replace(SHORT, lighting="dusk"), processes=1)


def test_a_signal_stops_the_teacher(scene, tmp_path, monkeypatch):
    whole = training.train_teacher

    def interrupted(built, config, processes, watch):
        def also(steps):
            signal.raise_signal(signal.SIGTERM)
            watch(steps)

        return whole(built, config, processes, also)

    monkeypatch.setattr(training, "train_teacher", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train_policy(twin.load_scene(scene), tmp_path, SHORT, processes=1)
    assert not (tmp_path / "state/state.json").exists() and not (tmp_path / "state/teacher.safetensors").exists()

    def ended(built, config, processes, watch):
        out = whole(built, config, processes, watch)
        signal.raise_signal(signal.SIGTERM)
        return out

    monkeypatch.setattr(training, "train_teacher", ended)
    with pytest.raises(KeyboardInterrupt):
        train_policy(twin.load_scene(scene), tmp_path, SHORT, processes=1)
    assert json.loads((tmp_path / "state/state.json").read_text())["steps"] == 0
    train_policy(twin.load_scene(scene), tmp_path, replace(SHORT, steps=8), processes=1)  # with the same teacher
    assert json.loads((tmp_path / "state/state.json").read_text())["steps"] == 8


def test_teachers_of_neighboring_seeds_drive_other_episodes(scene, monkeypatch):
    given, whole = [], DriveVecEnv.seed

    def spy(worlds, seed=None):
        given.append(seed)
        return whole(worlds, seed)

    monkeypatch.setattr(DriveVecEnv, "seed", spy)
    used = []
    for seed in (0, 1):
        train_teacher(twin.load_scene(scene), replace(SHORT, seed=seed), processes=1)
        used += [given[-2], given[-1]]  # of training and test; before, the environments are made with the run's seed
    assert len({seed + i for seed in used for i in range(SHORT.worlds)}) == 4 * SHORT.worlds


def test_fractions_of_updates_add_up(scene, tmp_path):
    few = replace(SHORT, steps=80, starts=0, updates=0.1)
    train_policy(twin.load_scene(scene), tmp_path, few, processes=1)
    assert json.loads((tmp_path / "state" / "state.json").read_text())["updates"] == 8


def test_only_failures_have_a_reward_of_their_own():
    rewards = TrainConfig().options()["rewards"]
    assert (rewards.goal, rewards.collision, rewards.out_of_bounds) == (0.0, -4.0, -5.0)


def test_tests_break_off_no_episode_of_the_training(scene, tmp_path):
    """Else the success rate lacks long episodes, all successes of a route that takes longer than the time between."""
    driven = {}
    for tested in (False, True):
        folder = tmp_path / str(tested)

        def referee(step, drive, folder=folder, tested=tested):
            if tested and step:
                assert len(drive(checkpoint_folder(folder, step), [5, 6], lambda: None)) == 2
            return Segment(step + 40, None) if step < 200 else None

        train_policy(twin.load_scene(scene), folder, SHORT, processes=1, referee=referee)
        driven[tested] = [{**row, "wall_s": ""} for row in rows(folder / "episodes.csv")]
    assert driven[True] == driven[False]
    log = [{name: float(value) for name, value in row.items()} for row in rows(tmp_path / "True" / "log.csv")]
    for before, row in pairwise(log):  # speeds are those of a segment, here 40 steps, without its test
        assert row["steps_per_s"] * (row["wall_s"] - before["wall_s"] + 0.1) >= 40
    assert any(int(row["step"]) // 40 > (int(row["step"]) - 4 * int(row["steps"])) // 40 for row in driven[True])


@pytest.mark.parametrize(("given", "expected"), [(None, 2), (1, 1)])
def test_environments_for_tests_add_no_processes(scene, tmp_path, monkeypatch, given, expected):
    """Four environments get two processes, as without the four of the tests."""

    class Made(Exception):
        """Ends the training as soon as its environments would be made."""

    def made(built, task, count, seed, processes, spare, **options):
        assert (count, processes, spare) == (4, expected, 4)
        raise Made

    monkeypatch.setattr("twin.env.vector_env.available_cores", lambda: 8)
    monkeypatch.setattr(training, "DriveVecEnv", made)
    with pytest.raises(Made):
        training.train(twin.load_scene(scene), tmp_path, SHORT, processes=given, referee=lambda *_: None)


def test_a_resumed_training_keeps_the_episodes_before_its_state(tmp_path):
    path = tmp_path / "episodes.csv"
    rows = [
        (str(step), "1.0", "7", "training", "1", "goal", "3.0", "8", "1.0", start)
        for step, start in ((8, "0.00"), (16, "7.50"), (32, "0.10"), (40, "0.00"))
    ]
    path.write_text(csv_text(TRAINING_EPISODE_COLUMNS, rows) + "24,1.0,7,train")  # it was killed while it wrote
    _keep_rows(path, TRAINING_EPISODE_COLUMNS, 32)
    assert path.read_text() == csv_text(TRAINING_EPISODE_COLUMNS, rows[:3])


@pytest.mark.parametrize("line", ["x" + 9 * ",1", "8" + 8 * ",1" + "," + "9" * 200_000, "8\x00" + 9 * ",1"])
def test_a_resumed_training_refuses_damaged_episodes(tmp_path, line):
    path = tmp_path / "episodes.csv"
    path.write_text(csv_text(TRAINING_EPISODE_COLUMNS, ()) + line + "\n")
    with pytest.raises(InputError, match=r"episodes\.csv .*; delete its damaged lines, or train again"):
        _keep_rows(path, TRAINING_EPISODE_COLUMNS, 32)
    assert line in path.read_text()


def test_a_run_of_an_earlier_version_is_refused(tmp_path):
    write_json(tmp_path / "config.json", {"road": "x", "steps": 8})
    with pytest.raises(InputError, match="by an earlier version, which had no centring; give another --run"):
        check_same(tmp_path, {"road": "x", "steps": 8, "centring": 1.0})
    check_same(tmp_path, {"road": "x", "steps": 9})


def test_a_run_with_other_episodes_is_refused(scene, tmp_path, monkeypatch):
    place = twin.load_scene(scene)
    write_json(tmp_path / "config.json", training.run_settings(place, SHORT))
    check_same(tmp_path, training.run_settings(place, SHORT))
    monkeypatch.setattr(training, "EPISODE_VERSION", training.EPISODE_VERSION + 1)
    with pytest.raises(InputError, match="changed the sampling of episodes"):
        check_same(tmp_path, training.run_settings(place, SHORT))


def test_configurations_set_the_environment():
    varied, day = TrainConfig().options(), TrainConfig(lighting="day").options()
    assert varied["randomise"] == Ranges() and TrainConfig(randomise=False).options()["randomise"] is None
    nought = dict.fromkeys(("extinction", "sunlight", "shade"), (0.0, 0.0))
    assert day["randomise"] == Ranges(**nought, bystanders=(0, 0))
    assert TrainConfig(observe="simulator").options()["randomise"] == day["randomise"]
    assert varied["rewards"].cross_track == -varied["rewards"].step and varied["start_along"] > 0.0
    assert varied["rewards"].steering == -0.5 * varied["rewards"].step
    blind = TrainConfig(observe="simulator").teacher_options()
    assert not blind["pixels"] and blind["randomise"] == day["randomise"] and blind["rewards"] == varied["rewards"]
    assert TrainConfig(randomise=False).teacher_options()["randomise"] is None


def test_states_are_those_of_the_environment(scene):
    """Also for an episode's first picture, which is returned together with the last one of the episode before."""
    env = DriveVecEnv(scene, "ahead", 2, seed=3, lighting="day", time_limit=0.5, action="steering")
    env.reset()
    for _ in range(4):
        *_, done, infos = env.step(np.array([[0.5], [-0.5]], np.float32))
        assert not done.any() and all("first_state" not in info for info in infos)
        for i, info in enumerate(infos):
            assert info["state"].shape == (len(STATE_SCALES),)
            assert info["state"][2] == pytest.approx(info["cross_track"], abs=1e-6)
            assert info["state"][0] == pytest.approx(info["speed"], abs=1e-6)
            assert np.sign(info["state"][1]) == (1, -1)[i]
    *_, done, infos = env.step(np.zeros((2, 1), np.float32))
    assert done.all()
    for i, info in enumerate(infos):
        assert info["state"][2] == pytest.approx(info["cross_track"], abs=1e-6)
        assert info["first_state"][2] == pytest.approx(env.vector_env.tasks[i].cross_track, abs=1e-6)
        assert info["first_state"][0] == pytest.approx(0.0, abs=1e-3) and info["state"][0] > 0.1
    env.close()
