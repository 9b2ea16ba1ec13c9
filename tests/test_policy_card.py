"""Policy cards say what the records say, and what is missing."""

import json

import pytest
from test_policy import some_weights

from twin.evaluation.agreement import Estimate
from twin.evaluation.forecasting import make_forecast
from twin.evaluation.statistics import wilson
from twin.evaluation.trials import EPISODE_COLUMNS, Cell, read_trials, tally
from twin.files import digest_file, write_json
from twin.forecast import forecast
from twin.learn.policy import Control, save_policy
from twin.learn.policy_network import Architecture
from twin.report.policy_card import write_policy_cards
from twin.scene import SceneDir

ARCHITECTURE = Architecture(size=(32, 18), convolutions=((4, 5, 3),), features=8, hidden=(8,), actions=1)


@pytest.fixture
def scene(tmp_path) -> SceneDir:
    scene = SceneDir(tmp_path)
    trained = {"scene": "demo", "task": "straight", "lighting": "training", "observe": "nerf", "step": 12000, "seed": 0}
    save_policy(tmp_path / "runs/first", ARCHITECTURE, Control(), some_weights(ARCHITECTURE), trained)
    chosen = {"step": 12000, "trials": 20, "successes": 17, "reward": 1.0}
    write_json(tmp_path / "runs/first/choice.json", {"steps": 12000, "candidates": [chosen] * 4, "chosen": chosen})
    return scene


def validate(scene: SceneDir, outcomes: dict[str, str]) -> None:
    """Writes the tables of a validation; an outcome has a letter per episode, g for the goal."""
    scene.validation.mkdir(exist_ok=True)
    rows = [",".join(EPISODE_COLUMNS)]
    for lighting, letters in outcomes.items():
        for seed, letter in enumerate(letters):
            values = dict.fromkeys(EPISODE_COLUMNS, "0") | {"policy": "first", "task": "straight", "lighting": lighting}
            values |= {
                "seed": str(seed),
                "success": str(int(letter == "g")),
                "cause": "goal" if letter == "g" else "stuck",
            }
            rows.append(",".join(values[name] for name in EPISODE_COLUMNS))
    scene.episodes_csv.write_text("\n".join(rows) + "\n")
    digest = digest_file(scene.root / "runs/first/policy.json")
    write_json(scene.validation / "validated.json", {"roads": {}, "policies": {"first": digest}})


def test_a_card_after_training_has_no_success_in_the_twin(scene):
    (path,) = write_policy_cards(scene, ["first", "my_module:act", "first", "no\0name"])
    text = path.read_text()
    low, high = wilson(17, 20)
    assert path == scene.root / "runs/first/README.md" and text.startswith("---\nlibrary_name: twin\n")
    assert "| environment steps | 12,000 |" in text and f"17 times of 20 ({low:.2f} to {high:.2f})" in text
    assert "Not validated" in text and "Not driven on the real road." in text and "model-index" not in text


def test_a_validated_and_driven_policy_has_its_rates(scene):
    validate(scene, {"held-out": "g" * 9 + "x", "night": "gggx", "rain|wet": "gg"})
    cells = tally(read_trials(scene.episodes_csv))
    real = [Cell("first", "straight", day, 5, won, "held-out") for day, won in (("monday", 4), ("tuesday", 5))]
    make_forecast("demo", cells, real, 0, {("first", "straight"): Estimate(0.8, 0.6, 0.9, 20)}).save(scene.forecast)
    (path,) = write_policy_cards(scene, ["first"])
    text = path.read_text()
    assert "| straight | held-out | 9 of 10 | 0.90 (0.65 to 0.98) |" in text
    assert "| straight | night | 3 of 4 | 0.75" in text
    assert r"| straight | rain\|wet | 2 of 2 |" in text
    (row,) = [line for line in text.splitlines() if line.startswith("| straight | 10 |")]
    assert "0.90" in row
    front = text.split("---")[1]
    assert 'value: 0.9000, name: "success of 10 episodes (0.65 to 0.98)"' in front
    name = next(line for line in front.splitlines() if line.startswith("- name:")).removeprefix("- name: ")
    assert json.loads(name) == "first"


def test_a_forecast_has_the_final_test_of_a_training(scene):
    validate(scene, {"held-out": "g" * 9 + "x"})
    (candidate,) = forecast(scene.root).candidates
    assert (candidate.trained.value, candidate.trained.n) == (17 / 20, 20)
    (scene.root / "runs/first/choice.json").unlink()  # the policy has no test at all
    (candidate,) = forecast(scene.root).candidates
    assert candidate.trained.value is None and "not known" in candidate.trained.missing


def test_a_policy_that_was_trained_further_is_not_validated(scene):
    validate(scene, {"held-out": "ggg"})
    weights = {name: 2 * values for name, values in some_weights(ARCHITECTURE).items()}
    save_policy(scene.root / "runs/first", ARCHITECTURE, Control(), weights, {"task": "straight", "step": 24000})
    (path,) = write_policy_cards(scene, ["first"])
    assert "Not validated" in path.read_text()


def test_a_forecast_of_another_version_does_not_stop_the_cards(scene, capsys):
    scene.forecast.mkdir(exist_ok=True)
    (scene.forecast / "forecast.json").write_text('{"old_field": 1}')
    (path,) = write_policy_cards(scene, ["first"])
    assert "## On the road" in path.read_text() and "lack the forecast" in capsys.readouterr().err
