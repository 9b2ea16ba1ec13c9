"""The fuzzer: no reader and no verb fails, and its oracle detects each kind of failure; see `benchmarks/fuzz.py`."""

import sys
from random import Random

import fuzz
import pytest
from fuzzing import cases, values

from twin.errors import InputError

CASES, SEED = 2000, 1


def test_no_reader_and_no_verb_fails():
    rows = fuzz.run_cases(fuzz.allocate_cases(CASES), SEED)
    assert not [one for row in rows.values() for one in row.failures], fuzz.table(rows)
    # Each target refuses some cases and accepts some, except zips that run code and unbuilt scenes.
    assert all(row.refused for row in rows.values()), fuzz.table(rows)
    assert all(row.accepted for name, row in rows.items() if name not in ("zip", "verb")), fuzz.table(rows)


@pytest.mark.slow
def test_no_verb_fails_on_the_command_line():
    row = fuzz.run_command_lines(30, SEED)
    assert row.cases == 30 and not row.failures, fuzz.table({"command line": row})


def _failure(tmp_path, run, seconds=5.0):
    """The failure that the oracle reports for a target."""
    for name in ("kept", "cwd"):
        (tmp_path / name).mkdir(exist_ok=True)
    (tmp_path / "kept" / "notes.txt").write_text("kept\n")
    return cases.run_case(cases.Target("own", 1, run), SEED, 0, tmp_path, None, seconds).failure


def test_the_oracle_detects_failures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def raises(error):
        def run(case):
            raise error

        return run

    assert _failure(tmp_path, lambda case: None) == ""
    assert _failure(tmp_path, raises(InputError("value 3; expected 2"))) == ""
    two_lines = InputError("")
    two_lines.args = ("a\nb",)
    assert "several lines" in _failure(tmp_path, raises(two_lines))
    assert "KeyError" in _failure(tmp_path, raises(KeyError("name")))
    assert "SystemExit" in _failure(tmp_path, raises(SystemExit(3)))
    assert _failure(tmp_path, raises(cases.Violation("not finite"))) == "not finite"
    assert "notes.txt" in _failure(tmp_path, lambda case: (case.folder / "../kept/notes.txt").write_text("lost"))
    assert "new" in _failure(tmp_path, lambda case: (case.folder / "../cwd/new").write_text("new"))
    assert "payload" in _failure(tmp_path, lambda case: (tmp_path / "marker").write_text("ran"))

    def hangs(case):
        while True:
            pass

    assert "more than 0.2 s" in _failure(tmp_path, hangs, 0.2)


@pytest.mark.parametrize(
    ("status", "err", "passes"),
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
def test_accepted_exits_of_a_verb(status, err, passes):
    if passes:
        cases.check_refusal(status, err)
    else:
        with pytest.raises(cases.Violation):
            cases.check_refusal(status, err)


def test_a_case_depends_on_its_seed_alone():
    texts = [values.json_text(values.mutated(Random("1/a/7"), {"a": [1, {"b": 2}]})) for _ in range(2)]
    assert texts[0] == texts[1]
    assert sys.getrecursionlimit() < values.DEEP_NESTING
