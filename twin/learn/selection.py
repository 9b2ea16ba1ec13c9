"""Decides when a training ends and which of its policies is kept, by tests between segments of the training.

A *test* drives the newest policy, without exploration, in whole episodes in the training's conditions. All tests of a
run use the same episodes, and the training never uses these. A test stops as soon as more episodes have failed than the
required success rate `config.success` allows. The training ends

- when a test *reaches* the required rate;
- when `PATIENCE` tests in a row have improved neither the success rate nor the mean distance along the route;
- at the largest number of steps.

In the first two cases, `config.settle` more steps with a falling learning rate (`training.py`) and one more test
follow. If a later call allows more steps, the training goes on, and the count of tests without improvement begins anew.

The kept policy is the one with most successes among those that drove a whole test; the mean reward breaks ties. If no
policy reached the required rate, the best ones drive the rest of their tests first, in rounds (`_ROUNDS`; successive
halving). The best of several results is biased upwards by luck. So the kept policy drives fresh episodes, which no
decision used, in a *final test*. If the lighting varies, these episodes have held-out lightings and everything
randomized, as in `twin validate` by default; otherwise only the robot is randomized.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import KVWriter

from twin import runtime
from twin.env.domain_randomization import condition_options
from twin.env.vector_env import make_vector_env
from twin.evaluation.training_curves import CHOICE_FILE, TESTS_FILE
from twin.files import read_json, wrap_read_errors, write_json
from twin.learn.distillation import has_state, saved_steps
from twin.learn.policy import copy_policy, load_policy
from twin.learn.policy_evaluation import EpisodeResult, run_episodes
from twin.learn.train_config import TrainConfig
from twin.learn.training import Drive, Segment, check_same, checkpoint_folder, run_settings, train
from twin.loading import Twin

FRESH_EPISODES = 40
"""Number of episodes of the final test."""
PATIENCE = 4
REACHED, NO_BETTER, ALL_STEPS = ENDS = ("reached", "no better", "steps")
"""Reasons to end a training."""

_BATCHES = (8, 12, 20)  # numbers of episodes; a test may stop after each batch
_TEST_EPISODES = sum(_BATCHES)
_BETTER = 0.02  # least improvement that counts: of the success rate (absolute), of the mean distance (relative)
# Rounds of policies that reached too little: the number of the best ones, and how many episodes each has driven at the
# end of the round. They drive at most 88 episodes more.
_ROUNDS = ((4, sum(_BATCHES[:2])), (2, _TEST_EPISODES))
_STREAM = 7  # part of the seed of the test episodes; see `training._TRAINING_STREAM`
_ROBOT_ONLY = ", robot randomized"  # end of the final test's condition if place and weather are as filmed
_PLACE = 5.0  # [m] length of the route sections in which failures are counted


@dataclass(frozen=True)
class Failure:
    """An episode of a test in which the robot did not reach the goal."""

    cause: str
    progress: float
    """Distance along the route [m]."""
    lighting: str
    """The sampled lighting; see `LocalVectorEnv.info`."""


@dataclass(frozen=True)
class PolicyTest:
    """A test of the policy saved at a step, in the first `trials` test episodes."""

    step: int
    trials: int
    successes: int
    progress: float
    """Mean distance along the route [m]."""
    reward: float
    """Mean over episodes of the sum of rewards."""
    failures: tuple[Failure, ...] = ()
    resumed: bool = False
    """True if the training had ended with this test before it went on."""

    @property
    def rate(self) -> float:
        return self.successes / self.trials

    def reached(self, success: float) -> bool:
        """True if all episodes were driven, and the rate is at least `success`."""
        return self.trials == _TEST_EPISODES and self.rate >= success

    def extended(self, episodes: Sequence[EpisodeResult]) -> "PolicyTest":
        """This test with further episodes."""
        more = PolicyTest.of(self.step, episodes)
        trials = self.trials + more.trials

        def mean(old: float, new: float) -> float:
            return round((old * self.trials + new * more.trials) / trials, 3)

        progress, reward = mean(self.progress, more.progress), mean(self.reward, more.reward)
        failures = self.failures + more.failures
        return PolicyTest(self.step, trials, self.successes + more.successes, progress, reward, failures, self.resumed)

    @staticmethod
    def of(step: int, episodes: Sequence[EpisodeResult]) -> "PolicyTest":
        lost = [one for one in episodes if one.cause != "goal"]
        return PolicyTest(
            step,
            len(episodes),
            len(episodes) - len(lost),
            round(float(np.mean([one.progress for one in episodes])), 3),
            round(float(np.mean([one.reward for one in episodes])), 3),
            tuple(Failure(one.cause, round(one.progress, 2), one.lighting) for one in lost),
        )


def next_segment(config: TrainConfig, tests: Sequence[PolicyTest]) -> Segment:
    """The segment of the training that follows these tests."""
    last = tests[-1].step if tests else 0
    settled = min(last + config.settle, config.steps)
    if tests and tests[-1].reached(config.success):
        return Segment(settled, last, REACHED)
    rate, progress, since = -1.0, 0.0, 0
    for one in tests:
        better = one.rate > rate + _BETTER or one.progress > progress * (1.0 + _BETTER) or progress <= 0.0
        since = 0 if better or one.resumed else since + 1
        rate, progress = (max(rate, one.rate), max(progress, one.progress)) if better else (rate, progress)
    if since >= PATIENCE:
        return Segment(settled, last, NO_BETTER)
    due = last + config.test_every
    return Segment(due, None) if due < config.steps else Segment(config.steps, None, ALL_STEPS)


def earlier_choice(twin: Twin, folder: Path, config: TrainConfig) -> dict[str, Any] | None:
    """The choice of a training that has ended, as `train_until_learnt` returns it; None: more training is needed.

    Raises InputError: an existing run has another configuration or is damaged.
    """
    if has_state(folder / "state"):
        check_same(folder, run_settings(twin, config))
    before = read_choice(folder)
    ended = before and (before["reached"] or config.steps <= before["most"]) and config.success <= before["success"]
    return before if ended else None


def train_until_learnt(
    twin: Twin,
    folder: Path,
    config: TrainConfig,
    watch: Callable[[int, Sequence[PolicyTest]], object] = lambda *_: None,
    processes: int | None = None,
    writers: Sequence[KVWriter] = (),
) -> dict[str, Any]:
    """Trains and tests until the training ends (see the module), and saves the kept policy as that of the run.

    An earlier choice is returned unchanged unless `config` asks for a higher success rate, or for more steps than a
    choice that did not reach its rate was allowed. If a call was killed, the next one resumes its training. Arguments
    and errors are those of `train`, but `watch` also receives the tests so far, and `writers` the tests' scores, as
    `tests/...`.

    Returns:
        The contents of `choice.json`: the steps done and allowed; the required success rate and whether it is reached;
        the reason why the training ended; the tests; `chosen`, the final test, with a text on its condition; and a
        sentence on where and why episodes failed.
    """
    if before := earlier_choice(twin, folder, config):
        return before
    tests = read_tests(folder)
    if ended := read_choice(folder):  # its tests include those of the end
        tests = [_parse_test(one) for one in ended["candidates"]]
        tests[-1] = replace(tests[-1], resumed=True)
        write_json(folder / TESTS_FILE, [asdict(one) for one in tests])
    planned: list[Segment] = []

    def referee(step: int, drive: Drive) -> Segment | None:
        if planned and step >= planned[-1].until:
            if not (tests and tests[-1].step == step):  # else no step was left to train
                with runtime.bar(f"test at {step:,}", _TEST_EPISODES, "episode") as bar:
                    tests.append(
                        _test(config, step, lambda seeds: drive(checkpoint_folder(folder, step), seeds, bar.update))
                    )
                scores = {"success": tests[-1].rate, "progress": tests[-1].progress, "reward": tests[-1].reward}
                for writer in writers:
                    writer.write({f"tests/{name}": value for name, value in scores.items()}, {}, step)
            if planned[-1].why:
                return None
            write_json(folder / TESTS_FILE, [asdict(one) for one in tests])
        planned.append(next_segment(config, tests))
        return planned[-1]

    train(twin, folder, config, lambda steps: watch(steps, tests), processes, referee, writers)
    return _choose(twin, folder, config, tests, planned[-1].why, processes)


def _choose(
    twin: Twin, folder: Path, config: TrainConfig, tests: list[PolicyTest], why: str, processes: int | None
) -> dict[str, Any]:
    def drive(step: int, seeds: Sequence[int], what: str, condition: dict[str, Any]) -> list[EpisodeResult]:
        options = {**config.options(), "start_along": 0.0, **condition}
        bar = runtime.bar(what, len(seeds), "episode")
        with closing(make_vector_env(twin, config.task, options, [None] * config.worlds, processes)) as envs, bar:
            return run_episodes(load_policy(checkpoint_folder(folder, step)), envs, seeds, bar.update)

    seeds = _seeds(config)
    results = {one.step: one for one in tests}
    finalists = [one for one in tests if one.trials == _TEST_EPISODES]
    if not any(one.reached(config.success) for one in finalists):
        finalists = tests
        for count, until in _ROUNDS:
            finalists = sorted(finalists, key=lambda one: (one.rate, one.progress, one.step))[-count:]
            finalists = [
                one.extended(drive(one.step, seeds[one.trials : until], f"test of {one.step:,}", {}))
                if one.trials < until
                else one
                for one in finalists
            ]
            results |= {one.step: one for one in finalists}
    best = max(finalists, key=lambda one: (one.successes, one.reward))
    options = condition_options(config.shown_condition) if config.lighting_varies else {}
    # `Condition.randomised` also means weather and distractor objects, which a training in one lighting never has.
    robot_only = config.randomise and not config.lighting_varies
    fresh = PolicyTest.of(best.step, drive(best.step, seeds[_TEST_EPISODES:], "final test", options))
    copy_policy(checkpoint_folder(folder, best.step), folder)
    out = {
        "steps": tests[-1].step,
        "most": config.steps,
        "success": config.success,
        "reached": best.reached(config.success),
        "why": why,
        "candidates": [asdict(one) for one in results.values()],
        "chosen": {**asdict(fresh), "condition": str(config.shown_condition) + _ROBOT_ONLY * robot_only},
        "failures": failure_summary([*best.failures, *fresh.failures]),
    }
    write_json(folder / CHOICE_FILE, out)
    return dict(read_json(folder / CHOICE_FILE))


def failure_summary(failures: Sequence[Failure]) -> str:
    """A sentence on where, why and in which light most of the failures happened; empty without failures."""
    if not failures:
        return ""
    bins = [max(0, int(one.progress // _PLACE)) for one in failures]  # progress may be slightly negative at the start
    where, count = _most(bins)
    cause, by_cause = _most(one.cause for one, b in zip(failures, bins, strict=True) if b == where)
    light, by_light = _most(_main_light(one.lighting) for one in failures)
    place = f"{count} of {len(failures)} failures at {where * _PLACE:g} to {(where + 1) * _PLACE:g} m"
    return f"{place} ({by_cause} by {cause}); {by_light} in lightings mostly like {light}"


def _main_light(lighting: str) -> str:
    """The filmed lighting with the largest weight in a sampled one: sun in `training: sun 0.62, night 0.38`."""
    _, _, mixture = lighting.partition(": ")
    return mixture.split(" ")[0] if mixture else lighting


def _most(values: Iterable[Any]) -> tuple[Any, int]:
    """The most frequent value (the first one if several are tied), and its count."""
    return Counter(values).most_common(1)[0]


def _test(config: TrainConfig, step: int, drive: Callable[[Sequence[int]], list[EpisodeResult]]) -> PolicyTest:
    """Tests a policy in batches of episodes; stops when more have failed than the required success rate allows."""
    allowed = int(_TEST_EPISODES * (1.0 - config.success) + 1e-9)
    seeds, driven = _seeds(config), list[EpisodeResult]()
    for start, end in pairwise(np.cumsum([0, *_BATCHES]).tolist()):
        driven += drive(seeds[start:end])
        if sum(one.cause != "goal" for one in driven) > allowed:
            break
    return PolicyTest.of(step, driven)


def _seeds(config: TrainConfig) -> tuple[int, ...]:
    """Seeds of the test episodes, then of those of the final test."""
    sequence = np.random.SeedSequence([config.seed, _STREAM])
    return tuple(int(seed) for seed in sequence.generate_state(_TEST_EPISODES + FRESH_EPISODES))


def read_choice(folder: Path) -> dict[str, Any] | None:
    """The choice saved for the training's present state; None if there is none."""
    path = folder / CHOICE_FILE
    if not path.exists() or not has_state(folder / "state"):
        return None
    with wrap_read_errors(path, "delete it, and the best policy is selected again"):
        choice = dict(read_json(path))
        if choice["steps"] != saved_steps(folder / "state"):
            return None
        counts = [int(choice["chosen"][name]) for name in ("step", "successes", "trials")]
        known = choice["why"] in ENDS and 0 <= counts[1] <= counts[2] and counts[2] > 0
        texts = choice["failures"], choice["chosen"]["condition"]
        if not known or not all(isinstance(one, str) for one in texts) or not isinstance(choice["reached"], bool):
            raise ValueError("not a choice of twin train")
        float(choice["most"]), float(choice["success"])
        _ = [_parse_test(one) for one in choice["candidates"]]
        return choice


def read_tests(folder: Path) -> list[PolicyTest]:
    """Tests made so far, up to the step of the training's saved state."""
    path = folder / TESTS_FILE
    if not path.exists() or not has_state(folder / "state"):
        return []
    with wrap_read_errors(path, "delete it, and the policies are tested again"):
        tests = [_parse_test(one) for one in read_json(path)]
        return [one for one in tests if one.step <= saved_steps(folder / "state")]


def _parse_test(row: dict[str, Any]) -> PolicyTest:
    failures = tuple(Failure(str(f["cause"]), float(f["progress"]), str(f["lighting"])) for f in row["failures"])
    counts = int(row["step"]), int(row["trials"]), int(row["successes"])
    resumed = row.get("resumed", False) is True  # earlier versions have no such key
    test = PolicyTest(*counts, float(row["progress"]), float(row["reward"]), failures, resumed)
    if not 0 <= test.successes <= test.trials <= _TEST_EPISODES or not test.trials:
        raise ValueError(f"{test.successes} successes in {test.trials} trials")
    return test
