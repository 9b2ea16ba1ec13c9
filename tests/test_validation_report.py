"""The page of a validation says what its tables hold, and its films are the episodes of the table."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from films import video_info
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from page_text import Text
from tiny_runs import tiny_runs
from tiny_twin import tiny_twin

from twin import commands, film, runtime, validate
from twin.errors import InputError
from twin.evaluation.statistics import rate_summary, wilson
from twin.evaluation.training_curves import plot_tests, read_test_counts, training_summaries
from twin.evaluation.trials import (
    EPISODE_COLUMNS,
    Trial,
    csv_text,
    read_trials,
    success_rate,
    summarize,
    typical_episode,
    worst_episode,
)
from twin.files import digest_file, write_json
from twin.report.figures import SERIES
from twin.report.validation_report import (
    FAILURES,
    MAX_PLOTTED_LIGHTINGS,
    TrainingCurve,
    failure_text,
    limitations,
    p_value_text,
    pair_heatmap,
    pair_text,
    rate_figure,
    rate_heatmap,
    rate_text,
    validation_page,
    verdicts,
)

TRAINED = {"run": "ahead", "task": "ahead", "observe": "nerf", "lighting": "training", "step": 300}
TESTS = [(100, 2, 8), (200, 13, 20), (300, 39, 40)]  # of the run `ahead`: step, successes, episodes


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    root = tiny_twin(tmp_path_factory.mktemp("twin"))
    tiny_runs(root, TRAINED)
    write_tests(root / "runs" / "ahead", TESTS)
    return root


@pytest.fixture
def fresh(scene):
    """The scene without its validation."""
    shutil.rmtree(scene / "validation", ignore_errors=True)
    return scene


def write_tests(run: Path, tests) -> None:
    write_json(run / "tests.json", [dict(zip(("step", "successes", "trials"), one, strict=True)) for one in tests])


def result(won: int, trials: int, **more) -> dict:
    """A test in `training_summaries`."""
    return {"final": False, "condition": "", **rate_summary(won, trials)} | more


def trial(
    policy="a", seed=0, cause="goal", progress=4.0, trust: float | None = 1.0, task="ahead", light="day"
) -> Trial:
    return Trial(policy, task, light, seed, cause, progress, 40, trust)


def told(trials, **more) -> dict:
    """Contents of `summary.json`, summarized from trials."""
    return summarize(trials) | {"training": {}, "worst": [], "films": []} | more


def page(folder: Path, said: dict, *curves: TrainingCurve) -> Text:
    """The page's text; a placeholder replaces the maps."""
    from PIL import Image

    for task in {c["task"] for c in said["cells"]}:
        Image.new("RGB", (8, 8)).save(folder / f"failures_{task}.png")
    return Text(validation_page("road", folder, said, curves))


# ---- which episodes are typical and worst


def test_the_typical_episode_has_the_median_progress():
    ways = [3.0, 0.5, 2.0, 4.0, 1.0]
    assert typical_episode([trial(seed=k, progress=way) for k, way in enumerate(ways)]).progress == np.median(ways)
    assert typical_episode([trial(seed=k, progress=way) for k, way in enumerate(ways[:4])]).progress == 3.0
    assert typical_episode([trial(seed=k) for k in range(5)]).seed == 2


def test_the_worst_episode_failed_earliest_or_has_the_lowest_trust():
    won = [trial(seed=k, progress=0.1, trust=trust) for k, trust in enumerate((0.9, 0.7, None))]
    lost = [trial(seed=9, cause="stuck", progress=2.0, trust=1.0), trial(seed=8, cause="collision", progress=1.0)]
    assert worst_episode([*won, *lost]).seed == 8
    assert worst_episode(won).seed == 1


# ---- training


def test_the_result_of_a_training_is_the_test_of_the_policy(tmp_path):
    run = tmp_path / "runs" / "r"
    heads = {"r": run / "policy.json", "r/5": run / "checkpoints" / "5" / "policy.json"}
    (run / "checkpoints" / "5").mkdir(parents=True)
    about = {"task": "t", "observe": "nerf", "lighting": "sun"}
    for (name, head), step in zip(heads.items(), (3000, 1500), strict=True):
        write_json(head, {"trained": {"run": name, "step": step, **about}})
    (tmp_path / "validation").mkdir()
    noted = {"policies": {name: digest_file(head) for name, head in heads.items()}}
    write_json(tmp_path / "validation" / "validated.json", noted)
    names = ["r", "r/5", "my_module:act", "r/6"]
    untested = {name: {"run": "r", "step": step, **about, "test": None} for name, step in (("r", 3000), ("r/5", 1500))}
    assert training_summaries(tmp_path, names) == untested and read_test_counts(run) == []
    write_tests(run, [(3000, 38, 40), (1000, 2, 8), (1500, 7, 20)])
    found = training_summaries(tmp_path, names)
    assert [found[name]["test"] for name in heads] == [result(38, 40), result(7, 20)]
    assert found["r"]["test"]["low"] < 38 / 40 < found["r"]["test"]["high"]
    assert read_test_counts(run) == [(1000, 2, 8), (1500, 7, 20), (3000, 38, 40)]
    # The final test counts for the policy that drove it. The choice has more tests than tests.json.
    final = {"step": 3000, "successes": 39, "trials": 40}
    candidates = [{"step": 1500, "successes": 30, "trials": 40}]
    write_json(run / "choice.json", {"chosen": final | {"condition": "held-out+randomised"}, "candidates": candidates})
    tested = training_summaries(tmp_path, heads)
    assert tested["r"]["test"] == result(39, 40, final=True, condition="held-out+randomised")
    assert tested["r/5"]["test"] == result(30, 40)
    write_json(run / "choice.json", {"chosen": final | {"successes": 41}, "candidates": candidates})
    with pytest.raises(InputError, match=r"choice\.json is damaged .*41 successes in 40 trials"):
        training_summaries(tmp_path, heads)
    (run / "choice.json").unlink()
    # If the run was trained further or replaced, its curve is not that of the validated policy.
    write_json(heads["r"], {"trained": {"step": 4000}})
    assert set(training_summaries(tmp_path, ["r", "r/5"])) == {"r/5"}
    shutil.rmtree(tmp_path / "validation")
    assert training_summaries(tmp_path, ["r", "r/5"]) == {}


# ---- words


def test_every_cause_has_words():
    from twin.config import CAUSES

    assert set(FAILURES) == set(CAUSES) - {"goal"}
    cell = {"causes": {"collision": 2, "out_of_bounds": 9}}
    assert failure_text(cell) == "9 left the corridor, 2 hit something" and failure_text({"causes": {}}) == ""


def test_the_headline_compares_what_all_have_driven():
    """`b` is better in the lightings of both; `a` also drove in an easy one, which must not count."""
    trials = [trial("a", k, "goal" if k < 4 else "stuck") for k in range(10)]
    trials += [trial("a", k, light="easy") for k in range(90)]
    trials += [trial("b", k, "goal" if k < 7 else "stuck") for k in range(10)]
    (verdict,) = verdicts(told(trials))
    assert (
        "“b” reaches the goal most often: in 7 of 10 episodes in the lightings that were used for all policies (day)"
        in verdict.text
        and verdict.mood == "mixed"
    )
    apart = [trial("a", 0, light="day"), trial("b", 0, light="night")]
    assert "the best policy is not known" in verdicts(told(apart))[0].text
    alike = [trial("a", 0), trial("b", 0)]
    assert "most often" not in verdicts(told(alike))[0].text and "“b” as often" in verdicts(told(alike))[0].text


def test_the_headline_ranks_by_what_it_prints():
    """Lightings count alike; equal sums are equal; and luck is not called better."""

    def of(**won: dict[str, tuple[int, int]]) -> str:
        trials = [
            trial(policy, k, "goal" if k < good else "stuck", light=light)
            for policy, lights in won.items()
            for light, (good, count) in lights.items()
            for k in range(count)
        ]
        return verdicts(told(trials))[0].text

    uneven = of(a={"x": (10, 10), "y": (50, 100)}, b={"x": (4, 10), "y": (100, 100)})
    assert (
        "“a” reaches the goal most often: in 75% of episodes, if every lighting has the same weight" in uneven
        and "60 of 110" not in uneven
    )
    assert "not significantly more often than “b”" in uneven
    thirds = of(a={"x": (1, 10), "y": (2, 10), "z": (3, 10)}, b={"x": (3, 10), "y": (2, 10), "z": (1, 10)})
    assert "most often" not in thirds and "“b” as often" in thirds
    assert "not significantly" in of(a={"x": (20, 20)}, b={"x": (19, 20)})
    assert "not significantly" not in of(a={"x": (20, 20)}, b={"x": (2, 20)})


def test_a_weak_light_and_untrusted_pictures_are_headlines():
    trials = [*(trial("a", k) for k in range(3)), trial("a", 0, "stuck", light="night", trust=0.2)]
    first, second = verdicts(told(trials))
    assert "least often in lighting night, 0 of 1" in first.text
    assert "1 of 4 episodes" in second.text


def test_differences_are_named_by_significance():
    pair = {"a": "x", "b": "y", "only_a": 9, "only_b": 1, "p": 0.02}
    assert pair_text(pair) == "“x” is better"
    assert pair_text(pair | {"only_a": 1, "only_b": 9}) == "“y” is better"
    assert pair_text(pair | {"p": 0.3}) == "not significant" and pair_text(pair | {"only_b": 9}) == "no difference"
    assert [p_value_text(p) for p in (1e-5, 0.0213, 0.62, 1.0)] == ["<0.1%", "2.1%", "62%", "100%"]


def test_numbers_have_intervals_and_what_is_missing_is_not_made_up(tmp_path):
    assert rate_text(rate_summary(3, 4)).startswith("75% (") and rate_text(success_rate([])) == "–"
    text = page(tmp_path, told([trial("my_module:act")])).text
    assert "not known" in text and "nan" not in text and "None" not in text
    assert "1 policy, 1 lighting: 1 episode in the twin." in text
    assert "There is no such episode here" in text and "No videos" in text
    for absent in ("Which policy is better", "The worst lighting for", "How the policies were trained"):
        assert (absent in text) == (absent == "The worst lighting for")


def test_the_page_shows_the_numbers_of_the_tables(tmp_path):
    trials = [trial("a", k, "goal" if k < 31 else "collision", trust=0.9 if k % 2 else 0.5) for k in range(40)]
    trials += [trial("b", k, "goal" if k < 12 else "timeout", light=light) for k in range(40) for light in ("day", "n")]
    trials += [trial("a", 7, "stuck", task="bend", light="any")]
    trained = {"a": TRAINED | {"run": "a", "test": result(13, 20)}}
    worst = [summarize([trial("a", k, "rollover", light="drawn_3") for k in range(5)])["cells"][0] | {"of": 16}]
    curve = ("a", TESTS)
    said = told(trials, training=trained, worst=worst)
    text = page(tmp_path, said, curve).text
    for cell in [*said["cells"], *worst]:
        assert rate_text(cell) in text and failure_text(cell) in text
    assert rate_text(trained["a"]["test"]) in text and "test during the training, n = 20;" in text
    assert "trained on ahead, in varying lighting, for 300 steps" in text
    tested = {"a": trained["a"] | {"test": result(37, 40, final=True, condition="held-out")}}
    shown = page(tmp_path, told(trials, training=tested)).text
    assert rate_text(tested["a"]["test"]) in shown and "final test, n = 40, lighting held-out" in shown
    assert rate_text(trained["a"]["test"]) not in shown
    assert "19" in text and "only A arrived" in text and "“a” is better" in text  # 31 - 12 episodes
    assert rate_text(said["cells"][0]["low_trust"]) in text
    assert "drawn_3" in text and "5 rolled over" in text
    assert all(v.text in text for v in verdicts(said)) and all(c.what in text for c in limitations(said))


def test_names_from_files_are_text(tmp_path):
    evil = "<script>alert(1)</script>&$x$"
    shown = page(tmp_path, told([trial(evil, light=evil), trial("b", light=evil, cause="stuck")]))
    assert "script" not in shown.tags and evil in shown.text


# ---- the verb


def test_the_verb_writes_a_page_that_needs_nothing_else(fresh):
    said = validate.validate(fresh, ["ahead", "left"], "ahead", ["day", "night"], 3)
    folder = fresh / "validation"
    html = (folder / "validation.html").read_text(encoding="utf-8")
    shown = Text(html)
    assert "http" not in html
    links = {link for link in shown.links if not link.startswith(("#", "data:"))}
    assert links == {"summary.json", "cells.csv", "episodes.csv"} and all((folder / link).exists() for link in links)
    assert json.loads((folder / "summary.json").read_text()) == said
    assert list(said["training"]) == ["ahead"]  # the other does not say how it was trained
    assert rate_text(rate_summary(39, 40)) in shown.text and "How the policies were trained" in shown.text
    assert f"twin forecast {fresh} --real {fresh}/real.csv" in shown.text and "ahead,ahead,LIGHTING" in shown.text
    assert html.count("<svg") == html.count('<svg role="img" aria-label="') > 0


class NoCamera:
    """Replaces the camera behind the robot, whose kernels take long to compile."""

    def __init__(self, world, size, obstacles):
        self.size = size

    def render(self, qpos, pose, time):
        return np.full((self.size[1], self.size[0], 3), 90, np.uint8)


@pytest.fixture
def episodes(monkeypatch):
    """Stores every episode that is filmed."""
    seen = []

    def spy(*args, **options):
        path, episode = whole(*args, **options)
        seen.append(episode)
        return path, episode

    whole = film.film
    monkeypatch.setattr(film, "film", spy)
    monkeypatch.setattr("twin.report.drive_video.SceneCamera", NoCamera)
    return seen


def test_films_are_the_tables_episodes(fresh, episodes):
    said = validate.validate(fresh, ["ahead", "left"], "ahead", ["night", "held-out"], 3, films=True)
    folder = fresh / "validation"
    rows = {(t.policy, t.lighting, t.seed): t for t in read_trials(folder / "episodes.csv")}
    assert {(f["policy"], which) for f in said["films"] for which in f["which"]} == {
        *(("ahead", "typical"), ("ahead", "worst"), ("left", "typical"), ("left", "worst"))
    }
    assert len(episodes) == len(said["films"])
    for one, episode in zip(said["films"], episodes, strict=True):
        row = rows[one["policy"], one["lighting"], one["seed"]]
        assert (episode.cause, len(episode.times) - 1) == (row.cause, row.steps)
        assert episode.progress[-1] == pytest.approx(row.progress, abs=1e-3)
        assert episode.trust[:-1].mean() == pytest.approx(row.trust, abs=1e-4)
        assert (one["cause"], one["progress_m"], one["of"]) == (row.cause, row.progress, 6)
        assert video_info(folder / one["file"])["frames"] > row.steps // 2
    shown = Text((folder / "validation.html").read_text(encoding="utf-8"))
    assert {f["file"] for f in said["films"]} <= set(shown.links) and "any row of episodes.csv" in shown.text
    # Films are kept, not made again, and still shown after a call without --films.
    before = len(episodes)
    assert validate.validate(fresh, ["ahead", "left"], "ahead", ["night", "held-out"], 3, films=True) == said
    assert validate.validate(fresh, ["left"], "ahead", ["night"], 2)["films"] == said["films"]
    assert len(episodes) == before
    # A film that the user deleted is not on the page, and is made again on demand.
    first = said["films"][0]
    for name in ("file", "poster"):
        (folder / first[name]).unlink()
        assert validate.validate(fresh, ["left"], "ahead", ["night"], 2)["films"] == said["films"][1:]
        assert validate.validate(fresh, ["ahead", "left"], "ahead", ["night", "held-out"], 3, films=True) == said
        assert len(episodes) == (before := before + 1) and (folder / first[name]).exists()


def test_a_film_that_ends_otherwise_than_the_table_is_refused(fresh, episodes):
    validate.validate(fresh, ["left"], "ahead", ["day"], 1)
    table = fresh / "validation" / "episodes.csv"
    (row,) = read_trials(table)
    table.write_text(csv_text(EPISODE_COLUMNS, [replace(row, steps=row.steps + 1).row()]))
    with pytest.raises(InputError, match="driven again for its film"):
        validate.validate(fresh, ["left"], "ahead", ["day"], 1, films=True)
    assert not list((fresh / "validation").rglob("*.mp4")) and (fresh / "validation" / "validation.html").exists()


def test_any_policy_can_be_filmed_in_the_environment_it_asks_for(fresh, episodes, tmp_path, monkeypatch, capsys):
    """A run, its folder and its ONNX file drive alike; so does a callable; anything else is refused in one line."""
    (tmp_path / "my_film_policy.py").write_text("def act(pixels):\n    return [0.0, 0.5]\n")
    monkeypatch.chdir(tmp_path)
    run = fresh / "runs" / "ahead"
    shutil.copytree(run, run / "checkpoints" / "000000100", ignore=lambda *_: ["checkpoints"])
    common = [str(fresh), "--task", "ahead", "--lighting", "day", "--seed", "5", "--out", str(tmp_path / "a.mp4")]
    for source in ("ahead", str(run), str(run / "policy.onnx"), "ahead/000000100", "my_film_policy:act"):
        assert commands.main("film", [*common, "--policy", source, "--quiet"]) == 0
    one, *others, callable_ = episodes
    assert one.actions.shape[1] == 1  # it steers, which is not the environment's default
    for other in others:
        np.testing.assert_array_equal(other.qpos, one.qpos)
    np.testing.assert_array_equal(callable_.actions[0], [0.5, 0.5])
    capsys.readouterr()
    for wrong, hint in (
        ("nobody", "expected one of ahead"),
        ("ahed", "did you mean 'ahead'?"),
        ("ahead/00000010", "did you mean 'ahead/000000100'?"),
        ("ahed/000000100", "did you mean 'ahead'?"),
        ("/no/such/folder", "expected a run's folder, an .onnx file or module:function"),
        ("nobody.onnx", "expected a run's folder, an .onnx file or module:function"),
    ):
        assert commands.main("film", [*common, "--policy", wrong, "--quiet"]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"error: no policy {wrong}") and hint in said


@pytest.mark.parametrize(("lighting", "told"), [("day", "day"), ("training", r"training: [a-z]+ \d\.\d\d.*")])
def test_a_film_names_the_mixture_of_a_sampled_lighting(fresh, tmp_path, monkeypatch, lighting, told):
    shown = []
    monkeypatch.setattr(film, "write_episode_video", lambda path, episode, *_: shown.append(episode.lighting))
    _, episode = film.film(fresh, "ahead", seed=5, out=tmp_path / "a.mp4", lighting=lighting)
    assert episode.lighting == lighting and len(shown) == 1 and re.fullmatch(told, shown[0])


def test_films_of_other_drivers_and_obstacles_have_other_names(fresh, monkeypatch):
    monkeypatch.setattr(film, "write_episode_video", lambda *_: None)
    drives = ({}, {"policy": "ahead"}, {"obstacles": 0})
    names = [film.film(fresh, "ahead", seed=5, lighting="day", **one)[0].name for one in drives]
    ends = ("scripted_driver_5", "ahead_5", "0_obstacles_scripted_driver_5")
    assert names == [f"ahead_day_{end}.mp4" for end in ends]


@pytest.mark.parametrize(("count", "sizes"), [(1, "8"), (3, "8 to 40")])
def test_a_curve_has_a_point_with_an_interval_for_each_test(count, sizes):
    axes = Figure().subplots()
    plot_tests(axes, TESTS[:count][::-1], SERIES[0])
    (drawn,) = axes.containers
    points = np.column_stack(drawn.lines[0].get_data())
    assert points == pytest.approx(np.array([(step, won / n) for step, won, n in TESTS[:count]]))
    bars = [segment[:, 1] for segment in drawn.lines[2][0].get_segments()]
    assert bars == [pytest.approx(wilson(won, n)) for _, won, n in TESTS[:count]]
    assert drawn.get_label() == f"tests, {sizes} episodes each"


def test_a_robot_without_identified_parameters_gives_a_caution():
    """The caution appears if episodes are randomized and no parameter of the robot is identified; it names the cure."""

    def cautions(light: str, **more) -> str:
        return " ".join(c.what for c in limitations(told([trial(light=light)], **more)))

    assert "parameters are random in each episode" in cautions("held-out+randomised", robot_known=[])
    assert "parameters are random" not in cautions("held-out+randomised", robot_known=["friction"])
    assert "parameters are random" not in cautions("held-out", robot_known=[])


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("lights", [2, MAX_PLOTTED_LIGHTINGS, 11])
def test_names_of_many_lightings_leave_room_for_the_rates(lights):
    """A legend wider than the figure, or names taller than it, would leave no room for the axes."""
    names = [f"afternoon_of_day_{k}+randomised" for k in range(lights)]
    cells = summarize([trial(light=name) for name in names])["cells"]
    figure = rate_figure(cells) if lights <= MAX_PLOTTED_LIGHTINGS else rate_heatmap(cells, {})
    FigureCanvasAgg(figure).draw()
    assert figure.axes[0].get_position().width > 0.5


def tiles(figure) -> dict[tuple[str, str], tuple[str, tuple[float, ...]]]:
    """Text and color of every tile of a figure, by its row's and its column's name."""
    (axes,) = figure.axes
    rows, columns = ([t.get_text() for t in ticks] for ticks in (axes.get_yticklabels(), axes.get_xticklabels()))
    (drawn,) = axes.collections
    faces = drawn.get_facecolor()
    middles = [path.vertices[:4].mean(0) for path in drawn.get_paths()]
    assert np.allclose(middles, [t.xy for t in axes.texts])
    at = [(rows[round(t.xy[1])], columns[round(t.xy[0])]) for t in axes.texts]
    return {key: (t.get_text(), tuple(f)) for key, t, f in zip(at, axes.texts, faces, strict=True)}


def test_many_lightings_are_a_heatmap_with_the_mean_of_the_shared_ones():
    """`a` is better in every lighting; a mean over each policy's own lightings, or over episodes, would favor `b`."""
    assert MAX_PLOTTED_LIGHTINGS < 6
    won = {"a": [0, 25, 100, 100, 100, 100], "b": [None, None, 100, 75, 75, 75]}
    trials = [
        trial(policy, seed, "goal" if seed < rate * n / 100 else "collision", light=f"day_{k}")
        for policy, rates_ in won.items()
        for k, rate in enumerate(rates_)
        if rate is not None
        for n in [20 if k == 2 else 4]
        for seed in range(n)
    ]
    drawn = tiles(rate_heatmap(summarize(trials)["cells"], {"a": 0.5, "b": None}))
    assert {light: text for (policy, light), (text, _) in drawn.items() if policy == "a"} == {
        "training’s result": "50", "mean": "100",
        "day_0": "0", "day_1": "25", "day_2": "100", "day_3": "100", "day_4": "100", "day_5": "100",
    }  # fmt: skip
    assert drawn["b", "mean"][0] == "81"  # (100 + 3 * 75) / 4; of the episodes 91 %
    assert ("b", "day_1") not in drawn and ("b", "training’s result") not in drawn
    shades = [drawn["a", name][1][3] for name in ("day_0", "day_1", "training’s result", "day_2")]
    assert shades == sorted(set(shades))


def test_the_heatmap_of_a_task_has_no_training_on_another_task(tmp_path):
    trials = [
        trial(seed=seed, task=task, light=f"day_{k}") for task in ("ahead", "bend") for k in range(6) for seed in (0, 1)
    ]
    trained = {"a": TRAINED | {"run": "a", "test": result(38, 40)}}
    page(tmp_path, said := told(trials, training=trained))
    html = validation_page("road", tmp_path, said, [])
    charts = [svg[: svg.index("</svg>")] for svg in html.split("<svg")[1:]]
    assert ["training’s result" in chart for chart in charts] == [True, False]


def test_where_no_lighting_is_shared_there_is_no_mean():
    trials = [trial("ab"[k % 2], seed, light=f"day_{k}") for k in range(6) for seed in range(3)]
    drawn = tiles(rate_heatmap(summarize(trials)["cells"], {}))
    assert set(drawn) == {("ab"[k % 2], f"day_{k}") for k in range(6)}


def test_paired_comparisons_are_a_heatmap_with_the_best_on_top():
    """`good` arrives in 20 episodes, `fair` in 2, `poor` in none; a difference of two may be chance."""
    won = {"poor": 0, "good": 20, "fair": 2}
    trials = [trial(name, seed, "goal" if seed < n else "collision") for name, n in won.items() for seed in range(20)]
    drawn = tiles(pair_heatmap(summarize(trials)["pairs"]))
    assert {key: text for key, (text, _) in drawn.items()} == {
        ("good  1", "2"): "+18", ("good  1", "3"): "+20", ("fair  2", "1"): "−18",
        ("fair  2", "3"): "(+2)", ("poor  3", "1"): "−20", ("poor  3", "2"): "(−2)",
    }  # fmt: skip
    color = {key: face for key, (_, face) in drawn.items()}
    assert to_hex(color["good  1", "2"]) == SERIES[0] and to_hex(color["fair  2", "1"]) == SERIES[1]
    assert color["good  1", "2"] == color["good  1", "3"] != color["fair  2", "1"] == color["poor  3", "1"]
    chance = color["fair  2", "3"]
    assert chance == color["poor  3", "2"] and chance[3] < color["good  1", "2"][3]


def test_policies_without_shared_episodes_are_not_compared():
    assert summarize([trial("a", 1), trial("b", 2), trial("c", 1, light="night")])["pairs"] == []
    (pair,) = summarize([trial("a", 1), trial("b", 1), trial("c", 2)])["pairs"]
    assert (pair["a"], pair["b"], pair["episodes"]) == ("a", "b", 1)


def test_long_tables_are_collapsed_below_a_figure(tmp_path):
    policies, lights = [f"p{k}" for k in range(8)], [f"day_{k}" for k in range(5)]
    many = [(p, light, seed) for p in policies for light in lights for seed in range(3)]
    trials = [trial(p, seed, trust=0.9 if seed else 0.1, light=light) for p, light, seed in many]

    def sections(trials) -> list[tuple[int, int]]:
        """Figures and folded parts of each section with tables."""
        said = told(trials)
        page(tmp_path, said)
        html = validation_page("road", tmp_path, said, [])
        starts = [html.index(f'<section id="{name}"') for name in ("arrive", "better", "trust")]
        parts = [html[start : html.index("</section>", start)] for start in starts]
        return [(part.count("<svg"), part.count("<details")) for part in parts]

    assert sections(trials) == [(1, 2), (1, 1), (0, 1)]  # the first also has the definitions
    assert sections([t for t in trials if t.policy in "p0 p1"]) == [(1, 1), (0, 0), (0, 0)]
