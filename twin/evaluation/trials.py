"""Tables of trials in the twin, which `twin.validate` writes, and of trials on the road.

A *trial* is one drive of a policy, on a task, under a lighting; it succeeds or fails. A *cell* is all trials of one
policy, task and lighting. `validation/episodes.csv` has a row for each trial in the twin. A *results table*, such as
`real.csv` or `results.csv`, has a row for each cell of real trials:

    policy,lighting,trials,successes            optional columns: task, twin_lighting

`task` is required only for a policy that was validated on several tasks. `twin_lighting` names the twin's lighting to
compare with, such as `held-out+randomised` for `dusk_on_monday`; it is required if `lighting` is not the name of one
of the twin's lightings.

A validation's summary compares two policies on *paired* episodes, which share lighting and seed, by the exact McNemar
test. It takes two counts: the episodes in which only policy A succeeded, and those in which only policy B succeeded.
"""

import csv
import gzip
import io
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from twin.config import CAUSES
from twin.errors import InputError, name_hint
from twin.evaluation.statistics import rate_summary, wilson
from twin.files import read_text, wrap_read_errors, write_text

REAL_CSV = "real.csv"
"""Name of the results table in a scene's folder."""
EPISODE_COLUMNS = ("policy", "task", "lighting", "seed", "success", "cause", "progress_m", "steps", "trust")
"""Columns of `validation/episodes.csv`; `trust` is the trial's mean trust (`twin.env.trust`), or empty."""
CELL_COLUMNS = ("policy", "task", "lighting", "trials", "successes", "rate", "low", "high")
"""Columns of `validation/cells.csv`: counts of episodes, with Wilson's interval."""
RESULT_COLUMNS = ("policy", "lighting", "trials", "successes")
"""Required columns of a results table."""
SETUP_COLUMNS = ("place", "day", "robot", "camera", "outside_training")
"""Columns that `twin.reality` adds: numbers of place, day, robot and camera, and the parameters of robot and camera
that lie outside the training's ranges."""
OPTIONAL_RESULT_COLUMNS = ("task", "twin_lighting", *SETUP_COLUMNS)
"""Further columns that a results table may have."""

_MAX_COUNT, _MAX_SEED = 10**6, 2**63 - 1  # largest count in a table, and largest seed
_VALIDATE_COMMAND = "twin validate"


@dataclass(frozen=True)
class Trial:
    """One drive, in the twin or on the road."""

    policy: str
    task: str
    lighting: str
    seed: int
    cause: str
    """One of `twin.config.CAUSES`; only `goal` is a success."""
    progress: float
    """Distance along the task's route segment [m]."""
    steps: int
    """Control steps."""
    trust: float | None = None
    """Mean over the pictures (see `twin.env.trust`), in [0, 1]; None without pictures."""

    @property
    def success(self) -> bool:
        return self.cause == "goal"

    @property
    def cell(self) -> tuple[str, str, str]:
        """Key of the trial's cell."""
        return self.policy, self.task, self.lighting

    @property
    def key(self) -> tuple[str, str, str, int]:
        return *self.cell, self.seed

    def row(self) -> tuple[str, ...]:
        """Fields of `EPISODE_COLUMNS`."""
        trust = "" if self.trust is None else f"{self.trust:.4f}"
        head = (self.policy, self.task, self.lighting, str(self.seed), str(int(self.success)), self.cause)
        return (*head, f"{self.progress:.3f}", str(self.steps), trust)


@dataclass(frozen=True)
class Cell:
    """Trials of one policy on one task under one lighting."""

    policy: str
    task: str
    lighting: str
    trials: int
    successes: int
    twin_lighting: str = ""
    """For a real cell, the twin's lighting to compare with; empty: the one named `lighting`."""

    @property
    def key(self) -> tuple[str, str, str]:
        return self.policy, self.task, self.lighting

    @property
    def twin_key(self) -> tuple[str, str, str]:
        """Key of the twin's cell to compare a real cell with."""
        return self.policy, self.task, self.twin_lighting or self.lighting

    @property
    def rate(self) -> float:
        return self.successes / self.trials


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as CSV text with a header."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([columns, *rows])
    return out.getvalue()


def tally(trials: Iterable[Trial]) -> list[Cell]:
    """Counts trials by cell, in the order in which the cells first occur."""
    counts: dict[tuple[str, str, str], list[int]] = {}
    for trial in trials:
        count = counts.setdefault(trial.cell, [0, 0])
        count[0] += 1
        count[1] += trial.success
    return [Cell(*key, trials=n, successes=k) for key, (n, k) in counts.items()]


def cells_csv(cells: Iterable[Cell]) -> str:
    """Text of `validation/cells.csv`."""
    rows = []
    for c in cells:
        low, high = wilson(c.successes, c.trials)
        numbers = (str(c.trials), str(c.successes), f"{c.rate:.4f}", f"{low:.4f}", f"{high:.4f}")
        rows.append((c.policy, c.task, c.lighting, *numbers))
    return csv_text(CELL_COLUMNS, rows)


def read_real_trials(table: Path, out: Path) -> list[Trial]:
    """The real trials in `table`, if it exists.

    Raises InputError: the results table `out` has further trials or other outcomes, which `write_real_trials` would
    lose.
    """
    known = read_trials(table) if table.exists() else []
    explained = {cell.key: (cell.trials, cell.successes) for cell in tally(known)}
    for key, (where, row) in _recorded(out).items():
        trials, won = (_parse_int(where, row, name) for name in ("trials", "successes"))
        mine, mine_won = explained.get(key, (0, 0))
        what = f"{out}: {trials} trials of {key[0]} under {key[2]}"
        if trials > mine:
            raise InputError(
                f"{what}, but {table.name} has {mine} of them; give another --out, and join the two files by hand"
            )
        # It has fewer if a command was killed between writing the two tables.
        if won > mine_won or trials - won > mine - mine_won:
            raise InputError(
                f"{what}, {won} of them successes, but {table.name} has {mine_won} of {mine}; correct outcomes there"
            )
    return known


def recorded_twin_lighting(out: Path, cell: tuple[str, str, str]) -> str | None:
    """The twin's lighting with which the results table `out` compares a cell (policy, task, lighting).

    It is that of another policy on the same task and day if the table does not have the cell; None if it has neither.
    """
    rows = {key: row for key, (_, row) in _recorded(out).items() if key[1:] == cell[1:]}
    row = rows.get(cell) or next(iter(rows.values()), {})
    return row.get("twin_lighting") or row.get("lighting")


def check_twin_lighting(out: Path, cell: tuple[str, str, str], wanted: str | None) -> str | None:
    """Returns the twin's lighting with which the results table `out` compares a cell, or the wanted one for a new cell.

    Raises InputError: the table has another one.
    """
    recorded = recorded_twin_lighting(out, cell)
    if recorded and wanted and recorded != wanted:
        raise InputError(
            f"{out}: trials under {cell[2]} are compared with {recorded!r}, not with {wanted!r}; give "
            f"--twin-lighting {recorded}, or change the column twin_lighting in all rows of {cell[2]}"
        )
    return recorded or wanted


def _recorded(out: Path) -> dict[tuple[str, str, str], tuple[str, dict[str, str]]]:
    """Location and fields of each row of a results table, by policy, task (empty if not given) and lighting.

    Empty if there is no such table, or it has no rows. Names and counts are not checked. Raises InputError: two rows
    of one cell.
    """
    if not out.exists() or sum(bool(line.strip()) for line in _table_text(out).splitlines()) < 2:
        return {}
    rows = _rows(out, RESULT_COLUMNS, OPTIONAL_RESULT_COLUMNS)
    found: dict[tuple[str, str, str], tuple[str, dict[str, str]]] = {}
    for where, row in rows:
        key = row["policy"], row.get("task", ""), row["lighting"]
        if key in found:
            raise InputError(f"{where}: {key[0]} under {key[2]} is in {found[key][0]}, too; make one row of the two")
        found[key] = where, row
    return found


def write_real_trials(
    trials: Sequence[Trial],
    table: Path,
    out: Path,
    twin_lighting: str,
    setup: Callable[[str], tuple[str, ...]] | None = None,
) -> None:
    """Writes real trials, one row each, to `table`, and their counts to the results table `out`.

    Cells that are already in `out` keep their `twin_lighting` and `SETUP_COLUMNS`. For other cells, `setup`, if given,
    returns the values of `SETUP_COLUMNS` for a lighting's name.
    """
    known = {cell: row for cell, (_, row) in _recorded(out).items()}
    rows = []
    for c in tally(trials):
        new = {"twin_lighting": twin_lighting}
        new |= dict(zip(SETUP_COLUMNS, setup(c.lighting), strict=True)) if setup else {}
        counts = {"policy": c.policy, "lighting": c.lighting, "trials": str(c.trials), "successes": str(c.successes)}
        rows.append({**known.get(c.key, new), **counts, "task": c.task})
    wide = any(SETUP_COLUMNS[0] in row for row in rows)
    columns = (*RESULT_COLUMNS, *OPTIONAL_RESULT_COLUMNS)[: None if wide else -len(SETUP_COLUMNS)]
    for path, text in (
        (table, csv_text(EPISODE_COLUMNS, [trial.row() for trial in trials])),
        (out, csv_text(columns, [[row.get(name) or "" for name in columns] for row in rows])),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)


def read_trials(path: Path) -> list[Trial]:
    """Reads a table such as `validation/episodes.csv`, which may be compressed (`.csv.gz`).

    Raises InputError: no such file, or an invalid row (the message gives its line).
    """
    if not path.exists():
        raise InputError(
            f"{path} does not exist; drive the policies in the twin first: {_VALIDATE_COMMAND} SCENE --policy RUN"
        )
    trials: dict[tuple[str, str, str, int], Trial] = {}
    for where, row in _rows(path, EPISODE_COLUMNS, (), f"run {_VALIDATE_COMMAND} again"):
        if row["cause"] not in CAUSES:
            raise InputError(f"{where}: cause = {row['cause']!r}; expected one of {', '.join(CAUSES)}")
        if row["success"] != str(int(row["cause"] == "goal")):
            raise InputError(
                f"{where}: success = {row['success']!r} with cause {row['cause']!r}; expected 1 where the cause is "
                f"goal, else 0; run {_VALIDATE_COMMAND} again"
            )
        trust = _parse_float(where, row, "trust") if row["trust"] else None
        key = row["policy"], row["task"], row["lighting"], _parse_int(where, row, "seed")
        progress, steps = _parse_float(where, row, "progress_m"), _parse_int(where, row, "steps")
        if key in trials:
            raise InputError(f"{where}: seed {key[3]} of this policy, task and lighting is there twice; delete one")
        trials[key] = Trial(*key, row["cause"], progress, steps, trust)
    return list(trials.values())


def trials_so_far(path: Path) -> list[Trial]:
    """The trials in a table; empty if it is missing, or has no rows since its first trial was not written."""
    return read_trials(path) if path.exists() and path.read_bytes().count(b"\n") > 1 else []


def read_results(paths: Sequence[Path], twin: Sequence[Cell]) -> list[Cell]:
    """Reads results tables and checks that the twin has a cell to compare with each real cell.

    Raises InputError: no such file, a wrong header, or a line with an unknown name or an impossible count, or a line
    that repeats another one of any of the tables or compares a day with another lighting of the twin.
    """
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist; write one, with the columns {','.join(RESULT_COLUMNS)}")
    cells: dict[tuple[str, str, str], Cell] = {}
    places: dict[tuple[str, str, str], str] = {}  # cell key → file and line
    known, spelled = {cell.key for cell in twin}, dict[str, tuple[str, str]]()
    compared: dict[tuple[str, str], tuple[str, str]] = {}  # task and day → the twin's lighting, file and line
    for where, row in chain.from_iterable(_rows(path, RESULT_COLUMNS, OPTIONAL_RESULT_COLUMNS) for path in paths):
        policy, task = _policy_and_task(where, row, twin)
        trials, successes = _parse_int(where, row, "trials"), _parse_int(where, row, "successes")
        if trials == 0:
            raise InputError(f"{where}: trials = 0; expected at least 1; delete the line until there are trials")
        if successes > trials:
            raise InputError(f"{where}: successes = {successes} of {trials} trials; expected at most {trials}")
        cell = Cell(policy, task, row["lighting"], trials, successes, row.get("twin_lighting") or row["lighting"])
        if cell.twin_key not in known:
            raise InputError(f"{where}: {_unknown_lighting(cell, known)}")
        if cell.key in cells:
            raise InputError(
                f"{where}: policy {policy!r}, lighting {cell.lighting!r}, task {task!r} is in {places[cell.key]}, too; "
                "if these are other trials, replace the two lines by one with their sums, else delete one"
            )
        lighting, first = compared.setdefault((task, cell.lighting), (cell.twin_key[2], where))
        if lighting != cell.twin_key[2]:
            raise InputError(
                f"{where}: {cell.lighting!r} is compared with {cell.twin_key[2]!r}, but with {lighting!r} in {first}; "
                "policies are compared under one lighting of the twin: give the same in all rows of a day"
            )
        # A forecast counts days by their names, so a day written in two ways would make intervals too narrow.
        alike, place = spelled.setdefault(_spelling(cell.lighting), (cell.lighting, where))
        if alike != cell.lighting and not {alike, cell.lighting} <= {key[-1] for key in known}:
            raise InputError(f"{where}: lighting {cell.lighting!r}, but {alike!r} in {place}; use one spelling")
        cells[cell.key], places[cell.key] = cell, where
    return list(cells.values())


_HYPHENS = str.maketrans(dict.fromkeys("‐‑‒–—−", "-"))


def _spelling(name: str) -> str:
    """A name without what the eye does not see: case, repeated spaces, invisible characters, and the encoding of
    accents and hyphens.
    """
    seen = "".join(c for c in unicodedata.normalize("NFKC", name) if unicodedata.category(c) != "Cf")
    return " ".join(seen.translate(_HYPHENS).casefold().split())


def _policy_and_task(where: str, row: dict[str, str], twin: Sequence[Cell]) -> tuple[str, str]:
    policy, task = row["policy"], row.get("task", "")
    policies = list(dict.fromkeys(cell.policy for cell in twin))
    if policy not in policies:
        hint = name_hint(policy, policies, f"run {_VALIDATE_COMMAND} with --policy {policy}")
        raise InputError(f"{where}: policy {policy!r} was not validated; {hint}")
    tasks = list(dict.fromkeys(cell.task for cell in twin if cell.policy == policy))
    if not task and len(tasks) > 1:
        valid = " and ".join(tasks)
        raise InputError(f"{where}: policy {policy!r} was validated on {valid}; add a column task that says which")
    if task and task not in tasks:
        raise InputError(f"{where}: policy {policy!r} was not validated on task {task!r}; {_name_hint(task, tasks)}")
    return policy, task or tasks[0]


def _unknown_lighting(cell: Cell, known: set[tuple[str, str, str]]) -> str:
    name = cell.twin_key[2]
    here = sorted(lighting for policy, task, lighting in known if (policy, task) == (cell.policy, cell.task))
    if any(name == lighting for _, _, lighting in known):
        return (
            f"policy {cell.policy!r} was not validated under {name!r}; run {_VALIDATE_COMMAND} with --lightings {name}"
        )
    return (
        f"lighting {name!r} is not in the twin; {_name_hint(name, here)}; or add a column "
        "twin_lighting with the twin's lighting to compare with"
    )


def _name_hint(name: str, valid: Sequence[str]) -> str:
    """End of an error message: "did you mean ...?", or the valid names."""
    longer = [one for one in valid if one.startswith(f"{name}+")]
    return f"did you mean {longer[0]!r}?" if longer else name_hint(name, valid)


def _rows(
    path: Path,
    needed: Sequence[str],
    optional: Sequence[str],
    if_empty: str = "add one line per policy and lighting",
) -> Iterable[tuple[str, dict[str, str]]]:
    """Yields for each row its location (file and line), and its fields by column name."""
    reader = csv.reader(io.StringIO(_table_text(path)))
    wanted = ",".join(needed) + "".join(f"[,{name}]" for name in optional)
    try:
        header = [name.strip() for name in next((row for row in reader if any(map(str.strip, row))), [])]
        if not header:
            raise InputError(f"{path} is empty; its first line must be {wanted}")
        missing = [name for name in needed if name not in header]
        unknown = [name for name in header if name not in (*needed, *optional)]
        twice = [name for name, times in Counter(header).items() if times > 1]
        faults = [
            *(f"no column {name}" for name in missing),
            *(f"column {header.index(name) + 1} has no name; delete it" for name in unknown if not name),
            *(f"unknown column {name!r}" for name in unknown),
            *(f"column {name!r} appears twice" for name in twice),
        ]
        if len(header) == 1 and (other := next((one for one in ";\t" if one in header[0]), "")):
            faults = [f"its columns are separated by {other!r}, not by commas"]
        if faults:
            raise InputError(f"{path}: header {','.join(header)!r}: {faults[0]}; expected {wanted}")
        count, end = 0, reader.line_num
        for fields in reader:
            # A row may span several lines, because of a quoted field; the message has its first one.
            where, end = f"{path} line {end + 1}", reader.line_num
            if not any(field.strip() for field in fields):
                continue
            count += 1
            if len(fields) != len(header):
                raise InputError(f"{where}: {len(fields)} fields; expected {len(header)}, as in the header")
            row = {name: field.strip() for name, field in zip(header, fields, strict=True)}
            if list(row.values()) == header:
                raise InputError(f"{where} repeats the header; delete it")
            for name in ("policy", "lighting"):
                if not row[name]:
                    raise InputError(f"{where}: no {name}; expected a name")
            yield where, row
    except csv.Error as error:
        raise InputError(f"{path} line {reader.line_num}: {error}; expected comma-separated text") from None
    if not count:
        raise InputError(f"{path} has a header and no rows; {if_empty}")


def _table_text(path: Path) -> str:
    """Text of a table, which may be compressed, with line ends `\\n`. Raises InputError: the file is damaged."""
    if path.suffix != ".gz":
        text = read_text(path)
    else:
        with wrap_read_errors(path, "restore it"):
            text = gzip.decompress(path.read_bytes()).decode()
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _parse_int(where: str, row: dict[str, str], name: str) -> int:
    text = row[name]
    most = _MAX_SEED if name == "seed" else _MAX_COUNT
    if not (text.isascii() and text.isdecimal()):
        raise InputError(f"{where}: {name} = {text!r}; expected a whole number, 0 or more")
    if len(text.lstrip("0")) > len(str(most)) or int(text) > most:
        raise InputError(f"{where}: {name} = {text!r}; expected at most {most:,}")
    return int(text)


def _parse_float(where: str, row: dict[str, str], name: str) -> float:
    try:
        value = float(row[name])
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise InputError(f"{where}: {name} = {row[name]!r}; expected a number")
    return value


# ---- summary of a validation

TRUSTED = 0.8
"""An episode is counted separately if the mean trust in its pictures is lower."""


def success_rate(trials: Sequence[Trial]) -> dict[str, Any]:
    return rate_summary(sum(t.success for t in trials), len(trials))


def summarize(trials: Sequence[Trial]) -> dict[str, Any]:
    """Counts successes and causes of failure per policy, task and lighting, and compares policies in pairs."""
    by_cell: dict[tuple[str, str, str], list[Trial]] = {}
    for trial in trials:
        by_cell.setdefault(trial.cell, []).append(trial)
    cells = []
    for (policy, task, lighting), own in by_cell.items():
        trusted, low = (
            [t for t in own if (t.trust is not None and t.trust >= TRUSTED) == good] for good in (True, False)
        )
        cells.append(
            {"policy": policy, "task": task, "lighting": lighting}
            | success_rate(own)
            | {"causes": {c: n for c, n in Counter(t.cause for t in own).items() if c != "goal"}}
            | {"trusted": success_rate(trusted), "low_trust": success_rate(low)}
        )
    return {"confidence": 0.9, "trusted_from": TRUSTED, "cells": cells, "pairs": compare_pairs(trials)}


def compare_pairs(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Compares the policies of each task in pairs, on the episodes that both drove; omits pairs without any."""
    by_policy: dict[tuple[str, str], dict[tuple[str, int], bool]] = {}
    for t in trials:
        by_policy.setdefault((t.task, t.policy), {})[t.lighting, t.seed] = t.success
    out = []
    for (task, a), (other, b) in combinations(by_policy, 2):
        first, second = by_policy[task, a], by_policy[other, b]
        both = [(first[key], second[key]) for key in first if key in second]
        if task != other or not both:
            continue
        only_a, only_b = sum(x and not y for x, y in both), sum(y and not x for x, y in both)
        chance = float(binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0
        out.append(
            {"task": task, "a": a, "b": b, "episodes": len(both), "only_a": only_a, "only_b": only_b, "p": chance}
        )
    return out


def typical_episode(trials: Sequence[Trial]) -> Trial:
    """The episode with the median progress. For an even number of episodes, it is the upper one of the middle two."""
    return sorted(trials, key=lambda t: t.progress)[len(trials) // 2]


def worst_episode(trials: Sequence[Trial]) -> Trial:
    """The failed episode with the least progress; if none failed, the one with the lowest trust."""
    failed = [t for t in trials if not t.success]
    if failed:
        return min(failed, key=lambda t: t.progress)
    return min(trials, key=lambda t: 1.0 if t.trust is None else t.trust)
