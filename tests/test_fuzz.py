"""Hostile input to every reader and every verb is taken or refused in one line; see `benchmarks/fuzz.py`."""

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
CASES, SEED = 3000, 1


@pytest.fixture
def fuzzer(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import fuzz

    return fuzz


def test_no_reader_and_no_verb_fails(fuzzer):
    """In one child process, as a case may end it."""
    rows = fuzzer.fuzz(fuzzer.plan(CASES), SEED)
    assert not [one for row in rows.values() for one in row.failures], fuzzer.table(rows)
    # What all cases refuse, or all take, shows nothing; zips that run code and unbuilt scenes are never taken.
    assert all(row.refused for row in rows.values()), fuzzer.table(rows)
    assert all(row.accepted for name, row in rows.items() if name not in ("zip", "verb")), fuzzer.table(rows)


@pytest.mark.slow
def test_no_verb_fails_on_the_command_line(fuzzer):
    row = fuzzer.command_line(60, SEED)
    assert row.cases == 60 and not row.failures, fuzzer.table({"command line": row})


def _fails(fuzzer, tmp_path, run, seconds=5.0):
    for name in ("kept", "cwd"):
        (tmp_path / name).mkdir(exist_ok=True)
    (tmp_path / "kept" / "notes.txt").write_text("kept\n")
    return fuzzer.run_case(fuzzer.Target("own", 1, run), SEED, 0, tmp_path, None, seconds).failure


def test_what_the_oracle_takes_for_a_failure(fuzzer, tmp_path, monkeypatch):
    """It must find what it is there for."""
    from twin.errors import InputError

    monkeypatch.chdir(tmp_path)

    def raises(error):
        def run(case):
            raise error

        return run

    assert _fails(fuzzer, tmp_path, lambda case: None) == ""
    assert _fails(fuzzer, tmp_path, raises(InputError("value 3; expected 2"))) == ""
    uncut = InputError("")
    uncut.args = ("a\nb",)
    assert "several lines" in _fails(fuzzer, tmp_path, raises(uncut))
    assert "KeyError" in _fails(fuzzer, tmp_path, raises(KeyError("name")))
    assert "SystemExit" in _fails(fuzzer, tmp_path, raises(SystemExit(3)))
    assert "notes.txt" in _fails(fuzzer, tmp_path, lambda case: (case.folder / "../kept/notes.txt").write_text("lost"))
    assert "new" in _fails(fuzzer, tmp_path, lambda case: (case.folder / "../cwd/new").write_text("new"))
    assert "payload" in _fails(fuzzer, tmp_path, lambda case: (tmp_path / "marker").write_text("ran"))

    def hangs(case):
        while True:
            pass

    assert "more than 0.2 s" in _fails(fuzzer, tmp_path, hangs, 0.2)


@pytest.mark.parametrize(
    ("status", "err", "right"),
    [
        (0, "", True),
        (2, "error: no such file\n", True),
        (2, "capture\nerror: no such file\n", False),
        (2, "", False),
        (1, "Traceback (most recent call last):\nKeyError: 'a'\n", False),
        (-11, "", False),
        (2, "error: " + "x" * 2000 + "\n", False),
    ],
)
def test_how_a_verb_may_end(fuzzer, status, err, right):
    if right:
        fuzzer.check_refusal(status, err)
    else:
        with pytest.raises(fuzzer.Broken):
            fuzzer.check_refusal(status, err)


def test_a_case_is_drawn_from_its_number_alone(fuzzer):
    from random import Random

    import fuzz_values

    drawn = [fuzz_values.json_text(fuzz_values.spoiled(Random("1/a/7"), {"a": [1, {"b": 2}]})) for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert sys.getrecursionlimit() < fuzz_values.DEEP
