"""The examples run, for a few steps, on the small scene that stands in for the demo."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from picture_bag import START, camera_info, image, write
from test_policy import some_weights
from tiny_runs import SMALL
from tiny_twin import tiny_twin

import twin
from twin import commands, runtime
from twin.errors import InputError
from twin.learn.policy import Control, save_policy

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return tiny_twin(tmp_path_factory.mktemp("scene"))


def example(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_ppo_learns_and_is_evaluated(scene, tmp_path, capsys):
    root, out = str(scene), tmp_path / "ppo.zip"
    options = ["--task", "ahead", "--steps", "64", "--worlds", "2", "--rollout", "32", "--out", str(out)]
    example("ppo").main([root, *options])
    assert "return under held-out lightings" in capsys.readouterr().out and out.exists()


def test_sac_learns(scene, tmp_path, capsys):
    out = tmp_path / "sac.safetensors"
    example("sac").learn(scene, "ahead", steps=120, warmup=100, batch=8, out=out)
    assert " after " in capsys.readouterr().out and out.exists()


@pytest.mark.slow
def test_imitation_drives_as_it_was_shown(scene, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    root, drives = str(scene), tmp_path / "drives"
    assert commands.main("film", [root, "--task", "ahead", "--lerobot", str(drives), "--episodes", "2", "--quiet"]) == 0
    module = example("imitation")
    monkeypatch.setattr(module, "WEIGHTS", tmp_path / "imitation.safetensors")
    module.train(drives, steps=60)
    errors = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines() if "error" in line]
    assert errors[-1] < 0.3 * errors[0]
    observed = twin.load(scene, "ahead", 0).reset().observation["pixels"]
    action = module.act(observed.transpose(0, 3, 1, 2).reshape(-1, *observed.shape[1:3]))
    assert action.shape == (2,) and action[0] > 0.5  # ahead


def test_a_played_bag_stops_where_pictures_are_missing(tmp_path):
    """20 pictures at 10 Hz, half a second without any, 5 more: one stop, 0.3 s after the last picture."""
    save_policy(tmp_path / "policy", SMALL, Control(), some_weights(SMALL), {})
    size, stamps = (64, 36), [START + k * 100_000_000 for k in (*range(20), *range(26, 31))]
    info = camera_info((50.0, 50.0, 32.0, 18.0), size, START)
    picture = np.full((size[1], size[0], 3), 90, np.uint8)
    bag = write(tmp_path / "bag", [info, *(image(picture, stamp) for stamp in stamps)])
    played = example("play_bag").play(tmp_path / "policy", bag)
    stops = [(time - START) / 1e9 for time, command in played[1:] if command.cause]
    assert len(played) == len(stamps) + 1 and played[0][1].drives and 2.2 < stops[0] < 2.3
    with pytest.raises(InputError, match="no camera_info"):
        example("play_bag").play(tmp_path / "policy", write(tmp_path / "bare", [image(picture, START)]))
