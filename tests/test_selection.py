"""When a training ends, and which of its policies is kept."""

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from test_training import SHORT
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE_FILE, write_success_curve
from twin.learn import selection, training
from twin.learn.policy import load_policy
from twin.learn.policy_evaluation import EpisodeResult, run_episodes
from twin.learn.selection import FRESH_EPISODES, TESTS_FILE, Failure, PolicyTest, next_segment, train_until_learnt
from twin.learn.train_config import TrainConfig, steps_for
from twin.train import _summary

CONFIG = replace(SHORT, steps=160, save_every=160, checkpoints=8, test_every=40, settle=40)
PLAN = TrainConfig(steps=24_000, test_every=2_000, settle=2_000, cycle=12_000, success=0.95)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


def learn(scene, folder: Path, config: TrainConfig):
    return train_until_learnt(scene, folder, config, processes=1)


@pytest.fixture
def scripted(monkeypatch):
    """Episodes with scripted results: by step of the policy, the number of successes of a test and the reward."""
    script: dict[int, tuple[int, float]] = {}
    asked: list[tuple[int, tuple[int, ...], str]] = []

    def pretend(policy, envs, seeds, watch, among=None):
        step = policy.trained["step"]
        order = selection._seeds(CONFIG)
        asked.append((step, tuple(seeds), envs.options.lighting))
        won, reward = script.get(step, (0, 0.0))
        return [
            EpisodeResult(
                seed, "goal" if order.index(seed) < won else "out_of_bounds", 1.0 + won / 40, 9, 1.0, reward, "day"
            )
            for seed in seeds
        ]

    for module in (selection, training):
        monkeypatch.setattr(module, "run_episodes", pretend)
    return script, asked


def _tests(*progress, trials=40, successes=0):
    return [PolicyTest(2000 * (k + 1), trials, successes, x, 0.0) for k, x in enumerate(progress)]


# ---- when it ends


def test_a_training_goes_on_until_a_test_reaches_what_was_asked():
    assert next_segment(PLAN, []).until == 2000 and next_segment(PLAN, []).settle_from is None
    poor, good, luck = _tests(9.0, successes=37), _tests(9.0, successes=38), _tests(9.0, trials=8, successes=8)
    assert not next_segment(PLAN, poor).why and not next_segment(PLAN, luck).why
    assert next_segment(PLAN, good) == selection.Segment(4000, 2000, "reached")
    assert next_segment(replace(PLAN, success=0.98), good).why == ""


def test_a_training_that_gets_no_better_ends():
    assert next_segment(PLAN, _tests(5.0, 9.0, 9.0, 9.0, 9.1)).why == ""
    assert next_segment(PLAN, _tests(5.0, 9.0, 9.0, 9.0, 9.1, 9.1)) == selection.Segment(14_000, 12_000, "no better")
    assert next_segment(PLAN, _tests(5.0, 9.0, 9.0, 9.0, 9.1, 9.2)).why == ""  # 2 % further than the best before
    assert next_segment(PLAN, _tests(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)).why == ""  # it has not begun to drive
    more = [*_tests(5.0, 9.0, 9.0, 9.0, 9.1), PolicyTest(12_000, 40, 2, 9.0, 0.0)]
    assert next_segment(PLAN, more).why == ""  # no further, but more episodes arrive


def test_a_training_that_goes_on_has_patience_again():
    ended = [*_tests(5.0, 9.0, 9.0, 9.0, 9.1, 9.1), PolicyTest(14_000, 8, 0, 9.1, 0.0, (), True)]
    flat = [PolicyTest(14_000 + 2000 * k, 8, 0, 9.1, 0.0) for k in (1, 2, 3, 4)]
    assert next_segment(PLAN, ended).why == "" and next_segment(PLAN, [*ended, *flat[:3]]).why == ""
    assert next_segment(PLAN, [*ended, *flat]) == selection.Segment(24_000, 22_000, "no better")


def test_a_longer_task_is_trained_for_longer():
    assert [steps_for(length) for length in (5.0, 30.0, 49.0, 58.2, 77.5)] == [24_000] * 3 + [36_000, 48_000]


def test_the_largest_number_of_steps_ends_it():
    tests = _tests(*(float(k + 1) for k in range(11)))
    assert next_segment(PLAN, tests[:10]) == selection.Segment(22_000, None)
    assert next_segment(PLAN, tests) == selection.Segment(24_000, None, "steps")
    assert next_segment(replace(PLAN, steps=1500), []) == selection.Segment(1500, None, "steps")


def test_the_learning_rate_falls_in_the_second_half_of_a_cycle_and_while_settling():
    rate = TrainConfig().learning_rate
    assert [training.cycle_rate(PLAN, k) for k in (0, 6_000, 12_000, 18_000)] == [rate] * 4  # two cycles of 12,000
    assert training.cycle_rate(PLAN, 9_000) == pytest.approx(0.55 * rate)
    assert training.cycle_rate(PLAN, 24_000) == pytest.approx(0.1 * rate)
    short = replace(PLAN, steps=3_000)
    assert training.cycle_rate(short, 1_500) == rate and training.cycle_rate(short, 2_250) == pytest.approx(0.55 * rate)

    def settling(step):
        return training._learning_rate(PLAN, step, selection.Segment(10_000, 8_000))

    assert settling(8_000) == training.cycle_rate(PLAN, 8_000) == pytest.approx(0.7 * rate)
    assert settling(9_000) == pytest.approx(0.4 * rate) and settling(10_000) == pytest.approx(0.1 * rate)


# ---- which policy is kept


def test_a_run_ends_when_it_has_learnt_and_its_last_word_is_of_fresh_episodes(scene, tmp_path, scripted):
    script, asked = scripted
    script |= {40: (8, 1.0), 80: (39, 2.0), 120: (40, 1.0)}
    choice = learn(scene, tmp_path, CONFIG)
    assert (choice["steps"], choice["why"], choice["reached"]) == (120, "reached", True)
    assert [(one["step"], one["trials"]) for one in choice["candidates"]] == [(40, 20), (80, 40), (120, 40)]
    assert choice["chosen"]["step"] == 120 and choice["chosen"]["trials"] == FRESH_EPISODES
    tested = {seed for _, seeds, _ in asked[:-1] for seed in seeds}
    step, fresh, _ = asked[-1]
    assert step == 120 and len(tested) == 40 and len(fresh) == FRESH_EPISODES and not tested & set(fresh)
    assert [len(seeds) for at, seeds, _ in asked if at == 40] == [8, 12]  # a test is broken off after three failures
    for name in ("policy.json", "policy.safetensors", "policy.onnx"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "checkpoints" / "000000120" / name).read_bytes()
    assert load_policy(tmp_path).trained["step"] == 120
    assert write_success_curve(tmp_path).exists()


def test_the_best_of_a_run_that_did_not_learn_is_kept(scene, tmp_path, scripted):
    script, _ = scripted
    script |= {40: (20, 1.0), 80: (30, 1.5), 120: (30, 9.0), 160: (10, 9.0)}
    choice = learn(scene, tmp_path, CONFIG)
    assert (choice["steps"], choice["why"], choice["reached"]) == (160, "steps", False)
    assert choice["chosen"]["step"] == 120  # of those with most successes the one that earns most
    assert choice["failures"] == "50 of 50 failures at 0 to 5 m (50 by out_of_bounds); 50 in lightings mostly like day"


def test_finalists_drive_only_what_they_have_not_driven(scene, tmp_path, scripted):
    """Four policies go on to 20 episodes, two of them to 40; what the tests of the training drove counts."""
    script, asked = scripted
    script |= {32: (1, 0.0), 64: (5, 0.0), 96: (14, 0.0), 128: (12, 0.0), 160: (3, 0.0)}
    choice = learn(scene, tmp_path, replace(CONFIG, test_every=32))
    order = selection._seeds(CONFIG)
    rounds = [(at, seeds) for at, seeds, _ in asked if set(seeds) <= set(order[:40])]
    by_step = {step: [seed for at, seeds in rounds if at == step for seed in seeds] for step in script}
    assert {step: len(seeds) for step, seeds in by_step.items()} == {32: 8, 64: 20, 96: 40, 128: 40, 160: 20}
    assert all(seeds == list(order[: len(seeds)]) for seeds in by_step.values())
    assert choice["chosen"]["step"] == 96 and asked[-1][:2] == (96, order[40:])
    found = {one["step"]: (one["trials"], one["successes"], len(one["failures"])) for one in choice["candidates"]}
    assert found == {32: (8, 1, 7), 64: (20, 5, 15), 96: (40, 14, 26), 128: (40, 12, 28), 160: (20, 3, 17)}
    assert choice["candidates"][2]["progress"] == pytest.approx(1.0 + 14 / 40, abs=2e-3)


def test_a_stopped_run_can_end_where_it_was_stopped(scene, tmp_path, scripted):
    """By fewer steps than were done: the policy at hand is tested, too."""

    def interrupt(steps, tests) -> None:
        if steps == 60:
            signal.raise_signal(signal.SIGTERM)

    scripted[0][60] = (30, 1.0)
    with pytest.raises(KeyboardInterrupt):
        train_until_learnt(scene, tmp_path, CONFIG, interrupt, processes=1)
    choice = learn(scene, tmp_path, replace(CONFIG, steps=40))
    assert (choice["steps"], choice["why"], choice["chosen"]["step"]) == (60, "steps", 60)


@pytest.mark.slow
def test_a_choice_stays_until_more_is_asked(scene, tmp_path, scripted):
    script, asked = scripted
    script |= {160: (30, 1.0), 240: (40, 1.0)}
    first = learn(scene, tmp_path, CONFIG)
    count = len(asked)
    assert learn(scene, tmp_path, CONFIG) == first and learn(scene, tmp_path, replace(CONFIG, steps=80)) == first
    assert len(asked) == count and json.loads((tmp_path / CHOICE_FILE).read_text()) == first
    more = learn(scene, tmp_path, replace(CONFIG, steps=240))
    assert more["steps"] == 240 and more["reached"] and more["chosen"]["step"] == 240
    assert [(one["step"], one["resumed"]) for one in more["candidates"]] == [
        (40, False), (80, False), (120, False), (160, True), (200, False), (240, False)
    ]  # fmt: skip
    (tmp_path / CHOICE_FILE).write_text('{"steps": 240, "chosen": {}}')
    with pytest.raises(InputError, match=r"choice\.json is damaged .*; delete it"):
        learn(scene, tmp_path, replace(CONFIG, steps=240))


@pytest.mark.slow
def test_a_run_that_got_no_better_goes_on_with_all_of_its_tests(scene, tmp_path, scripted, monkeypatch):
    script, asked = scripted
    monkeypatch.setattr(selection, "PATIENCE", 1)
    first = learn(scene, tmp_path, CONFIG)  # no episode arrives in any test
    assert (first["steps"], first["why"], len(first["candidates"])) == (120, "no better", 3)
    script |= {200: (40, 1.0), 240: (40, 1.0)}
    (tmp_path / TESTS_FILE).unlink()
    more = learn(scene, tmp_path, replace(CONFIG, steps=240))
    tests = [(one["step"], one["resumed"]) for one in more["candidates"]]
    assert more["reached"] and tests == [(40, False), (80, False), (120, True), (160, False), (200, False)]
    del asked[:]
    stricter = learn(scene, tmp_path, replace(CONFIG, steps=200, success=1.0))
    assert not {at for at, _, _ in asked} - {more["steps"]} and stricter["candidates"][-1]["step"] == more["steps"]


@pytest.mark.slow
def test_a_killed_run_repeats_no_test(scene, tmp_path, scripted, monkeypatch):
    script, asked = scripted
    script |= {80: (40, 1.0), 120: (40, 1.0)}
    whole = learn(scene, tmp_path / "a", CONFIG)
    count = len(asked)
    real = selection._choose
    monkeypatch.setattr(selection, "_choose", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        learn(scene, tmp_path / "b", CONFIG)
    monkeypatch.setattr(selection, "_choose", real)
    del asked[:]
    again = learn(scene, tmp_path / "b", CONFIG)
    assert again["candidates"] == whole["candidates"] and again["chosen"] == whole["chosen"]
    assert len(asked) < count and {at for at, _, _ in asked if at < 120} <= {40, 80}


@pytest.mark.slow
def test_a_new_training_keeps_nothing_of_the_previous_one(scene, tmp_path, scripted):
    learn(scene, tmp_path, CONFIG)
    shutil.rmtree(tmp_path / "state")
    (tmp_path / "state").mkdir()
    assert selection.read_tests(tmp_path) == []
    choice = learn(scene, tmp_path, replace(CONFIG, steps=80))
    assert choice["steps"] == 80 and max(int(path.name) for path in (tmp_path / "checkpoints").iterdir()) == 80
    assert all(one["step"] <= 80 for one in json.loads((tmp_path / TESTS_FILE).read_text()))


@pytest.mark.slow
def test_tests_are_whole_episodes_as_in_training_with_the_same_result_each_time(scene, tmp_path, monkeypatch):
    seen = []

    def spy(policy, envs, seeds, watch, among=None):
        o = envs.get(among[0] if among else 0, "options")
        seen.append((o.start_along, o.lighting, o.randomise))
        driven = run_episodes(policy, envs, seeds[:2], watch, among)
        assert driven == run_episodes(policy, envs, seeds[:2], watch, among)
        assert all(np.isfinite(one.reward) and one.steps > 0 and one.lighting for one in driven)
        return driven

    for module in (selection, training):
        monkeypatch.setattr(module, "run_episodes", spy)
    learn(scene, tmp_path, replace(CONFIG, steps=40))
    assert set(map(str, seen)) == {str((0.0, "day", CONFIG.options()["randomise"]))}


def test_the_last_word_of_a_training_in_varied_light_is_under_held_out_light(scene, tmp_path, scripted):
    _, asked = scripted
    choice = learn(scene, tmp_path, replace(CONFIG, steps=40, lighting="training"))
    assert asked[-1][2] == "held-out" and {light for _, _, light in asked[:-1]} == {"training"}
    assert choice["chosen"]["condition"] == "held-out+randomised"


@pytest.mark.parametrize(
    "changes, text",
    [({}, "day, robot randomized"), ({"randomise": False}, "day"), ({"observe": "simulator"}, "day, robot randomized")],
)
def test_the_last_test_of_a_training_in_one_lighting_is_called_what_it_is(scene, tmp_path, scripted, changes, text):
    """Weather and objects are not randomized there, as they are under `day+randomised`."""
    choice = learn(scene, tmp_path, replace(CONFIG, steps=40, **changes))
    assert choice["chosen"]["condition"] == text


@pytest.mark.parametrize(
    ("why", "reached", "said"),
    [
        ("steps", True, "a test reached the required success rate of 95%"),
        ("steps", False, "stayed below the required success rate of 95%; give more --steps"),
        ("no better", False, "tests got no better"),
    ],
)
def test_the_printed_end_of_a_training_is_what_was_reached(monkeypatch, why, reached, said):
    """The last allowed steps may bring the required rate."""
    monkeypatch.setattr("twin.learn.teacher.teacher_result", lambda _: {"successes": 20, "trials": 20})
    chosen = {"step": 24000, "successes": 40, "trials": 40, "condition": "held-out"}
    choice = {"steps": 24000, "why": why, "reached": reached, "success": 0.95, "chosen": chosen, "failures": ""}
    assert said in _summary(Path("runs/first"), choice, Path("curve.png"))[0]


def test_failures_are_summed_up_by_place_cause_and_light():
    assert selection.failure_summary([]) == ""
    near = [Failure("out_of_bounds", 21.0 + k, "training: night 0.6, sun 0.4") for k in range(3)]
    assert selection.failure_summary([Failure("collision", -0.02, "sun")]).startswith("1 of 1 failures at 0 to 5 m")
    far = [Failure("stuck", 40.0, "training: sun 0.9, night 0.1")]
    text = selection.failure_summary([*far, *near])
    assert text == "3 of 4 failures at 20 to 25 m (3 by out_of_bounds); 3 in lightings mostly like night"
