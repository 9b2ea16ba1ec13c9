"""Kills, full disks and endurance in small sizes; see `benchmarks/robustness.py`."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import robustness

pytestmark = pytest.mark.slow


def test_eight_environments_do_not_leak(tmp_path):
    found = robustness.endurance(12_000, tmp_path)
    assert found["ok"] and found["steps"] == 12_000 and found["episodes"] > 60, found


def test_a_full_disk_loses_nothing(tmp_path):
    try:
        with robustness.small_disk(tmp_path / "disk", 1 << 20):
            pass
    except OSError as error:
        pytest.skip(f"mounting a tmpfs is not permitted: {error}")
    found = robustness.full_verbs(tmp_path)
    assert len(found) == 10 and set(found.values()) == {"ok"}, found


@pytest.mark.parametrize("verb", ["train", "validate"])
def test_killed_verbs_resume_to_the_same_result(tmp_path, verb):
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    killed = {"train": robustness._killed_trainings, "validate": robustness._killed_validations}[verb]
    found = killed(2, tmp_path, np.random.default_rng(1))
    assert found["ok"] and found["killed"] == 2, found
