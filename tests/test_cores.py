"""Number of cores that a process may use."""

import os

import pytest

from twin import runtime


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(runtime, "_core_limit", None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda who: set(range(8)))
    runtime._quota.cache_clear()
    yield
    runtime._quota.cache_clear()


@pytest.mark.parametrize(
    ("said", "wanted"), [("max 100000", 8), ("250000 100000", 2), ("10000 100000", 1), ("what", 8), (None, 8)]
)
def test_available_cores_obey_the_quota_of_a_container(tmp_path, monkeypatch, said, wanted):
    file = tmp_path / "cpu.max"
    if said:
        file.write_text(said + "\n")
    monkeypatch.setattr(runtime, "_QUOTA", file)
    assert runtime.available_cores() == wanted


def test_available_cores_obey_the_limit_of_a_process():
    runtime.limit_cores(3)
    assert runtime.available_cores() == min(3, runtime._quota() or 3)
