"""Benchmark of the robot's pilot: pictures per second on one core, and the latency that the pilot adds.

    python benchmarks/deploy.py [--policy RUN] [--json FILE]

Pictures of 1280×720 px arrive as JPEG or BGRA from a camera with distortion; each is decoded, rectified, scaled,
stacked and given to the policy. Latency is the time from a picture's arrival to its command, on one core that no other
program should use meanwhile. Without --policy, the benchmark measures policies with random weights and the sizes of
`twin train`'s presets.
"""

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from record import record_parser, save
from sections import verdict

sys.path.insert(0, str(Path(__file__).parents[1] / "ros2" / "twin_policy"))

from twin.learn.policy import save_policy
from twin.learn.train_config import PRESETS, TrainConfig
from twin_policy import Camera, CompressedPicture, Limits, OnnxPolicy, Pilot, RawPicture

TARGETS = {"pictures_per_s": ("≥", 50.0), "latency_median_ms": ("≤", 15.0)}
_LENS = Camera((1280, 720), (533.1, 533.4, 641.2, 355.8), "plumb_bob", (-0.045, 0.012, 0.0004, -0.0003, -0.005))
_KINDS = ("jpeg", "bgra8")
_STEP = 100_000_000  # [ns] between pictures


def picture() -> np.ndarray:
    """A street-like BGR picture: smooth, with edges and noise, so that its JPEG has a usual size (about 200 kB)."""
    rng = np.random.default_rng(0)
    out = cv2.resize(rng.integers(0, 256, (24, 40, 3), np.uint8), (1280, 720), interpolation=cv2.INTER_CUBIC)
    for _ in range(60):
        (x, y), (w, h) = rng.integers(0, (1280, 720)), rng.integers(10, 200, 2)
        cv2.rectangle(out, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1)
    return (out + rng.normal(0.0, 4.0, out.shape)).clip(0, 255).astype(np.uint8)


def measure(policy: OnnxPolicy, kind: str, count: int) -> dict[str, Any]:
    """Speed and latency of the pilot over `count` pictures of a kind; the first tenth of them does not count."""
    now = 0  # [ns] time on the pilot's two clocks; the latency is measured in real time

    def clock() -> int:
        return now

    pilot = Pilot(policy, Limits(), Camera(policy.size, (66.6, 66.6, 80.0, 45.0)), clock, clock)
    pilot.set_camera(_LENS)
    frame = picture()
    if kind == "jpeg":
        shown: Any = CompressedPicture(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
    else:
        shown = RawPicture("bgra8", 1280, 720, 5120, cv2.cvtColor(frame, cv2.COLOR_BGR2BGRA).tobytes())
    took = []
    for _ in range(count):
        now += _STEP
        begin = time.perf_counter()
        command = pilot.picture(shown, now)
        took.append(time.perf_counter() - begin)
        assert command.drives, command.cause
    assert pilot.counts["used"] == count
    some = np.array(took[count // 10 :]) * 1e3
    return {
        "pictures_per_s": 1e3 / some.mean(),
        "latency_median_ms": float(np.median(some)),
        "latency_p99_ms": float(np.percentile(some, 99)),
        "bytes": len(shown.data),
        "pictures": len(some),
    }


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--policy", type=Path, help="policy folder")
    parser.add_argument("--count", type=int, default=1000, help="number of pictures of each kind")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    record: dict[str, Any] = {}
    print(f"{'figure':36} {'value':>12} {'target':>10}  met")
    with tempfile.TemporaryDirectory() as folder:
        policies = {"given": options.policy} if options.policy else {}
        if not policies:
            for preset, settings in PRESETS.items():
                config = TrainConfig(**{**settings, "device": "cpu"})
                rng, policies[preset] = np.random.default_rng(0), Path(folder) / preset
                shapes = config.architecture.shapes().items()
                weights = {name: rng.normal(0, 0.05, shape).astype(np.float32) for name, shape in shapes}
                save_policy(policies[preset], config.architecture, config.control, weights, {})
        for name, where in policies.items():
            policy = OnnxPolicy(where)
            for kind in _KINDS:
                record[f"{name}.{kind}"] = figures = measure(policy, kind, options.count)
                for figure, value in figures.items():
                    wanted, met = verdict(figure, figures, TARGETS)
                    print(f"{f'{name}.{kind}.{figure}':36} {value:12.4g} {wanted:>10}  {met}")
    return save(options.json, record, options.replace_record)


if __name__ == "__main__":
    sys.exit(main())
