"""Whether anything is lost when processes are killed or the disk is full, and whether environments last.

    python benchmarks/robustness.py endurance [--steps 1000000]       # control steps of eight worlds together
    python benchmarks/robustness.py kills [--times 50] [--only build|train|validate]
    python benchmarks/robustness.py disk                              # needs the right to mount a tmpfs

Each prints a table and, with --json FILE, writes it; the exit status is 1 where something was lost. Everything happens
in tiny scenes made up for it, in a temporary folder.
"""

import argparse
import contextlib
import gc
import hashlib
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

_ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(_ROOT), str(_ROOT / "tests")]

_WORLDS = 8
_GROWTH = 32 << 20  # [bytes] that eight worlds may grow by
_QUICK = {
    "nerf.steps": 80,
    "nerf.rays": 1024,
    "nerf.max_width": 160,
    "nerf.bake_steps": 20,
    "nerf.max_bricks": 1200,
    "mesh.voxel": 0.2,
    "review.fps": 3,
    "review.width": 160,
}
"""Settings of a whole build in a minute or two."""


# ---- endurance


def endurance(steps: int, folder: Path) -> dict[str, Any]:
    """Drives eight tiny worlds at random, with everything drawn that can be.

    Args:
        steps: Control steps of all worlds together.
        folder: For the scene.
    """
    import psutil
    import tqdm
    from tiny_twin import tiny_twin

    from twin.config import TRAINING
    from twin.env.camera_noise import CameraOptions
    from twin.env.suite import EnvFactory
    from twin.env.vector_env_local import LocalVectorEnv

    camera = CameraOptions(vibration=0.3, exposure=0.1, shutter=0.02, blur_samples=2)
    options = {"lighting": TRAINING, "lighting_drift": True, "obstacles": 2, "randomise": True, "camera": camera}
    scene = tiny_twin(folder / "endurance")
    worlds = LocalVectorEnv(
        EnvFactory.open(scene, "bend", {**options, "size": (32, 18), "start_along": 0.5}), list(range(_WORLDS))
    )
    worlds.begin(range(_WORLDS))
    rng, process = np.random.default_rng(0), psutil.Process()
    rounds, sizes, episodes, bad, start = steps // _WORLDS, [], 0, 0, time.perf_counter()
    for k in tqdm.trange(rounds, desc="endurance", mininterval=60.0):
        actions = np.stack([rng.uniform(0, 1, _WORLDS), rng.uniform(-0.4, 0.4, _WORLDS)], 1)  # mostly forward
        out = worlds.step(actions)
        states = [p.data.qpos for p in worlds.physics] + [p.data.qvel for p in worlds.physics]
        bad += not np.isfinite(out.reward).all() or not all(np.isfinite(one).all() for one in states)
        if over := np.flatnonzero(out.over).tolist():
            episodes += len(over)
            worlds.begin(over)
        if (k + 1) % max(1, rounds // 50) == 0:
            gc.collect()
            sizes.append(process.memory_info().rss)
            tqdm.tqdm.write(f"{(k + 1) * _WORLDS} steps, {sizes[-1] / 2**20:.1f} MiB, {bad} rounds not finite")
    settled = sizes[len(sizes) // 5]  # by then every kind of thing has been in view once
    return {
        "steps": rounds * _WORLDS,
        "episodes": episodes,
        "rounds_not_finite": bad,
        "growth_mib": round((max(sizes[-5:]) - settled) / 2**20, 1),
        "steps_per_s": round(rounds * _WORLDS / (time.perf_counter() - start), 1),
        "ok": bad == 0 and max(sizes[-5:]) - settled <= _GROWTH,
    }


# ---- kill -9


def kills(times: int, folder: Path, only: str | None = None, seed: int = 0) -> dict[str, Any]:
    """Kills a build, a training and a validation at random moments and lets them go on; compares with one that was not.

    Args:
        times: How often each is killed.
        folder: For the scenes.
        only: One of them.
        seed: Of the moments.
    """
    each = {"build": _killed_builds, "train": _killed_trainings, "validate": _killed_validations}
    rng = np.random.default_rng(seed)
    out: dict[str, Any] = {name: run(times, folder, rng) for name, run in each.items() if only in (None, name)}
    return out | {"ok": all(one["ok"] for one in out.values())}


def _killed_after(command: list[str], seconds: float) -> bool:
    """Whether a command was killed; False where it had ended before. Nothing that it started may live on."""
    import psutil

    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, cwd=_ROOT, stdout=subprocess.DEVNULL, stderr=said)
        children: dict[int, psutil.Process] = {}
        until = time.monotonic() + seconds
        while process.poll() is None and time.monotonic() < until:
            with contextlib.suppress(psutil.Error):
                children |= {one.pid: one for one in psutil.Process(process.pid).children(recursive=True)}
            time.sleep(0.02)
        if process.poll() is not None:
            said.seek(0)
            assert process.returncode == 0, said.read().decode()[-3000:]
            return False
        with contextlib.suppress(psutil.Error):
            children |= {one.pid: one for one in psutil.Process(process.pid).children(recursive=True)}
        process.send_signal(signal.SIGKILL)
        process.wait()
    # A worker that was just started ends when it has loaded what it runs, which takes seconds.
    left = psutil.wait_procs(list(children.values()), timeout=30.0)[1]
    assert not left, f"alive after kill -9: {left}"
    return True


def _rubbish(root: Path) -> list[str]:
    """What a finished verb must not leave."""
    names = [path for path in root.rglob("*") if ".partial" in path.name or path.name.endswith((".lock", ".old"))]
    return [str(path.relative_to(root)) for path in names]


def _build_command(root: Path, *more: str) -> list[str]:
    settings = [word for name, value in _QUICK.items() for word in ("--set", f"{name}={value}")]
    return [sys.executable, "-m", "twin.build", str(root), "--quiet", *settings, *more]


def _filmed(folder: Path) -> Path:
    """A scene with two short films."""
    root = folder / "filmed"
    if not root.exists():
        subprocess.run(
            [sys.executable, "-m", "twin.reality", "film", "--tiny", "--out", str(root)], cwd=_ROOT, check=True
        )
        shutil.rmtree(root / "truth")  # reports of the truth take longer than the build
    return root


def _results(root: Path, stages: tuple[str, ...]) -> dict[str, str]:
    from twin.scene import SceneDir

    return {name: json.loads((SceneDir(root).stage(name) / "stamp.json").read_text())["result"] for name in stages}


def _killed_builds(times: int, folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    from twin.scene import STAGES, SceneDir

    root = _filmed(folder)
    scene = SceneDir(root)
    stages = ("capture", "cameras", "metric", "field", "mesh", "mjcf")  # films of the review know the time they took
    subprocess.run(_build_command(root), cwd=_ROOT, check=True)
    wanted, longest = _results(root, stages), max(_seconds(root).values())
    killed = finished = different = 0
    sfm_until = times // 5  # a fifth of the kills from the very beginning on, where what follows may differ
    while killed < times:
        from_start = killed < sfm_until
        for name in list(STAGES)[0 if from_start else 3 :]:
            shutil.rmtree(scene.stage(name), ignore_errors=True)
        while killed < times and _killed_after(_build_command(root), float(rng.uniform(2.0, 8.0 + 1.3 * longest))):
            killed += 1
        assert _killed_after(_build_command(root), 3600.0) is False
        finished += 1
        now = _results(root, stages)
        if from_start:  # structure from motion may come out otherwise: what follows is compared with a build from it
            wanted = now
        different += now != wanted
    rubbish = _rubbish(root)
    return {
        "killed": killed,
        "finished": finished,
        "different": different,
        "rubbish": rubbish,
        "ok": not different and not rubbish,
    }


def _seconds(root: Path) -> dict[str, float]:
    report = json.loads((root / "build" / "report.json").read_text())
    return {name: stage["seconds"] for name, stage in report["stages"].items()}


_TRAIN = """
import sys
from pathlib import Path
import twin
from twin.learn.train_config import TrainConfig
from twin.learn.training import train
small = TrainConfig(task="ahead", lighting="day", steps=int(sys.argv[3]), worlds=4, starts=40, batch=16, buffer=400,
    convolutions=((8, 8, 8),), features=16, hidden=(16,), save_every=80, checkpoints=6, updates=0.25)
train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), small)
"""


def _killed_trainings(times: int, folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    """A killed training loses what came after its last save, so its kills come further and further into it."""
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
            else:  # it came to its end before: begin anew
                runs.append(_trained(root / "runs" / name, steps))
                shutil.rmtree(root / "runs" / name)
            assert time.monotonic() - begun < 600
        assert _killed_after(command, 3600.0) is False
        runs.append(_trained(root / "runs" / name, steps))
    rates = [np.mean([row["success"] for row in _rows(root / "runs" / name)]) for name in ("whole", "killed")]
    rubbish = _rubbish(root)
    good = all(run["whole"] for run in runs)
    noise = 3.0 * np.sqrt(0.25 / max(1, min(len(_rows(root / "runs" / name)) for name in ("whole", "killed"))))
    return {
        "killed": killed,
        "finished": len(runs),
        "whole": good,
        "success": [round(float(rate), 3) for rate in rates],
        "rubbish": rubbish,
        "ok": bool(good and not rubbish and abs(rates[0] - rates[1]) <= noise),
    }


def _saved(run: Path) -> int:
    state = run / "state" / "state.json"
    return json.loads(state.read_text())["steps"] if state.exists() else 0


def _rows(run: Path) -> list[dict[str, Any]]:
    import csv

    with (run / "episodes.csv").open(newline="", encoding="utf-8") as file:
        return [row | {"success": int(row["success"])} for row in csv.DictReader(file)]


def _trained(run: Path, steps: int) -> dict[str, Any]:
    """Whether a finished training has all its steps, tables without gap or repetition, and a whole replay buffer."""
    head = json.loads((run / "state" / "state.json").read_text())
    rows = _rows(run)
    at = [int(row["step"]) for row in rows]
    seeds = [row["seed"] for row in rows]
    with np.load(run / "state" / head["folder"] / "replay.npz", allow_pickle=False) as data:
        written, newest, age = data["written"], data["newest"], data["age"]
    filled = head["replay"]["full"] or head["replay"]["pos"] * written.size == head["steps"]
    tape = np.fromfile(run / "state" / "pictures.bin", np.uint8)
    pictures = tape.reshape(len(written), -1, 3 * 45 * 80)
    # Every picture that a transition refers to has been written: none is black throughout.
    shown = [pictures[i, newest[:, i] % pictures.shape[1]].any(-1).all() for i in range(len(written))]
    whole = head["steps"] == steps and at == sorted(at) and len(set(seeds)) == len(seeds) and filled and all(shown)
    return {"whole": bool(whole and (age >= 0).all() and (newest < written).all())}


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
    digests = {name: _digest(root / "validation" / name) for name in files}
    killed = finished = different = 0
    while killed < times:
        shutil.rmtree(root / "validation")
        while killed < times and _killed_after(command, float(rng.uniform(2.0, 14.0))):
            killed += 1
        assert _killed_after(command, 3600.0) is False
        finished += 1
        different += digests != {name: _digest(root / "validation" / name) for name in files}
    rubbish = _rubbish(root)
    return {
        "killed": killed,
        "finished": finished,
        "different": different,
        "rubbish": rubbish,
        "ok": not different and not rubbish,
    }


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# ---- full disk


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """A file system of a size [bytes]. Raises OSError where this machine lets nobody mount one."""
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], capture_output=True)
    if done.returncode:
        raise OSError(done.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(disk: Path, leave: int) -> Path:
    """A file that leaves so many bytes of a disk free."""
    path = disk / "filling"
    facts = os.statvfs(disk)
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(4096, facts.f_bavail * facts.f_frsize - leave))
    return path


def refused(command: list[str], root: Path) -> str:
    """What is wrong with how a command ends on a full disk; empty: one line, status 2, and what was there is whole."""
    before = _contents(root)
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("Warp CUDA warning")]
    if done.returncode != 2 or len(lines) != 1 or "space" not in lines[0]:
        return f"exit status {done.returncode}, {len(lines)} lines: {done.stderr[-1500:]}"
    after = _contents(root)
    lost = [name for name, digest in before.items() if after.get(name) != digest]
    rubbish = [name for name in _rubbish(root) if name not in before]
    return f"lost {lost}, left {rubbish}" if lost or rubbish else ""


def _contents(root: Path) -> dict[str, str]:
    skipped = ("/runs/", "/validation/", "/tensorboard/")  # tables there grow, and a row may be cut; see `_mended`
    files = [path for path in root.rglob("*") if path.is_file() and not any(s in f"/{path}" for s in skipped)]
    return {str(path.relative_to(root)): _digest(path) for path in files}


def disk(folder: Path) -> dict[str, Any]:
    """Runs every stage of a build, a training, a validation, an export and a film on a disk that gets full."""
    out = full_build(folder) | full_verbs(folder)
    return out | {"ok": all(said == "ok" for said in out.values())}


def full_build(folder: Path) -> dict[str, str]:
    """Every stage of a build, with no space and with a little; then an export of what was built."""
    from twin.scene import STAGES, SceneDir

    out: dict[str, str] = {}
    source = _filmed(folder)
    subprocess.run(_build_command(source), cwd=_ROOT, check=True)
    with small_disk(folder / "disk", 600 << 20) as mounted:
        root = mounted / "filmed"
        shutil.copytree(source, root)
        whole = _results(root, ("capture",))
        for name in reversed(STAGES):
            shutil.rmtree(SceneDir(root).stage(name))
            for leave in (0, 64 << 10):
                out[f"build, {name}, {leave >> 10} KiB left"] = _on_full(mounted, leave, _build_command(root), root)
        done = subprocess.run(_build_command(root), cwd=_ROOT, capture_output=True, text=True)
        same = done.returncode == 0 and _results(root, ("capture",)) == whole
        out["build, afterwards"] = "ok" if same else done.stderr[-1500:]
        export = _verb(root, "export", "--ply", str(root / "road.ply"), "--glb", str(root / "road.glb"))
        out["export, 8 KiB left"] = _on_full(mounted, 8 << 10, export, root)
    return out


def full_verbs(folder: Path) -> dict[str, str]:
    """A training, a validation and a film, with no space and with a little; then again, with enough."""
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
                out[f"{name}, {leave >> 10} KiB left"] = _on_full(mounted, leave, command, root)
            done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
            out[f"{name}, afterwards"] = "ok" if done.returncode == 0 else done.stderr[-1500:]
    return out


def _on_full(mounted: Path, leave: int, command: list[str], root: Path) -> str:
    filling = fill(mounted, leave)
    try:
        return refused(command, root) or "ok"
    finally:
        filling.unlink()


_VERB_TRAIN = _TRAIN.replace(
    "train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), small)",
    """
from twin import commands
def work(options):
    train(twin.load_scene(sys.argv[1]), Path(sys.argv[1]) / "runs" / sys.argv[2], small)
sys.exit(commands.run(commands.Parser(), work, []))
""",
)


def _verb(root: Path, name: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", f"twin.{name}", str(root), *arguments, "--quiet"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("endurance", "kills", "disk"))
    parser.add_argument("--steps", type=int, default=1_000_000, help="of endurance (default %(default)s)")
    parser.add_argument("--times", type=int, default=50, help="kills of each verb (default %(default)s)")
    parser.add_argument("--only", choices=("build", "train", "validate"), help="of kills")
    parser.add_argument("--json", type=Path, help="where to write the table")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        works: dict[str, Callable[[], dict[str, Any]]] = {
            "endurance": lambda: endurance(options.steps, folder),
            "kills": lambda: kills(options.times, folder, options.only),
            "disk": lambda: disk(folder),
        }
        out = works[options.what]()
    for key, value in out.items():
        print(f"{key:40} {value}")
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if out["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
