"""Regression test for refactorings: compares results of this tree with those of another commit, bit for bit.

    python benchmarks/sameness.py COMMIT [--work DIR]

The tree of COMMIT films and builds a tiny scene. Both trees then open that build, drive the same episodes, train the
same few steps, validate the trained policy, and rebuild field, mesh and scene from the same cameras. The digests of the
results are compared; the exit status is 1 if any differs. Both trees run the same scripts, which use public names only,
so that renaming private ones does not break them. Structure from motion is not compared, as it is not repeatable.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
QUICK = ("nerf.steps=80", "nerf.rays=1024", "nerf.max_width=160", "nerf.bake_steps=20", "nerf.max_bricks=1200")
QUICK += ("mesh.voxel=0.2", "review.fps=3", "review.width=160")
"""Settings for a complete build in one to two minutes."""
_PILOT = "ros2/twin_policy"  # folder of the package `twin_policy`
_STAGES = ("3_field", "4_mesh", "5_mjcf")
_EPISODES = """
import hashlib, itertools, json, sys
import numpy as np
import twin
from twin.env.options import CameraOptions

out = {}
camera = CameraOptions(vibration=0.3, exposure=0.1, shutter=0.02)
obstacles = {"none": 0, "sampled": 2, "scene": "scene"}
lightings = sys.argv[2].split(",")
settings = itertools.product(("route",), lightings, obstacles, (False, True), ("twist", "steering"))
for k, (task, lighting, which, randomise, action) in enumerate(settings):
    options = {"lighting": lighting, "obstacles": obstacles[which], "randomise": randomise, "action": action}
    options |= {"camera": camera} if k % 2 else {}
    options |= {"observe": "simulator"} if k % 7 == 6 else {}
    environment = twin.load(sys.argv[1], task, seed=k, size=(64, 36), **options)
    digest, rng = hashlib.sha256(), np.random.default_rng(k)
    step = environment.reset()
    for _ in range(6):
        digest.update(np.ascontiguousarray(step.observation["pixels"]).tobytes())
        digest.update(np.ascontiguousarray(environment.physics.data.qpos).tobytes())
        digest.update(np.float64(step.reward or 0.0).tobytes())
        if step.last():
            break
        spec = environment.action_spec()
        step = environment.step(rng.uniform(spec.minimum, spec.maximum))
    environment.close()
    name = f"episode {task}, {lighting}, obstacles {which}, randomise {randomise}, {action}"
    out[name] = digest.hexdigest()
print(json.dumps(out))
"""
_TRAINING = """
import sys
from pathlib import Path
import twin
from twin.learn.training import TrainConfig, train

small = TrainConfig(task="route", lighting="training", steps=96, worlds=4, starts=40, batch=16, buffer=400, updates=0.5,
    teacher_steps=80, convolutions=((8, 8, 8),), features=16, hidden=(16,), save_every=48, checkpoints=2)
train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), small)
"""


class Tree:
    """A source tree, whose `twin` runs in separate processes."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def python(self, *arguments: str | Path) -> str:
        """Runs Python with this tree's `twin`; returns its standard output."""
        done = subprocess.run(
            [sys.executable, *map(str, arguments)],
            cwd=self.root,
            # The environment's own `twin_policy` may be that of another tree.
            env={
                **os.environ,
                "PYTHONPATH": f"{self.root}{os.pathsep}{self.root / _PILOT}",
                "CUDA_VISIBLE_DEVICES": "",
            },
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise SystemExit(f"{self.root}: {' '.join(map(str, arguments))[:200]}: {done.stderr[-3000:]}")
        return done.stdout

    def build(self, scene: Path) -> None:
        settings = [word for one in QUICK for word in ("--set", one)]
        self.python("-m", "twin.build", scene, "--quiet", *settings)

    def digests(self, scene: Path, lightings: str, work: Path) -> dict[str, str]:
        """Digests of all compared results; either tree may have built `scene`."""
        out: dict[str, str] = json.loads(self.python("-c", _EPISODES, scene, lightings).splitlines()[-1])
        again = work / "again"
        shutil.rmtree(again, ignore_errors=True)
        shutil.copytree(scene, again, symlinks=True)
        self.python("-c", _TRAINING, again, again / "runs" / "small")
        for name in ("policy.safetensors", "policy.json"):
            out[f"training, {name}"] = _digest(again / "runs" / "small" / name)
        drive = ("--task", "route", "--lightings", "held-out", "--episodes", "2", "--quiet")
        self.python("-m", "twin.validate", again, "--policy", "small", *drive)
        out["validation, episodes.csv"] = _digest(again / "validation" / "episodes.csv")
        for stage in _STAGES:
            shutil.rmtree(again / "build" / stage)
        self.build(again)
        for stage in _STAGES:
            for path in sorted((again / "build" / stage).rglob("*")):
                if path.is_file() and path.name not in ("stamp.json", "report.json"):
                    out[f"{stage}/{path.relative_to(again / 'build' / stage)}"] = _digest(path)
        shutil.rmtree(again)
        return out


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], cwd=_ROOT, check=True, stdout=subprocess.PIPE).stdout


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="commit to compare with")
    parser.add_argument("--work", type=Path, help="folder that keeps each commit's tree and scene (default: none)")
    options = parser.parse_args()
    commit = _git("rev-parse", "--verify", f"{options.commit}^{{commit}}").decode().strip()
    with tempfile.TemporaryDirectory() as temporary:
        work = (options.work or Path(temporary)).resolve() / commit
        old, scene = work / "before", work / "scene"
        if not old.exists():
            work.mkdir(parents=True, exist_ok=True)
            archive = _git("archive", commit)
            old.mkdir()
            subprocess.run(["tar", "x", "-C", str(old)], input=archive, check=True)
        before, after = Tree(old), Tree(_ROOT)
        if not (scene / "build").exists():
            before.python("-m", "twin.reality", "film", "--tiny", "--out", scene)
            shutil.rmtree(scene / "truth")  # comparison with the truth takes longer than the build
            before.build(scene)
        was = before.digests(scene, "sun,overcast,training", work)
        now = after.digests(scene, "sun,overcast,training", work)
    different = [name for name in was if now.get(name) != was[name]] + [name for name in now if name not in was]
    for name in different:
        print(f"differs: {name}")
    print(f"{len(was) - sum(name in was for name in different)} of {len(was)} results equal those of {options.commit}")
    return int(bool(different))


if __name__ == "__main__":
    sys.exit(main())
