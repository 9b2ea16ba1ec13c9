"""Validation: episodes are independent of each other, a killed validation ends with the same table, and the summary
agrees with the table."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_policy import some_weights
from tiny_runs import SMALL, tiny_runs
from tiny_twin import tiny_twin

from twin import commands, load_scene, runtime, validate
from twin.config import Condition
from twin.env import episode_lighting
from twin.env.domain_randomization import EVALUATION_RANGES, condition_options
from twin.env.env_factory import EnvFactory, fingerprint
from twin.errors import InputError
from twin.evaluation.trials import Trial, compare_pairs, read_trials, success_rate, summarize
from twin.learn import policy_evaluation
from twin.learn.policy import Control, load_policy, save_policy
from twin.learn.policy_evaluation import EpisodeChunk, run_chunk, run_chunks, with_sampled_lighting
from twin.loading import Twin
from twin.report.validation_report import summary_lines
from twin.robot import HuskyParams
from twin.runtime import exclusive_lock
from twin.validate import lighting_seeds

FIRST = lighting_seeds("day", 1)[0]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    root = tiny_twin(tmp_path_factory.mktemp("twin"))
    tiny_runs(root)
    return root


@pytest.fixture
def fresh(scene):
    """The scene without its validation."""
    shutil.rmtree(scene / "validation", ignore_errors=True)
    return scene


def chunk(scene: Path, seeds, lighting="day", name="ahead") -> EpisodeChunk:
    return EpisodeChunk(str(scene), "ahead", str(scene / "runs" / name), False, Condition.parse(lighting), tuple(seeds))


def test_an_episode_does_not_depend_on_others(scene):
    together = run_chunk(chunk(scene, range(11)))
    assert [one.seed for one in together] == list(range(11))
    assert len({one.steps for one in together}) > 1  # they end at different times
    assert [run_chunk(chunk(scene, [k]))[0] for k in (0, 7, 10)] == [together[k] for k in (0, 7, 10)]
    assert run_chunk(chunk(scene, (10, 3))) == [together[10], together[3]]


def test_an_episode_equals_that_of_a_single_environment(scene):
    import twin
    from twin.env.drivers import PolicyDriver
    from twin.env.episode import record_episode

    policy = load_policy(scene / "runs" / "ahead")
    (driven,) = run_chunk(chunk(scene, [5]))
    environment = twin.load(scene, "ahead", 5, lighting="day", **policy.options())
    episode = record_episode(environment, PolicyDriver(policy))
    assert (driven.cause, driven.steps) == (episode.cause, len(episode.times) - 1)
    assert driven.progress == episode.progress[-1]  # to the last bit, which can decide whether a robot hits the curb
    assert driven.trust == pytest.approx(episode.trust[:-1].mean(), abs=1e-9)


def test_processes_give_the_same_results(scene):
    chunks = [chunk(scene, [0, 1]), chunk(scene, [2]), chunk(scene, [0], "night")]
    assert list(run_chunks(chunks, processes=2)) == list(run_chunks(chunks))


def test_a_policy_trained_again_is_driven_anew(scene):
    """In one process, too, as by `validate` in a notebook."""
    again = scene / "runs" / "again"
    for name in ("ahead", "left"):
        shutil.rmtree(again, ignore_errors=True)
        shutil.copytree(scene / "runs" / name, again)
        assert list(run_chunks([chunk(scene, [0], name="again")])) == list(run_chunks([chunk(scene, [0], name=name)]))
    shutil.rmtree(again)


def test_the_rounds_of_a_search_open_the_scene_once(fresh, monkeypatch):
    opened, real = [], policy_evaluation.load_scene
    monkeypatch.setattr(policy_evaluation, "load_scene", lambda path: opened.append(path) or real(path))
    policies = {"ahead": str(fresh / "runs" / "ahead")}
    search = validate.Campaign(load_scene(fresh), "ahead", fresh / "validation" / "worst.csv", policies, False, 1, None)
    rounds = [search.drive([("ahead", "drawn_0", seeds)], "search") for seeds in ([0], [0], [1, 2])]
    assert len(opened) == 1
    seeds = [trial.seed for trials in rounds for trial in trials]
    (alone,) = run_chunks([chunk(fresh, [0, 1, 2], "drawn_0")])
    assert len(opened) == 2  # files may have changed since
    assert seeds == [0, 0, 1, 2] and [t.steps for t in rounds[0] + rounds[2]] == [one.steps for one in alone]


def test_sampled_lightings_do_not_depend_on_earlier_ones(scene):
    def light(numbers):
        stage = EnvFactory.open(load_scene(scene), "ahead", {"size": (32, 18)})
        for number in numbers:
            with_sampled_lighting(stage, number)
        return stage.field.embedding(f"drawn_{numbers[-1]}")

    np.testing.assert_array_equal(light([3]), light([0, 5, 3]))
    assert not np.array_equal(light([3]), light([4]))


def run(scene: Path, *policies: str, lightings=("day", "night"), episodes=5) -> str:
    validate.validate(scene, policies, "ahead", lightings, episodes)
    return (scene / "validation" / "episodes.csv").read_text()


def test_randomized_episodes_differ_and_repeat(scene, monkeypatch):
    seeds = range(6)
    plain, drawn = run_chunk(chunk(scene, seeds)), run_chunk(chunk(scene, seeds, "day+randomised"))
    assert [one.seed for one in drawn] == list(seeds)
    assert [one.progress for one in plain] != [one.progress for one in drawn]
    assert run_chunk(chunk(scene, [2], "day+randomised")) == [drawn[2]]
    day, drawn_day = (fingerprint(load_scene(scene), "ahead", Condition("day", drawn)) for drawn in (False, True))
    assert day != drawn_day
    said = [
        fingerprint(load_scene(scene), "ahead", Condition.parse(name))
        for name in ("day", "any", "held-out", "training+randomised")
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episode_lighting, "VERSION", -1)
        other = [
            fingerprint(load_scene(scene), "ahead", Condition.parse(n))
            for n in ("day", "any", "held-out", "training+randomised")
        ]
    assert [a == b for a, b in zip(said, other, strict=True)] == [True, True, False, False]
    assert run_chunk(chunk(scene, seeds)) == plain
    stage = EnvFactory.open(
        scene, "ahead", {**load_policy(scene / "runs" / "ahead").options(), **condition_options(Condition("day", True))}
    )
    assert stage.options.lighting == "day" and stage.options.randomise == EVALUATION_RANGES
    fitted = dataclasses.replace(load_scene(scene).world(), robot=HuskyParams(friction=0.6))
    monkeypatch.setattr(Twin, "world", lambda self: fitted)
    options = load_policy(scene / "runs" / "ahead").options()
    stages = [
        EnvFactory.open(scene, "ahead", {**options, **condition_options(Condition("day", drawn))})
        for drawn in (True, False)
    ]
    assert stages[0].options.randomise.friction == (1.0, 1.0) and stages[1].options.randomise is None
    with pytest.raises(InputError, match="randomized"):
        run_chunk(chunk(scene, [0], "day+randomized"))


@pytest.mark.slow
def test_a_killed_validation_ends_with_the_same_table(fresh, monkeypatch):
    monkeypatch.setattr(validate, "CHUNK", 3)
    whole = run(fresh, "ahead", "left")
    path = fresh / "validation" / "episodes.csv"
    assert len(whole.splitlines()) == 1 + 2 * 2 * 5
    shutil.rmtree(fresh / "validation")

    class Killed(BaseException):
        pass

    def killed(one):
        if left.pop() == 0:
            raise Killed
        return run_chunk(one)

    left = [0, 1, 2, 3]
    monkeypatch.setattr(policy_evaluation, "run_chunk", killed)
    with pytest.raises(Killed):
        run(fresh, "ahead", "left")
    monkeypatch.setattr(policy_evaluation, "run_chunk", run_chunk)
    assert whole.startswith(path.read_text()) and 1 < len(path.read_text().splitlines()) < len(whole.splitlines())
    assert run(fresh, "ahead", "left") == whole
    # Killed while it wrote: within a row, and within the header.
    for cut in (len(whole) - 60, 9):
        path.write_text(whole[:cut])
        assert run(fresh, "ahead", "left") == whole
    monkeypatch.setattr(policy_evaluation, "run_chunk", None)  # nothing is driven twice
    assert run(fresh, "ahead", "left") == whole


def test_more_policies_and_episodes_are_added(fresh):
    first = run(fresh, "ahead", lightings=["day"], episodes=2)
    more = run(fresh, "left", "ahead", lightings=["day"], episodes=3)
    assert more.startswith(first)
    trials = read_trials(fresh / "validation" / "episodes.csv")
    assert [(t.policy, t.seed - FIRST) for t in trials] == [
        *[("ahead", 0), ("ahead", 1)],
        *[("left", 0), ("left", 1), ("left", 2)],
        ("ahead", 2),
    ]
    said = json.loads((fresh / "validation" / "summary.json").read_text())
    assert said["robot_known"] == []  # as published
    assert [c["trials"] for c in said["cells"]] == [3, 3]
    assert (fresh / "validation" / "failures_ahead.png").stat().st_size > 5_000


def test_policies_share_episodes_but_lightings_do_not(fresh):
    run(fresh, "ahead", "left", lightings=["day", "night"], episodes=2)
    trials = read_trials(fresh / "validation" / "episodes.csv")
    by = {name: {t.seed for t in trials if t.policy == name} for name in ("ahead", "left")}
    assert by["ahead"] == by["left"] and len(by["ahead"]) == 4


def test_another_policy_of_the_same_name_is_refused(fresh, tmp_path):
    run(fresh, "ahead", lightings=["day"], episodes=1)
    save_policy(tmp_path / "ahead", SMALL, Control(), some_weights(SMALL, 9), {})
    with pytest.raises(InputError, match="not the file that was validated"):
        run(fresh, str(tmp_path / "ahead"))
    with pytest.raises(InputError, match="two policies"):
        run(fresh, "ahead", str(tmp_path / "ahead"))


def test_two_validations_do_not_mix(fresh):
    with exclusive_lock(fresh / ".validation.lock", "x"), pytest.raises(InputError, match="validation by process"):
        run(fresh, "ahead")
    assert not (fresh / "validation" / "episodes.csv").exists()


def test_duplicate_names_are_driven_once(fresh):
    said = validate.validate(fresh, ["ahead", "ahead"], "ahead", ["day", "day"], 1)
    assert [c["trials"] for c in said["cells"]] == [1]
    assert len(read_trials(fresh / "validation" / "episodes.csv")) == 1


def test_a_changed_scene_is_refused(fresh):
    run(fresh, "ahead", lightings=["day"], episodes=1)
    toml = fresh / "scene.toml"
    text = toml.read_text()
    try:
        toml.write_text(text + '\n[[obstacle]]\nkind = "cone"\nstation = 2.0\n')
        with pytest.raises(InputError, match="obstacles, photo or"):
            run(fresh, "left", lightings=["day"], episodes=1)
        with pytest.raises(InputError, match="under day that were driven before"):
            run(fresh, "left", lightings=["night"], episodes=1)  # the page would show both as one experiment
    finally:
        toml.write_text(text)
    run(fresh, "left", lightings=["night"], episodes=1)


def test_a_task_that_is_gone_is_refused_before_anything_is_driven(fresh):
    toml = fresh / "scene.toml"
    text = toml.read_text()
    toml.write_text(text + '\n[[task]]\nname = "gate"\nstart = 0.0\nlength = 3.0\n')
    validate.validate(fresh, ["ahead"], "gate", ["day"], 1)
    toml.write_text(text)
    with pytest.raises(InputError, match=r"has episodes of gate \(task 'gate': unknown.*\); move it away"):
        run(fresh, "ahead", lightings=["day"], episodes=1)
    assert len(read_trials(fresh / "validation" / "episodes.csv")) == 1


def test_a_policy_that_was_trained_again_is_refused_whoever_drives_next(fresh):
    run(fresh, "ahead", lightings=["day"], episodes=1)
    trained = fresh / "runs" / "ahead" / "policy.json"
    before = trained.read_text()
    try:
        trained.write_text(json.dumps(json.loads(before), indent=3))
        with pytest.raises(InputError, match=r"'ahead': .* is not the file that was validated under this name"):
            run(fresh, "left", lightings=["day"], episodes=1)
        there = fresh.parent / "there"
        shutil.copytree(fresh, there)
        (there / "runs" / "ahead" / "policy.json").write_text(before)  # a copy is judged by its own run
        run(there, "left", lightings=["day"], episodes=1)
    finally:
        trained.write_text(before)
    record = fresh / "validation" / "validated.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"sources": {"ahead": 5}}))
    with pytest.raises(InputError, match=r"validated.json is damaged.*to validate again"):
        run(fresh, "left", lightings=["day"], episodes=1)


def test_a_table_without_a_record_is_refused(fresh):
    """The table is like that of an earlier version, which did not record roads."""
    run(fresh, "ahead", lightings=["day"], episodes=1)
    path = fresh / "validation" / "validated.json"
    path.write_text(json.dumps({"field": "made up", "policies": json.loads(path.read_text())["policies"]}))
    with pytest.raises(InputError, match="under day that were driven before"):
        run(fresh, "ahead", lightings=["day"], episodes=2)


def test_the_worst_lighting_is_evaluated_on_fresh_episodes(fresh, monkeypatch):
    monkeypatch.setattr(validate, "_SEARCH_LIGHTINGS", 4)
    monkeypatch.setattr(validate, "_SEARCH_EPISODES", 1)
    monkeypatch.setattr(validate, "_SEARCH_KEPT", 2)
    said = validate.validate(fresh, ["ahead"], "ahead", ["day"], 2, worst=True)
    (worst,) = said["worst"]
    assert validate.validate(fresh, ["ahead"], "ahead", ["day"], 2)["worst"] == [worst]  # it is not forgotten
    trials = read_trials(fresh / "validation" / "worst.csv")
    assert worst["trials"] == 2 and worst["of"] == 4
    searched, proof = [t for t in trials if t.seed < 3_000_000], [t for t in trials if t.seed >= 3_000_000]
    assert {t.lighting for t in searched} == {f"drawn_{k}" for k in range(4)} and len(searched) == 4 + 2 * 2
    assert {t.lighting for t in proof} == {worst["lighting"]} and len(proof) == 2


def test_the_verb_validates_and_refuses_bad_arguments(fresh, capsys):
    common = [str(fresh), "--task", "ahead", "--lightings", "day", "--episodes", "2"]
    assert commands.main("validate", [*common, "--policy", "ahead", "left", "--quiet"]) == 0
    assert commands.main("validate", [*common, "--policy", "ahead", "left"]) == 0
    said = capsys.readouterr().out
    assert "only the first succeeded" in said and "/2 " in said
    for wrong in (
        ["--policy", "nobody"],
        ["--policy", "ahead", "--lightings", "dusk"],
        ["--policy", "ahead", "--episodes", "0"],
    ):
        assert commands.main("validate", [*common, *wrong, "--quiet"]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_a_misspelt_lighting_is_refused_before_anything_is_driven_or_recorded(fresh, capsys):
    common = [str(fresh), "--task", "ahead", "--episodes", "2", "--policy", "ahead", "--quiet"]
    for names in (["day", "nigth"], ["nigth+randomised"]):
        assert commands.main("validate", [*common, "--lightings", *names]) == 2
        assert "'nigth': unknown; did you mean 'night'?" in capsys.readouterr().err
        assert not (fresh / "validation").exists()


# ---- what is said of trials


def trial(policy: str, seed: int, cause: str, trust: float | None = 1.0, progress: float = 3.0) -> Trial:
    return Trial(policy, "ahead", "day", seed, cause, progress, 10, trust)


def test_paired_episodes_are_a_sign_test():
    a = [trial("a", k, "goal" if k < 8 else "collision") for k in range(10)]
    b = [trial("b", k, "goal" if k < 1 else "timeout") for k in range(1, 12)]
    (pair,) = compare_pairs([*a, *b])
    assert (pair["episodes"], pair["only_a"], pair["only_b"]) == (9, 7, 0)
    assert pair["p"] == pytest.approx(2 * 0.5**7)
    assert compare_pairs(a) == []


def test_the_time_for_a_summary_grows_linearly_with_the_episodes(monkeypatch):
    """Trials were looked up cell by cell and trial by trial, which took 14 s for 40,000 of them."""
    counts = []
    cell = Trial.cell.fget
    monkeypatch.setattr(Trial, "cell", property(lambda trial: counts.append(1) or cell(trial)))
    monkeypatch.setattr(Trial, "__eq__", lambda a, b: counts.append(1) or a is b)
    trials = [Trial(f"p{k % 5}", "straight", f"l{k % 9}", k, "goal", 1.0, 10, k % 10 / 10) for k in range(900)]
    assert len(summarize(trials)["cells"]) == 45 and len(counts) <= 2 * len(trials)


def test_the_summary_splits_by_cause_and_trust():
    trials = [trial("a", 0, "goal"), trial("a", 1, "goal", 0.5), trial("a", 2, "stuck", 0.5), trial("a", 3, "stuck")]
    (cell,) = summarize(trials)["cells"]
    assert cell["causes"] == {"stuck": 2}
    assert (cell["successes"], cell["trials"]) == (2, 4)
    assert (cell["trusted"]["successes"], cell["trusted"]["trials"]) == (1, 2)
    assert (cell["low_trust"]["successes"], cell["low_trust"]["trials"]) == (1, 2)
    assert 0.0 < cell["low"] < 0.5 < cell["high"] < 1.0
    assert success_rate([])["rate"] is None
    assert "2 got stuck" in summary_lines(summarize(trials))[0]


@pytest.mark.slow
def test_two_nodes_of_ray_give_the_table_of_one_process(fresh):
    ray = pytest.importorskip("ray", reason="ray is not installed")
    from ray.cluster_utils import Cluster

    options = ("ahead", ("day", "night"), 8)
    whole = validate.validate(fresh, ("ahead", "left"), *options)
    path = fresh / "validation" / "episodes.csv"
    table = path.read_text()
    shutil.rmtree(fresh / "validation")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=2)
        assert validate.validate(fresh, ("ahead", "left"), *options, ray=cluster.address) == whole
        assert path.read_text() == table
        shutil.rmtree(fresh / "validation")
        # What is wrong on a node is said as if it were here.
        with pytest.raises(InputError, match="lighting 'noon'"):
            validate.validate(fresh, ("ahead",), "ahead", ("noon",), 2, ray=cluster.address)
    finally:
        ray.shutdown()
        cluster.shutdown()


def test_no_cluster_is_one_line(fresh, capsys):
    pytest.importorskip("ray", reason="ray is not installed")
    given = [str(fresh), "--policy", "ahead", "--task", "ahead", "--lightings", "day", "--episodes", "1", "--quiet"]
    assert commands.main("validate", [*given, "--ray", "127.0.0.1:1"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: --ray 127.0.0.1:1: no cluster there")
    assert said.count("\n") == 1
