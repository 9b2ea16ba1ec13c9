"""Measurement times of poses, estimated from their times of appearance in logs of a simulated sensor."""

import numpy as np
import pytest
from drive_logs import windows_of

from twin.sysid import logs


def held(appeared: list[list[float]]) -> logs.Windows:
    """Windows whose pose moves by 1 m at these samples and stays in between."""
    poses = np.zeros((len(appeared), logs.SAMPLES + 1, 3))
    for window, samples in zip(poses, appeared, strict=True):
        for sample in samples:
            window[sample:, 0] += 1.0
    return windows_of(np.zeros((len(appeared), logs.SAMPLES, 2)), poses)


def test_poses_have_the_period_of_their_sensor():
    """At 10 Hz, every second sample has a pose. Times are in samples from the window's start; negative: before it."""
    regular, old = list(range(2, 41, 2)), list(range(1, 41, 2))
    late = [2, 4, 6, 11, 12, 13, *range(14, 41, 2)]  # two came late, none was lost
    lost = [2, 4, 6, 12, *range(14, 41, 2)]
    early = [*range(1, 38, 2), 38, 40]  # 21 of them: on the edge between two samples
    resting = list(range(11, 41, 2))  # at first: it was last measured less than a period before
    measured = held([regular, old, late, lost, early, resting, []]).measurement_times / logs.PERIOD
    np.testing.assert_allclose(measured[0], np.arange(41) // 2 * 2, atol=1e-9)
    np.testing.assert_allclose(measured[1], (np.arange(41) + 1) // 2 * 2 - 1, atol=1e-9)
    np.testing.assert_allclose(measured[2, [0, 6, 10, 11, 12, 13, 40]], [0, 6, 6, 8, 10, 12, 40], atol=1e-9)
    np.testing.assert_allclose(measured[3, [0, 6, 11, 12, 14, 40]], [0, 6, 6, 12, 14, 40], atol=1e-9)
    assert measured[4, -1] - measured[4, 0] == pytest.approx(42)
    np.testing.assert_allclose(measured[5, [0, 10, 11, 39]], [-1, -1, 11, 39], atol=1e-9)
    assert np.all(measured[6] == measured[6, 0])


def delivered(period: float) -> tuple[list[list[int]], np.ndarray, np.ndarray]:
    """Samples at which measurements appear in 200 windows, and the time from each window's first to its last one: true,
    and by appearance. Each appears within a sample, one in twenty much later, one in a hundred never."""
    rng = np.random.default_rng(0)
    appeared, truth, came = [], [], []
    for _ in range(200):
        made = rng.uniform(-3 * period, -2 * period) - 1.0 + period * np.arange(70)
        late = rng.uniform(0.0, 0.9, 70) + np.where(rng.random(70) < 0.05, rng.uniform(0.0, 2.5, 70), 0.0)
        at = np.ceil(np.maximum.accumulate(made + late))
        at[rng.random(70) < 0.01] = np.inf
        newest = [int(np.flatnonzero(at <= sample)[-1]) for sample in range(logs.SAMPLES + 1)]
        appeared.append((np.flatnonzero(np.diff(newest)) + 1).tolist())
        truth.append(made[newest[-1]] - made[newest[0]])
        came.append(at[newest[-1]] - at[newest[0]])
    return appeared, np.array(truth), np.array(came)


@pytest.mark.parametrize("period", [2.0, 8 / 3, 4.0, 10.0, 20.0])
def test_measurement_times_from_times_of_appearance(period):
    appeared, truth, came = delivered(period)
    off = np.abs(held(appeared).elapsed[:, -1] / logs.PERIOD - truth)
    naive = np.abs(came - truth)
    assert np.mean(off < 0.15) > max(0.8, np.mean(naive < 0.15) + 0.05)
    assert off.mean() < naive.mean()


def test_aperiodic_sensors_use_times_of_appearance():
    """A sensor that measures every 0.2 m, at several speeds; and a 10 Hz sensor with one window at 20 Hz."""
    by_distance = [list(range(each // 2, 41, each)) for each in (4, 5, 8, 8, 8, 10, 20)]
    steady = [list(range(2, 41, 2))] * 10 + [list(range(1, 41))]
    for appeared in (by_distance, steady):
        measured = held(appeared).measurement_times / logs.PERIOD
        for window, each in zip(measured, appeared, strict=True):
            assert window[[each[0], each[-1], 40]] == pytest.approx([each[0], each[-1], each[-1]], abs=1e-9)
            assert window[0] == pytest.approx(min(0, 2 * each[0] - each[1]), abs=1e-9)


def test_fast_sensors_use_times_of_appearance():
    appeared, truth, _ = delivered(1.0)
    windows = held(appeared)
    assert windows.measurement_times[:, -1] / logs.PERIOD == pytest.approx([each[-1] for each in appeared])
    assert np.abs(windows.elapsed[:, -1] / logs.PERIOD - truth).mean() < 0.5
