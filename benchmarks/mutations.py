"""Breaks the package in one place at a time and runs the tests that should fail; takes three minutes.

    python benchmarks/mutations.py [--only WORDS]

A mutation changes one line in a copy of the last commit. A mutation is *red* if a test then fails. The exit status is 1
if a mutation is not red, or if its line does not occur exactly once in the file; the list of mutations must then be
updated.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Mutation:
    """A line of a file, and its replacement."""

    name: str
    path: str
    line: str
    broken: str
    tests: tuple[str, ...]
    """Names of test files, tried in order."""


_REAL = ("real_camera", "real_drive")
MUTATIONS = (
    Mutation(
        "a lighting that is left out counts in its own forecast",
        "twin/evaluation/forecasting.py",
        "LinearCorrection.fit(twin=twin_rate[~mine], real=real_rate[~mine])",
        "LinearCorrection.fit(twin=twin_rate, real=real_rate)",
        ("forecast",),
    ),
    Mutation(
        "intervals have a confidence of 0.5",
        "twin/evaluation/agreement_intervals.py",
        "ppf(0.5 + CONFIDENCE / 2, freedom)",
        "ppf(0.5 + 0.5 / 2, freedom)",
        ("agreement_intervals",),
    ),
    Mutation(
        "intervals over places are those of a normal distribution",
        "benchmarks/place_intervals.py",
        "np.asarray(len(places) - 1.0)",
        "np.asarray(1e6)",
        ("agreement_intervals",),
    ),
    Mutation(
        "intervals of differences are those of a normal distribution",
        "benchmarks/place_intervals.py",
        "student.ppf(0.5 + CONFIDENCE / 2, n - 1)",
        "student.ppf(0.5 + CONFIDENCE / 2, 1e6)",
        ("agreement_intervals",),
    ),
    Mutation(
        "more than the largest number of trials is recommended",
        "twin/evaluation/rate_model.py",
        "return high if high <= MAX_TRIALS else None",
        "return high",
        ("ranking",),
    ),
    Mutation(
        "the sun of evaluations may equal the filmed one",
        "twin/env/domain_randomization.py",
        "Ranges(sunlight=(0.35, 0.7), shade=(0.35, 0.75)",
        "Ranges(sunlight=(0.0, 0.7), shade=(0.0, 0.75)",
        ("weather",),
    ),
    Mutation(
        "cast shadows lie on the side of the sun",
        "twin/env/picture_effects.py",
        "flat = points[..., :2] - points",
        "flat = points[..., :2] + points",
        ("weather",),
    ),
    Mutation(
        "held-out lightings may be as near as training's",
        "twin/env/episode_lighting.py",
        "_MARGIN = 1.25",
        "_MARGIN = 1.0",
        ("env_parts",),
    ),
    Mutation(
        "few drives have no correction for their number",
        "twin/sysid/estimation.py",
        "meat * count / max(1, count - 1)",
        "meat",
        ("estimation",),
    ),
    Mutation(
        "the reality has no haze",
        "twin/reality/real_camera.py",
        "light = apply_haze(light, depth, self._rays, pose, lighting, ground)",
        "pass",
        _REAL,
    ),
    Mutation(
        "the real robot does not shake",
        "twin/reality/real_robot.py",
        "spread = np.deg2rad(r.shake)",
        "spread = 0.0",
        ("real_robot", "real_drive"),
    ),
    Mutation(
        "the real exposure does not drift",
        "twin/reality/real_camera.py",
        "light = light * np.float32(np.exp(self._exposure.value))",
        "pass",
        _REAL,
    ),
    Mutation(
        "the real camera is not askew",
        "twin/reality/real_camera.py",
        "nominal @ flip @ turn @ flip",
        "nominal",
        _REAL,
    ),
    Mutation(
        "no sampled day is hazy",
        "twin/reality/lighting.py",
        "hazy, wet = rng.uniform() < 0.4,",
        "hazy, wet = rng.uniform() < 0.0,",
        _REAL,
    ),
)


def is_red(mutation: Mutation, root: Path) -> bool:
    """True if a test fails in the mutated copy; restores the copy afterwards."""
    path = root / mutation.path
    text = path.read_text(encoding="utf-8")
    if text.count(mutation.line) != 1:
        print(f"{mutation.path}: {mutation.line!r} occurs {text.count(mutation.line)} times; expected once")
        return False
    path.write_text(text.replace(mutation.line, mutation.broken), encoding="utf-8")
    files = [f"tests/test_{name}.py" for name in mutation.tests]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-m", "not slow", *files]
    start = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    path.write_text(text, encoding="utf-8")
    red = done.returncode == 1  # other statuses mean that no test ran
    seen = next((line for line in done.stdout.splitlines() if line.startswith("FAILED")), done.stdout[-500:])
    print(
        f"{'red' if red else 'NOT SEEN'}, {time.perf_counter() - start:.0f} s: {mutation.name}\n    {seen}", flush=True
    )
    return red


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORDS", help="run mutations whose names contain WORDS")
    options = parser.parse_args()
    chosen = [one for one in MUTATIONS if options.only in one.name]
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=_ROOT, check=True, stdout=subprocess.PIPE)
        subprocess.run(["tar", "x", "-C", folder], input=archive.stdout, check=True)
        red = [is_red(one, Path(folder)) for one in chosen]
    print(f"{sum(red)} of {len(red)} mutations are red")
    return 0 if red and all(red) else 1


if __name__ == "__main__":
    sys.exit(main())
