"""Robustness: killed processes and full disks must lose no results, and environments must not leak memory.

    python benchmarks/robustness.py endurance [--steps 1000000]       # control steps of eight environments together
    python benchmarks/robustness.py kills [--times 50] [--only build|train|validate]
    python benchmarks/robustness.py disk                              # needs permission to mount a tmpfs

Each test prints a table and, with --json FILE, writes it. The exit status is 1 if the test fails. All tests use tiny
generated scenes in a temporary folder.
"""

import contextlib
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from record import record_parser, save
from sameness import QUICK

from twin.files import digest_file

_ROOT = Path(__file__).resolve().parents[1]
_ENVS = 8
_GROWTH = 32 << 20  # [bytes] allowed memory growth of eight environments


# ---- endurance


def endurance(steps: int, folder: Path) -> dict[str, Any]:
    """Drives eight small environments at random, with every randomization switched on.

    Args:
        steps: Control steps of all environments together.
    """
    import psutil
    import tqdm
    from tiny_twin import tiny_twin

    from twin.config import TRAINING
    from twin.env.env_factory import EnvFactory
    from twin.env.picture_effects import CameraOptions
    from twin.env.vector_env_local import LocalVectorEnv

    camera = CameraOptions(vibration=0.3, exposure=0.1, shutter=0.02, blur_samples=2)
    options = {"lighting": TRAINING, "lighting_drift": True, "obstacles": 2, "randomise": True, "camera": camera}
    scene = tiny_twin(folder / "endurance")
    envs = LocalVectorEnv(
        EnvFactory.open(scene, "bend", {**options, "size": (32, 18), "start_along": 0.5}), list(range(_ENVS))
    )
    envs.begin(range(_ENVS))
    rng, process = np.random.default_rng(0), psutil.Process()
    rounds, sizes, episodes, bad, start = steps // _ENVS, [], 0, 0, time.perf_counter()
    for k in tqdm.trange(rounds, desc="endurance", mininterval=60.0):
        actions = np.stack([rng.uniform(0, 1, _ENVS), rng.uniform(-0.4, 0.4, _ENVS)], 1)  # mostly forward
        out = envs.step(actions)
        states = [p.data.qpos for p in envs.physics] + [p.data.qvel for p in envs.physics]
        bad += not np.isfinite(out.reward).all() or not all(np.isfinite(one).all() for one in states)
        if over := np.flatnonzero(out.over).tolist():
            episodes += len(over)
            envs.begin(over)
        if (k + 1) % max(1, rounds // 50) == 0:
            gc.collect()
            sizes.append(process.memory_info().rss)
            unsound = f"{bad} rounds (one step of all environments) with a reward or state that is not finite"
            tqdm.tqdm.write(f"{(k + 1) * _ENVS} steps, {sizes[-1] / 2**20:.1f} MiB, {unsound}")
    # After a fifth of the run, each kind of obstacle has been rendered, which allocates memory the first time.
    settled = sizes[len(sizes) // 5]
    return {
        "steps": rounds * _ENVS,
        "episodes": episodes,
        "rounds_not_finite": bad,
        "growth_mib": round((max(sizes[-5:]) - settled) / 2**20, 1),
        "steps_per_s": round(rounds * _ENVS / (time.perf_counter() - start), 1),
        "ok": bad == 0 and max(sizes[-5:]) - settled <= _GROWTH,
    }


# ---- kill -9


def kills(times: int, folder: Path, only: str | None = None) -> dict[str, Any]:
    """Kills builds, trainings and validations at random times, resumes them, and compares them with undisturbed ones.

    Args:
        times: Number of kills of each command.
        only: "build", "train" or "validate" kills only this command; None kills all three.
    """
    each = {"build": _killed_builds, "train": _killed_trainings, "validate": _killed_validations}
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {name: run(times, folder, rng) for name, run in each.items() if only in (None, name)}
    return out | {"ok": all(one["ok"] for one in out.values())}


def _killed_after(command: list[str], seconds: float) -> bool:
    """Kills a command after `seconds`; False if it had ended before. Asserts that its children die with it."""
    import psutil

    with tempfile.TemporaryFile() as stderr:
        process = subprocess.Popen(command, cwd=_ROOT, stdout=subprocess.DEVNULL, stderr=stderr)
        children: dict[int, psutil.Process] = {}
        until = time.monotonic() + seconds
        while process.poll() is None and time.monotonic() < until:
            with contextlib.suppress(psutil.Error):
                children |= {one.pid: one for one in psutil.Process(process.pid).children(recursive=True)}
            time.sleep(0.02)
        if process.poll() is not None:
            stderr.seek(0)
            assert process.returncode == 0, stderr.read().decode()[-3000:]
            return False
        with contextlib.suppress(psutil.Error):
            children |= {one.pid: one for one in psutil.Process(process.pid).children(recursive=True)}
        process.send_signal(signal.SIGKILL)
        process.wait()
    # A worker that has just started notices its parent's death only after its imports, which take seconds.
    left = psutil.wait_procs(list(children.values()), timeout=30.0)[1]
    assert not left, f"alive after kill -9: {left}"
    return True


def _leftovers(root: Path) -> list[str]:
    """Temporary files, which a finished command must have removed."""
    names = [path for path in root.rglob("*") if ".partial" in path.name or path.name.endswith((".lock", ".old"))]
    return [str(path.relative_to(root)) for path in names]


def _build_command(root: Path, *more: str) -> list[str]:
    settings = [word for one in QUICK for word in ("--set", one)]
    return [sys.executable, "-m", "twin.build", str(root), "--quiet", *settings, *more]


def _filmed(folder: Path) -> Path:
    """A generated scene with two short films."""
    root = folder / "filmed"
    if not root.exists():
        subprocess.run(
            [sys.executable, "-m", "twin.reality", "film", "--tiny", "--out", str(root)], cwd=_ROOT, check=True
        )
        shutil.rmtree(root / "truth")  # comparison with the truth takes longer than the build
    return root


def _results(root: Path, stages: tuple[str, ...]) -> dict[str, str]:
    from twin.scene import SceneDir

    return {name: json.loads((SceneDir(root).stage(name) / "stamp.json").read_text())["result"] for name in stages}


def _killed_builds(times: int, folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    from twin.scene import STAGE_FOLDERS, SceneDir

    root = _filmed(folder)
    scene = SceneDir(root)
    stages = ("capture", "cameras", "metric", "field", "mesh", "mjcf")  # not the review, whose results contain timings
    subprocess.run(_build_command(root), cwd=_ROOT, check=True)
    report = json.loads((root / "build" / "report.json").read_text())
    wanted, longest = _results(root, stages), max(stage["seconds"] for stage in report["stages"].values())
    killed = finished = different = 0
    sfm_until = times // 5  # the first fifth of the kills hits builds from scratch
    while killed < times:
        from_start = killed < sfm_until
        for name in list(STAGE_FOLDERS)[0 if from_start else 3 :]:
            shutil.rmtree(scene.stage(name), ignore_errors=True)
        while killed < times and _killed_after(_build_command(root), float(rng.uniform(2.0, 8.0 + 1.3 * longest))):
            killed += 1
        assert _killed_after(_build_command(root), 3600.0) is False
        finished += 1
        now = _results(root, stages)
        if from_start:  # structure from motion is not repeatable, so later builds are compared with this one
            wanted = now
        different += now != wanted
    return _comparison(root, killed, finished, different)


def _comparison(root: Path, killed: int, finished: int, different: int) -> dict[str, Any]:
    left = _leftovers(root)
    counts = {"killed": killed, "finished": finished, "different": different}
    return {**counts, "leftovers": left, "ok": not different and not left}


_TRAIN = """
import sys
from pathlib import Path
import twin
from twin.learn.train_config import TrainConfig
from twin.learn.training import train
small = TrainConfig(task="ahead", lighting="day", steps=int(sys.argv[3]), worlds=4, starts=40, batch=16, buffer=400,
    convolutions=((8, 8, 8),), features=16, hidden=(16,), save_every=80, checkpoints=6, updates=0.25, teacher_steps=80)
train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), small)
"""


def _killed_trainings(times: int, folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    """Kills trainings. A killed training resumes from its last save, so the kills hit all parts of a training."""
    from tiny_twin import tiny_twin

    root = folder / "trained"
    if not root.exists():
        tiny_twin(root)
    steps, runs = 1600, []
    for name in ("whole", "killed"):
        command = [sys.executable, "-c", _TRAIN, str(root), str(root / "runs" / name), str(steps)]
        killed = longest = 0
        while name == "killed" and killed < times:
            begun = time.monotonic()
            if _killed_after(command, float(rng.uniform(1.0, 16.0))):
                killed += 1
                longest = max(longest, _saved(root / "runs" / name))
            else:  # it finished first: start a new one
                runs.append(_is_complete(root / "runs" / name, steps))
                shutil.rmtree(root / "runs" / name)
            assert time.monotonic() - begun < 600
        assert _killed_after(command, 3600.0) is False
        runs.append(_is_complete(root / "runs" / name, steps))
    rates = [np.mean([row["success"] for row in _rows(root / "runs" / name)]) for name in ("whole", "killed")]
    leftovers = _leftovers(root)
    complete = all(runs)
    noise = 3.0 * np.sqrt(0.25 / max(1, min(len(_rows(root / "runs" / name)) for name in ("whole", "killed"))))
    return {
        "killed": killed,
        "finished": len(runs),
        "complete": complete,
        "success": [round(float(rate), 3) for rate in rates],
        "leftovers": leftovers,
        "ok": bool(complete and not leftovers and abs(rates[0] - rates[1]) <= noise),
    }


def _saved(run: Path) -> int:
    state = run / "state" / "state.json"
    return json.loads(state.read_text())["steps"] if state.exists() else 0


def _rows(run: Path) -> list[dict[str, Any]]:
    import csv

    with (run / "episodes.csv").open(newline="", encoding="utf-8") as file:
        return [row | {"success": int(row["success"])} for row in csv.DictReader(file)]


def _is_complete(run: Path, steps: int) -> bool:
    """True if a finished training is complete: all steps, tables without gaps or repetitions, all pictures."""
    head = json.loads((run / "state" / "state.json").read_text())
    rows = _rows(run)
    at = [int(row["step"]) for row in rows]
    seeds = [row["seed"] for row in rows]
    with np.load(run / "state" / head["folder"] / "buffer.npz", allow_pickle=False) as data:
        ages = data["ages"]
    written = head["buffer"]["written"]
    filled = written * len(ages) > head["steps"]  # each resumption adds the first picture of an episode
    images = np.fromfile(run / "state" / "pictures.bin", np.uint8).reshape(*ages.shape, 3 * 45 * 80)
    # Every picture that may be sampled has been written: none is entirely black.
    newest = np.arange(max(0, written - 100), written) % ages.shape[1]
    tables = head["steps"] == steps and at == sorted(at) and len(set(seeds)) == len(seeds)
    return bool(tables and filled and images[:, newest].any(-1).all() and (ages >= 0).all())


def _killed_validations(times: int, folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    from tiny_runs import tiny_runs
    from tiny_twin import tiny_twin

    root = folder / "validated"
    if not root.exists():
        tiny_twin(root)
        tiny_runs(root)
    command = [sys.executable, "-m", "twin.validate", str(root), "--policy", "ahead", "left", "--task", "ahead"]
    command += ["--lightings", "day", "night+randomised", "--episodes", "60", "--processes", "2", "--quiet"]
    assert _killed_after(command, 3600.0) is False
    files = ("episodes.csv", "cells.csv", "summary.json")
    digests = {name: digest_file(root / "validation" / name) for name in files}
    killed = finished = different = 0
    while killed < times:
        shutil.rmtree(root / "validation")
        while killed < times and _killed_after(command, float(rng.uniform(2.0, 14.0))):
            killed += 1
        assert _killed_after(command, 3600.0) is False
        finished += 1
        different += digests != {name: digest_file(root / "validation" / name) for name in files}
    return _comparison(root, killed, finished, different)


# ---- full disk


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """Mounts a tmpfs of `size` bytes. Raises OSError: mounting is not permitted."""
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], capture_output=True)
    if done.returncode:
        raise OSError(done.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(disk: Path, leave: int) -> Path:
    """Writes a file that leaves `leave` bytes of a disk free."""
    path = disk / "filling"
    facts = os.statvfs(disk)
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(4096, facts.f_bavail * facts.f_frsize - leave))
    return path


def full_disk_fault(command: list[str], root: Path) -> str:
    """Runs a command that must fail with one line and exit status 2, keeping all files; returns a fault, or ""."""
    before = _contents(root)
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("Warp CUDA warning")]
    if done.returncode != 2 or len(lines) != 1 or "space" not in lines[0]:
        return f"exit status {done.returncode}, {len(lines)} lines: {done.stderr[-1500:]}"
    after = _contents(root)
    lost = [name for name, digest in before.items() if after.get(name) != digest]
    leftovers = [name for name in _leftovers(root) if name not in before]
    return f"lost {lost}, left {leftovers}" if lost or leftovers else ""


def _contents(root: Path) -> dict[str, str]:
    skipped = ("/runs/", "/validation/", "/tensorboard/")  # tables there grow, and their last row may be cut
    files = [path for path in root.rglob("*") if path.is_file() and not any(s in f"/{path}" for s in skipped)]
    return {str(path.relative_to(root)): digest_file(path) for path in files}


def disk(folder: Path) -> dict[str, Any]:
    """Runs every stage of a build, a training, a validation, an export and a film on a full disk."""
    out = full_build(folder) | full_verbs(folder)
    return out | {"ok": all(result == "ok" for result in out.values())}


def full_build(folder: Path) -> dict[str, str]:
    """Runs every stage of a build with no free space and with 64 KiB, then an export of the build.

    Returns "ok" or the fault of each run, by name.
    """
    from twin.scene import STAGE_FOLDERS, SceneDir

    out: dict[str, str] = {}
    source = _filmed(folder)
    subprocess.run(_build_command(source), cwd=_ROOT, check=True)
    with small_disk(folder / "disk", 600 << 20) as mounted:
        root = mounted / "filmed"
        shutil.copytree(source, root)
        expected = _results(root, ("capture",))
        for name in reversed(STAGE_FOLDERS):
            shutil.rmtree(SceneDir(root).stage(name))
            for leave in (0, 64 << 10):
                out[f"build, {name}, {leave >> 10} KiB left"] = _fault_or_ok(mounted, leave, _build_command(root), root)
        done = subprocess.run(_build_command(root), cwd=_ROOT, capture_output=True, text=True)
        same = done.returncode == 0 and _results(root, ("capture",)) == expected
        out["build, afterwards"] = "ok" if same else done.stderr[-1500:]
        export = _verb(root, "export", "--ply", str(root / "road.ply"), "--glb", str(root / "road.glb"))
        out["export, 8 KiB left"] = _fault_or_ok(mounted, 8 << 10, export, root)
    return out


def full_verbs(folder: Path) -> dict[str, str]:
    """Runs a training, a validation and a film with no free space, with little, and with enough.

    Returns "ok" or the fault of each run, by name.
    """
    from tiny_runs import tiny_runs
    from tiny_twin import tiny_twin

    out: dict[str, str] = {}
    with small_disk(folder / "disk", 600 << 20) as mounted:
        root = tiny_twin(mounted / "driven")
        tiny_runs(root)
        verbs: dict[str, list[str]] = {
            "train": [sys.executable, "-c", _VERB_TRAIN, str(root), "new", "400"],
            "validate": _verb(root, "validate", "--policy", "ahead", "--task", "ahead", "--episodes", "8"),
            "film": _verb(root, "film", "--policy", "ahead", "--task", "ahead", "--lighting", "day"),
        }
        for name, command in verbs.items():
            for leave in (0, 8 << 10, 5 << 20) if name == "train" else (0, 8 << 10):
                out[f"{name}, {leave >> 10} KiB left"] = _fault_or_ok(mounted, leave, command, root)
            done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
            out[f"{name}, afterwards"] = "ok" if done.returncode == 0 else done.stderr[-1500:]
    return out


def _fault_or_ok(mounted: Path, leave: int, command: list[str], root: Path) -> str:
    filling = fill(mounted, leave)
    try:
        return full_disk_fault(command, root) or "ok"
    finally:
        filling.unlink()


_VERB_TRAIN = _TRAIN.replace(
    "train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), small)",
    """
from twin import command_line, runtime
def work(options):
    runtime.set_quiet(True)
    train(twin.load_scene(sys.argv[1]), Path(sys.argv[1]) / "runs" / sys.argv[2], small)
sys.exit(command_line.run(command_line.Parser(), work, []))
""",
)


def _verb(root: Path, name: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", f"twin.{name}", str(root), *arguments, "--quiet"]


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("test", choices=("endurance", "kills", "disk"))
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps of endurance (default %(default)s)")
    parser.add_argument("--times", type=int, default=50, help="kills of each command (default %(default)s)")
    parser.add_argument("--only", choices=("build", "train", "validate"), help="kill only this command")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tests: dict[str, Callable[[], dict[str, Any]]] = {
            "endurance": lambda: endurance(options.steps, folder),
            "kills": lambda: kills(options.times, folder, options.only),
            "disk": lambda: disk(folder),
        }
        out = tests[options.test]()
    for key, value in out.items():
        print(f"{key:40} {value}")
    return save(options.json, out, options.replace_record) or int(not out["ok"])


if __name__ == "__main__":
    sys.exit(main())
