"""Drive logs: equal from every kind of file, without windows that have gaps, refused in one line if implausible."""

import re
from pathlib import Path

import numpy as np
import pytest
from drive_logs import columns, write_csv

from twin import commands
from twin.errors import InputError
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.sysid import kinematics, log_files, logs


def _bad(table: dict[str, np.ndarray], **changes) -> dict[str, np.ndarray]:
    return table | changes


def _with_nan(column: np.ndarray) -> np.ndarray:
    column = column.copy()
    column[37] = np.nan
    return column


BAD = {
    "nan": (lambda t: _bad(t, yaw=_with_nan(t["yaw"])), r"yaw is nan at row 38 .*cut those rows out"),
    "time": (
        lambda t: _bad(t, time=np.where(np.arange(len(t["time"])) == 50, 0.0, t["time"])),
        r"time goes from 2\.450 to 0\.000 s at row 51; expected it to increase",
    ),
    "yaw in degrees": (lambda t: _bad(t, yaw=np.degrees(t["yaw"])), r"yaw looks like degrees; multiply it by π/180"),
    "yaw too small": (lambda t: _bad(t, yaw=np.radians(t["yaw"])), r"yaw looks 180/π times too small"),
    "wheels in degrees": (
        lambda t: _bad(t, **{n: np.degrees(t[n]) for n in logs.WHEEL_SPEEDS}),
        r"wheel speeds look like °/s; multiply them by π/180",
    ),
    "wheels in m/s": (
        lambda t: _bad(t, **{n: t[n] * WHEEL_RADIUS for n in logs.WHEEL_SPEEDS}),
        r"wheel speeds look like m/s",
    ),
    "command in degrees": (
        lambda t: _bad(t, cmd_yaw_rate=np.degrees(t["cmd_yaw_rate"])),
        r"cmd_yaw_rate looks like degrees",
    ),
    "clockwise": (lambda t: _bad(t, y=-t["y"], yaw=-t["yaw"]), r"yaw is clockwise \(NED\): negate y and yaw"),
    "clockwise yaw alone": (lambda t: _bad(t, yaw=-t["yaw"]), r"yaw is clockwise: negate it"),
    "axes swapped": (lambda t: _bad(t, x=t["y"], y=t["x"]), r"x and y are swapped"),
    "yaw to the left": (
        lambda t: _bad(t, yaw=t["yaw"] + np.pi / 2),
        r"yaw is not the angle from x to the robot's front",
    ),
    "wheels swapped": (
        lambda t: _bad(t, left_wheel_vel=t["right_wheel_vel"], right_wheel_vel=t["left_wheel_vel"]),
        r"turns -0\.\d+ times as fast .* left and right wheels are swapped",
    ),
    "wheels backward": (
        lambda t: _bad(t, **{n: -t[n] for n in logs.WHEEL_SPEEDS}),
        r"moves -\d.* m along yaw .* wheel speeds have the wrong sign",
    ),
    "command backward": (lambda t: _bad(t, cmd_v=-t["cmd_v"]), r"cmd_v has the wrong sign"),
    "command clockwise": (lambda t: _bad(t, cmd_yaw_rate=-t["cmd_yaw_rate"]), r"cmd_yaw_rate is clockwise"),
    "missing": (lambda t: {k: v for k, v in t.items() if k != "left_wheel_vel"}, r"no column left_wheel_vel among"),
    "axes": (
        lambda t: _bad(t, acceleration_y=t["acceleration_y"] - 9.81),
        r"acceleration_y is 9\.8 m/s² \(median\); expected at most 3: the IMU's x must point forward",
    ),
    "short": (lambda t: {k: v[:400] for k, v in t.items()}, r"windows of 2 s to fit to .*expected at least 20 and 10"),
    "ns": (
        lambda t: _bad(t, time=1.7e18 + 1e9 * t["time"]),
        r"rows are 5e\+07 s apart .*expected 0\.0005 to 0\.5 s; time looks like ns; divide it by 1e9",
    ),
    "µs": (lambda t: _bad(t, time=1e6 * t["time"]), r"time looks like µs; divide it by 1e6"),
    "ms": (lambda t: _bad(t, time=1e3 * t["time"]), r"rows are 50 s apart .*time looks like ms; divide it by 1e3"),
    "slow": (lambda t: {k: v[::12] for k, v in t.items()}, r"rows are 0\.6 s apart .*record at least 2 rows a second"),
    "hours": (lambda t: _bad(t, time=t["time"] / 3600), r"rows are 1\.39e-05 s apart .*; give time in s$"),
    "rare poses": (
        lambda t: _bad(t, **{n: t[n][np.arange(len(t[n])) // 30 * 30] for n in logs.POSE}),
        r"1 new poses in 2 s of driving .*expected at least 2; record them at 1 Hz or more",
    ),
    "rare poses in step with windows": (
        lambda t: _bad(t, **{n: t[n][np.arange(len(t[n])) // 40 * 40] for n in logs.POSE}),
        r"no new pose for 1\.5 s in \d+ of \d+ windows in which the wheels turn",
    ),
    "no poses": (lambda t: _bad(t, **{n: 0 * t[n] for n in logs.POSE}), r"no new pose for 1\.5 s in "),
    "lengths": (lambda t: _bad(t, x=t["x"][:-1]), r"columns of different lengths"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_logs_are_refused_in_one_line(kind, drive, tmp_path, capsys):
    change, message = BAD[kind]
    path = tmp_path / "log.npz"
    np.savez(path, **change(drive))
    assert commands.main("align", ["husky", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert re.search(message, said), said
    assert not (tmp_path / "out").exists()


def test_a_log_with_too_few_turns_is_refused(tmp_path):
    table = columns(HuskyParams(), 130.0, seed=2, strong=False)
    with pytest.raises(InputError, match=r"0 windows turn left and 0 right .*drive more turns"):
        logs.check_log(logs.cut_windows(table, "log"), "log")


def test_csv_and_npz_are_the_same_log(drive, tmp_path):
    np.savez(tmp_path / "log.npz", **drive)
    one = log_files.read_log(write_csv(tmp_path / "log.CSV", drive))
    other = log_files.read_log(tmp_path / "log.npz")
    assert np.array_equal(one.poses, other.poses)
    assert np.array_equal(one.wheels, other.wheels)
    assert one.follows[1:].all()
    assert len(one) == 74


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no row of numbers"),
        ("time,x\n", "no row of numbers"),
        ("time;x\n0;1\n", "its columns are separated by ';', not by commas"),
        ("time,x,,x,\n0,1,,2,\n", "column x appears 2 times"),
    ],
)
def test_bad_tables_are_refused(text, message, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        log_files.read_log(tmp_path / "log.csv")


def test_nothing_in_an_npz_runs_code(tmp_path):
    np.savez(tmp_path / "log.npz", time=np.array([{"a": 1}], object))
    with pytest.raises(InputError, match="without pickled objects"):
        log_files.read_log(tmp_path / "log.npz")


def test_gaps_are_left_out(drive):
    keep = (drive["time"] < 20.0) | (drive["time"] > 23.0)
    windows = logs.cut_windows({name: column[keep] for name, column in drive.items()}, "log")
    assert len(windows) == 74 - 3
    assert (~windows.follows).sum() == 2  # the first, and the first after the gap


def test_windows_without_poses_are_left_out(drive):
    """If the wheels turn for seconds while the pose stays, the poses were lost; if the robot rests, they were not."""
    held, resting = (drive["time"] > 20.4) & (drive["time"] < 25.9), drive["time"] > 130.0
    table = {name: column.copy() for name, column in drive.items()}
    for name in logs.POSE:
        table[name][held] = table[name][held][0]
        table[name][resting] = table[name][resting][0]
    for name in logs.WHEEL_SPEEDS:
        table[name][resting] = 0.0
    windows = logs.cut_windows(table, "log")
    assert len(windows) == 74 - 3
    assert np.flatnonzero(~windows.follows).tolist() == [0, 10]


def test_windows_in_which_the_robot_stands_are_left_out(drive):
    """A robot parked for long would dominate fits and medians. One that is commanded but stuck is kept."""
    parked = {name: np.concatenate([column, np.repeat(column[-1:], 8000)]) for name, column in drive.items()}
    begins = len(drive["time"])
    parked["time"] = np.arange(len(parked["time"])) * 0.05
    for name in (*logs.TWIST, *logs.WHEEL_SPEEDS):
        parked[name][begins:] = 0.0
    whole = logs.cut_windows(drive, "log")
    windows = logs.cut_windows(parked, "log")
    assert len(windows) in (len(whole), len(whole) + 1)  # the last one may have begun before
    np.testing.assert_array_equal(windows.wheels[: len(whole)], whole.wheels)
    assert windows.follows[: len(whole)].tolist() == whole.follows.tolist()
    parked["cmd_v"][begins:] = 0.5
    assert len(logs.cut_windows(parked, "log")) >= len(whole) + 199


def test_a_clock_set_after_the_first_row_loses_no_window(drive):
    """One row is older than the clock's setting: at most two seconds of the log are lost, and no memory is wasted."""
    late = {name: np.concatenate([column[:1], column]) for name, column in drive.items()}
    late["time"][1:] += 1.7e9
    windows = logs.cut_windows(late, "log")
    whole = logs.cut_windows(drive, "log")
    assert len(windows) == len(whole)
    np.testing.assert_allclose(windows.wheels, whole.wheels, atol=1e-9)
    assert windows.follows.tolist() == whole.follows.tolist()
    assert (windows.fitting.sum() - whole.fitting.sum()) in range(-3, 4)


def test_bag_is_the_same_log(drive, tmp_path):
    pytest.importorskip("rosbags")
    from ros_bag import write_bag

    rows = {name: column[:900] for name, column in drive.items()}
    bag = logs.cut_windows(log_files.read_bag(write_bag(tmp_path / "bag", rows)), "bag")
    table = logs.cut_windows(rows, "log")
    assert len(bag) == len(table)
    for name in ("commands", "wheels", "poses", "acceleration"):
        assert getattr(bag, name) == pytest.approx(getattr(table, name), abs=1e-6), name


def test_a_bag_without_commands_is_refused(drive, tmp_path):
    pytest.importorskip("rosbags")
    from ros_bag import write_bag

    bag = write_bag(tmp_path / "bag", {name: column[:50] for name, column in drive.items()}, without=("commands",))
    with pytest.raises(InputError, match=r"no topic with commands .*record it"):
        log_files.read_bag(bag)


@pytest.mark.realdata
def test_published_windows_are_read(real_data: Path):
    windows = log_files.read_log(real_data / "husky_drive" / "husky_drive_dev.npz")
    assert len(windows) == 402
    assert set(windows.groups % 2) == {0, 1}
    logs.check_log(windows, "log")
    # The IMU's axes after reading: it is pushed forward when wheels speed up, and into the turn.
    motion = kinematics.fit_icr(windows).motion(windows.wheels)
    speeding = np.gradient(motion[..., 0], logs.PERIOD, axis=1).ravel()
    inward = (motion[..., 0] * motion[..., 2]).ravel()
    assert np.corrcoef(speeding, windows.acceleration[..., 0].ravel())[0, 1] > 0.1
    assert np.corrcoef(inward, windows.acceleration[..., 1].ravel())[0, 1] > 0.08
