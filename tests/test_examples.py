"""The examples run, for a few steps, on the small scene that stands in for the demo."""

import importlib.util
from pathlib import Path

import pytest
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.film import main as film

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
    root, out = str(scene), tmp_path / "sac.safetensors"
    options = ["--task", "ahead", "--steps", "120", "--warmup", "100", "--batch", "8", "--out", str(out)]
    example("sac").main([root, *options])
    assert " after " in capsys.readouterr().out and out.exists()


@pytest.mark.slow
def test_imitation_drives_as_it_was_shown(scene, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    root, drives = str(scene), tmp_path / "drives"
    assert film([root, "--task", "ahead", "--lerobot", str(drives), "--episodes", "2", "--quiet"]) == 0
    module = example("imitation")
    monkeypatch.setattr(module, "WEIGHTS", tmp_path / "imitation.safetensors")
    module.train(drives, steps=60)
    errors = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines() if "error" in line]
    assert errors[-1] < 0.3 * errors[0]
    observed = twin.load(scene, "ahead", 0).reset().observation["pixels"]
    action = module.act(observed.transpose(0, 3, 1, 2).reshape(-1, *observed.shape[1:3]))
    assert action.shape == (2,) and action[0] > 0.5  # ahead
