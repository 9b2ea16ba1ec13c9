"""Fuzz targets of tables: results, episodes, training curves, drive logs in CSV and npz."""

import struct
import zipfile
from pathlib import Path
from random import Random

import numpy as np

from fuzzing.cases import Case
from fuzzing.samples import EPISODES_CSV, RESULTS_CSV, TRAINING_CSV, Payload
from fuzzing.values import corrupted, hostile_literal, hostile_text, mutated_text


def mutated_csv(rng: Random, text: str) -> bytes:
    """Bytes of a CSV with one or two changed cells or rows, further mutated by `mutated_text`."""
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(rng.choice((1, 1, 2))):
        row = rng.choice(rows[1:] if rng.random() < 0.8 else rows)
        what = rng.random()
        if what < 0.7:
            row[rng.randrange(len(row))] = rng.choice((hostile_text(rng), str(hostile_literal(rng))))
        elif what < 0.8:
            row.append(hostile_text(rng))
        elif what < 0.9:
            row.pop()
        else:
            rows.append(list(row))
        rows = [one or [""] for one in rows]
    return mutated_text(rng, "\n".join(",".join(row) for row in rows) + "\n")


def results(case: Case) -> None:
    from twin.evaluation.trials import read_results

    path = case.folder / "results.csv"
    path.write_bytes(mutated_csv(case.rng, RESULTS_CSV))
    read_results([path], case.samples.cells)


def episodes(case: Case) -> None:
    from twin.evaluation.trials import read_trials

    path = case.folder / "episodes.csv"
    path.write_bytes(mutated_csv(case.rng, EPISODES_CSV))
    read_trials(path)


def training(case: Case) -> None:
    from twin.learn.training import TRAINING_EPISODE_COLUMNS, _keep_rows

    (case.folder / "episodes.csv").write_bytes(mutated_csv(case.rng, TRAINING_CSV))
    _keep_rows(case.folder / "episodes.csv", TRAINING_EPISODE_COLUMNS, 1_000)


def log_csv(case: Case) -> None:
    from twin.sysid.log_files import read_log

    log = case.samples.log
    rows = zip(*(column[:60] for column in log.values()), strict=True)
    text = ",".join(log) + "\n" + "".join(",".join(f"{value:.5g}" for value in row) + "\n" for row in rows)
    path = case.folder / "log.csv"
    path.write_bytes(mutated_csv(case.rng, text))
    read_log(path)


def log_npz(case: Case) -> None:
    """A log with up to two hostile columns; in some cases, its file is then given a false header or corrupted."""
    from twin.sysid.log_files import read_log

    rng, columns = case.rng, dict(case.samples.log)
    path = case.folder / "log.npz"
    n = len(columns["time"])
    if rng.random() < 0.2:  # the columns of a public data set, by calibration step
        names = ("icp_x", "icp_y", "icp_yaw", "cmd_left", "cmd_right", "left_wheel_vel", "right_wheel_vel")
        columns |= {name: np.zeros((3, 40)) for name in (*names, "imu_acceleration_x")}
        columns |= {"calib_step": np.arange(3), "gt_icp_x": np.zeros(3), "imu_acceleration_y": np.zeros((3, 40))}
        columns |= {"gt_icp_y": np.zeros(3), "gt_icp_yaw": np.zeros(3)}
    for name in rng.sample(sorted(columns), rng.choice((0, 1, 2))):
        columns[name] = _hostile_column(rng, columns[name].copy(), n)
    np.savez(path, **columns)  # type: ignore[arg-type]
    if rng.random() < 0.4:
        _forge_npz(rng, path)
    elif rng.random() < 0.3:
        path.write_bytes(corrupted(rng, path.read_bytes()))
    read_log(path)


def _hostile_column(rng: Random, column: np.ndarray, n: int) -> np.ndarray:
    """A column with an extreme entry, or of another dtype, shape, content or order; n is the length of the log."""
    what = rng.random()
    if what < 0.3 and column.dtype.kind == "f":
        column.flat[rng.randrange(column.size)] = rng.choice((np.nan, np.inf, 1e308, -1e9))
        return column
    if what < 0.5:
        kinds = (bool, np.int8, complex, "U5", "S3", np.float16, "M8[s]", "m8[s]", np.uint64, [("a", "f8")])
        return np.zeros(n, rng.choice(kinds))  # type: ignore[arg-type]
    if what < 0.7:
        return rng.choice((np.zeros(()), column[:3], np.zeros((0, 40)), column[:, None], np.zeros((n, 0))))
    if what < 0.8:
        return np.array([Payload()] * 3, object)
    return np.sort(column)[::-1] * rng.choice((1.0, 1e3, 1e9, 0.0))


_SHAPES = ("(2147483648,)", "(9223372036854775807, 8)", "(-1,)", "(1e3,)", "()", "(0,)", "'a'", "(True,)")
_DTYPES = ("'<f8'", "'|O'", "'<U99999999'", "'x'", "[('a', '<f8')]", "'<V2147483647'", "None")


def _forge_npz(rng: Random, path: Path) -> None:
    """Replaces the header of an array, or gives an array data that unpacks to 64 MB."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(members))
    if rng.random() < 0.1:
        members[name] = members[name][:128] + bytes(64 << 20)
    else:
        shape, descr = rng.choice(_SHAPES), rng.choice(_DTYPES)
        header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
        text = rng.choice((header, "{" * 5000, "(" * 200, "", "{'descr': '<f8'}", "__import__('os').getcwd()"))
        version = rng.choice(((1, 0), (2, 0), (3, 0), (9, 9)))
        size = struct.pack("<H" if version == (1, 0) else "<I", rng.choice((len(text), 65535, 0)))
        members[name] = b"\x93NUMPY" + bytes(version) + size + text.encode() + members[name][128:]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
