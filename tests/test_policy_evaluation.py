"""Selection of a run's policy: the best of a training's late ones, not the last."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from test_training import SHORT
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.evaluation.training_curves import CHOICE_FILE, write_success_curve
from twin.learn import training
from twin.learn.policy import load_policy
from twin.learn.policy_evaluation import EpisodeResult, run_episodes
from twin.learn.training import train

CONFIG = replace(SHORT, steps=160, save_every=160, checkpoints=8, trials=3)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    train(scene, folder, CONFIG)
    return folder


@pytest.fixture
def scripted(monkeypatch):
    """Episodes with scripted results: by step of the policy, the number of successes and the reward."""
    script: dict[int, tuple[int, float]] = {}
    asked: list[tuple[int, tuple[int, ...]]] = []

    def pretend(policy, envs, seeds, watch):
        step = policy.trained["step"]
        asked.append((step, tuple(seeds)))
        won, reward = script.get(step, (0, 0.0))
        return [
            EpisodeResult(seed, "goal" if i < won else "out_of_bounds", 1.0, 9, 1.0, reward)
            for i, seed in enumerate(seeds)
        ]

    monkeypatch.setattr(training, "run_episodes", pretend)
    return script, asked


def test_the_policy_with_most_successes_is_selected(scene, run, scripted):
    script, asked = scripted
    (run / CHOICE_FILE).unlink(missing_ok=True)
    script |= {120: (2, 1.0), 140: (2, 1.5), 160: (1, 9.0), 40: (3, 9.0)}
    choice = training.select_checkpoint(scene, run, CONFIG)
    assert [one["step"] for one in choice["candidates"]] == [100, 120, 140, 160]  # of the second half
    # Of those with most successes the one that earns most; its rate is that of the fresh episodes.
    assert choice["chosen"] == {"step": 140, "trials": training.FRESH_EPISODES, "successes": 2, "reward": 1.5}
    assert [one["trials"] for one in choice["candidates"]] == [3, 3, 3, 3]
    for name in ("policy.json", "policy.safetensors", "policy.onnx"):
        assert (run / name).read_bytes() == (run / "checkpoints" / "000000140" / name).read_bytes()
    assert load_policy(run).trained["step"] == 140
    shared = {seeds for _, seeds in asked[:-1]}
    assert len(shared) == 1 and len(next(iter(shared))) == CONFIG.trials  # all drive the same episodes
    step, fresh = asked[-1]
    assert step == 140 and len(fresh) == training.FRESH_EPISODES and not set(fresh) & set(next(iter(shared)))
    assert write_success_curve(run).exists()


@pytest.mark.slow
def test_selection_is_repeated_only_after_more_steps(scene, run, tmp_path, scripted):
    _, asked = scripted
    (run / CHOICE_FILE).unlink(missing_ok=True)
    first = training.select_checkpoint(scene, run, CONFIG)
    count = len(asked)
    for config in (CONFIG, replace(CONFIG, steps=80)):  # fewer steps than were trained change nothing
        train(scene, run, config)
        assert training.select_checkpoint(scene, run, config) == first and len(asked) == count
    assert json.loads((run / CHOICE_FILE).read_text()) == first
    longer, copy = replace(CONFIG, steps=200), shutil.copytree(run, tmp_path / "run")
    train(scene, copy, longer)
    assert not (copy / CHOICE_FILE).exists()
    again = training.select_checkpoint(scene, copy, longer)
    assert again["steps"] == 200 and again["candidates"][-1]["step"] == 200


def test_a_new_training_keeps_nothing_of_the_previous_one(scene, run, tmp_path, scripted):
    copy = shutil.copytree(run, tmp_path / "run")
    training.select_checkpoint(scene, copy, CONFIG)
    shutil.rmtree(copy / "state")
    (copy / "state").mkdir()
    train(scene, copy, replace(CONFIG, steps=80))
    assert not (copy / CHOICE_FILE).exists()
    assert max(int(path.name) for path in (copy / "checkpoints").iterdir()) == 80


def test_candidates_are_few_and_the_last_is_one(tmp_path):
    for step in range(1000, 21000, 1000):
        (tmp_path / f"{step:09d}").mkdir()
    found = [int(path.name) for path in training._candidates(tmp_path, 20_000)]
    assert found == [11000, 14000, 17000, 20000]


def test_candidates_drive_whole_episodes_as_in_training(scene, run, monkeypatch):
    """Whole episodes in the training's lighting, with the same result each time."""
    seen = []

    def spy(policy, envs, seeds, watch):
        seen.append((envs.options.start_along, envs.options.lighting, envs.options.randomise))
        driven = run_episodes(policy, envs, seeds[:2], watch)
        assert driven == run_episodes(policy, envs, seeds[:2], watch)
        assert all(np.isfinite(one.reward) and one.steps > 0 for one in driven)
        return driven

    (run / CHOICE_FILE).unlink(missing_ok=True)
    monkeypatch.setattr(training, "run_episodes", spy)
    training.select_checkpoint(scene, run, CONFIG)
    assert set(map(str, seen)) == {str((0.0, "day", CONFIG.options()["randomise"]))}
