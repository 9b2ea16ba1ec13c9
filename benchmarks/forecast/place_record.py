"""Record of a place in files under version control: every episode and trial, and the policies' digests.

    results/version_N/place_P/
      place.json            figures of build and trainings; robot and camera, with values outside training's ranges
      policies.json         digest of every policy, written before the first trial
      episodes.csv.gz       a row per episode in the twin
      trials.csv.gz         a row per trial in the simulated reality

The same tables give the same bytes. A table that would lose or change a recorded row is refused.
"""

import gzip
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from protocol import Protocol

from twin.config import HELD_OUT, Condition
from twin.errors import InputError
from twin.evaluation.trials import EPISODE_COLUMNS, Trial, csv_text, read_trials
from twin.files import digest_file, read_json, write_bytes, write_json
from twin.types import Array

EPISODES, TRIALS = "episodes.csv.gz", "trials.csv.gz"
POLICIES, PLACE, FAILURE = "policies.json", "place.json", "failure.json"
HELD_OUT_CONDITION = str(Condition(HELD_OUT, True))


def by_photo(day: str) -> str:
    """The twin's condition for a day: lighting from the day's photo, everything else randomized."""
    return str(Condition(day, True))


@dataclass(frozen=True)
class PlaceRecord:
    """Counts of n policies on k days at one place."""

    place: int
    policies: tuple[str, ...]
    """Names of the trainings' setups, in the protocol's order."""
    days: tuple[str, ...]
    twin: Array
    """Successes and episodes in the twin under the lighting of each day's photo, or under held-out lightings if the
    photo's pose was not found; shape (n, k, 2)."""
    held_out: Array
    """Successes and episodes under held-out lightings, shape (n, 2)."""
    real: Array
    """Successes and trials in the simulated reality, shape (n, k, 2)."""


def freeze(folder: Path, runs: dict[str, Path]) -> None:
    """Records the digests of trained policies; `runs` maps their names to folders.

    Raises InputError: the record has other digests, so other policies would drive than those recorded.
    """
    digests = {name: digest_file(path / "policy.json") for name, path in runs.items()}
    record = folder / POLICIES
    if record.exists() and read_json(record) != digests:
        raise InputError(f"{record} has other policies than those trained now; move it away, or restore the runs")
    folder.mkdir(parents=True, exist_ok=True)
    write_json(record, digests)


def keep(path: Path, trials: list[Trial]) -> None:
    """Writes a table of trials, sorted.

    Raises InputError: the existing table, which is kept, has rows that are not among `trials`.
    """
    new = sorted(trials, key=lambda one: (one.policy, one.task, one.lighting, one.seed))
    gone = set(read_trials(path)) - set(new) if path.exists() else set()
    if gone:
        one = min(gone, key=lambda one: one.row())
        raise InputError(
            f"{path} has {len(gone)} rows that the new table lacks, such as {','.join(one.row())}; it is kept: "
            "move it away, or restore the scene that it was written from"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    text = csv_text(EPISODE_COLUMNS, [one.row() for one in new])
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", mtime=0, filename="") as file:
        file.write(text.encode())
    write_bytes(path, out.getvalue())


def read_place(folder: Path, place: int, protocol: Protocol) -> PlaceRecord | None:
    """The record of a place; None if trials or episodes of the protocol are missing."""
    policies, days = tuple(protocol.setups), protocol.days_of(place)
    if not (folder / TRIALS).exists() or not (folder / EPISODES).exists():
        return None
    twin, real = _counts(read_trials(folder / EPISODES)), _counts(read_trials(folder / TRIALS))
    held_out = [twin.get((policy, HELD_OUT_CONDITION), (0, 0)) for policy in policies]
    placed = read_json(folder / PLACE)["photos_placed"] if (folder / PLACE).exists() else {}
    photo = [
        [twin.get((policy, by_photo(day)), (0, 0)) if placed.get(day, True) else counts for day in days]
        for policy, counts in zip(policies, held_out, strict=True)
    ]
    driven = [[real.get((policy, day), (0, 0)) for day in days] for policy in policies]
    record = PlaceRecord(place, policies, tuple(days), np.array(photo), np.array(held_out), np.array(driven))
    episodes = [protocol.episodes if placed.get(day, True) else protocol.held_out_episodes for day in days]
    wanted = ((record.twin, episodes), (record.held_out, protocol.held_out_episodes), (record.real, protocol.trials))
    return record if all((counts[..., 1] >= count).all() for counts, count in wanted) else None


def _counts(trials: list[Trial]) -> dict[tuple[str, str], tuple[int, int]]:
    out: dict[tuple[str, str], tuple[int, int]] = {}
    for one in trials:
        won, driven = out.get((one.policy, one.lighting), (0, 0))
        out[one.policy, one.lighting] = won + one.success, driven + 1
    return out
