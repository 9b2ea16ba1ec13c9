"""The verb that turns a filmed place into a drivable twin, stage by stage, skipping what is up to date.

    python -m twin.build SCENE [--until STAGE] [--force STAGE] [--set nerf.steps=4000] [--device cpu|cuda] [--quiet]

A stage runs in `build/<folder>.partial`, which is renamed when it is complete. See `twin.stamp` for when it runs again.
"""

import argparse
import dataclasses
import errno
import importlib
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin import progress
from twin.alone import alone
from twin.config import SceneConfig
from twin.config_file import load_config
from twin.errors import InputError, refuse
from twin.memory import PeakMemory
from twin.scene import STAGES, SceneDir, digest_file, write_json
from twin.stamp import Stamp, commit, digest_folder, key_of, package_versions, recover, replace_file


@dataclass(frozen=True)
class Stage:
    """What a stage is and what its result depends on."""

    name: str
    module: str
    """Its `run(scene, config, out) -> metrics` lives here; imported only when it runs."""
    version: int
    """Raised when the same input would give another result."""
    config: tuple[str, ...]
    """Sections of `scene.toml`, or `section.key`, that it reads."""
    upstream: tuple[str, ...]
    """Stages whose results it reads."""


_MJCF_OF_MESH = ("mjcf.route", "mjcf.half_width", "mjcf.corridor_margin")  # the rest only changes stage mjcf

PIPELINE = (
    Stage("capture", "twin.capture.frames", 1, ("source", "capture"), ()),
    Stage("cameras", "twin.capture.sfm", 1, ("cameras",), ("capture",)),
    Stage("metric", "twin.capture.metric", 1, ("metric",), ("capture", "cameras")),
    Stage("field", "twin.nerf.stage", 3, ("nerf", "mjcf.route"), ("cameras", "metric")),
    Stage("mesh", "twin.assets.mesh", 2, ("mesh", *_MJCF_OF_MESH), ("cameras", "metric", "field")),
    Stage("mjcf", "twin.mjcf.export", 3, ("mjcf", "robot"), ("metric", "mesh")),
    Stage("review", "twin.report.review", 3, ("review", "mjcf.route"), ("cameras", "metric", "field", "mesh", "mjcf")),
)


def build(
    root: Path,
    until: str | None = None,
    force: tuple[str, ...] = (),
    overrides: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Builds the scene at `root` and returns its report (also written to `build/report.json`).

    Args:
        root: The scene folder, with `scene.toml` in it.
        until: Last stage to run; None = all.
        force: Stages to run again although they are up to date.
        overrides: `section.key=value` settings that take precedence over `scene.toml`.

    Raises:
        InputError: Bad input; what was built before stays as it was.
    """
    scene = SceneDir(root)
    config = load_config(scene.config_file, overrides)
    inputs = input_digests(scene, config)
    scene.build.mkdir(exist_ok=True)
    with alone(scene.build / ".lock", f"{scene.root} is being built"):
        recover(scene)
        stamps: dict[str, Stamp] = {}
        skipped: dict[str, bool] = {}
        for stage in PIPELINE:
            depends = _depends(stage, config, inputs, stamps)
            stamp = None if stage.name in force else Stamp.load(scene.stage(stage.name))
            skipped[stage.name] = stamp is not None and stamp.key == key_of(depends)
            if stamp is None or not skipped[stage.name]:
                stamp = _run(stage, scene, config, depends)
            stamps[stage.name] = stamp
            if stage.name == until:
                break
        report = _report(scene, config, stamps, skipped)
        _publish(scene, report)
    return report


def input_digests(scene: SceneDir, config: SceneConfig) -> dict[str, str]:
    """SHA-256 of every file the sources name, by path relative to the scene. Raises InputError if one is absent."""
    from twin.capture.formats import files_named

    digests: dict[str, str] = {}
    for source in config.source:
        for name in filter(None, (source.path, source.images, source.mask)):
            path = scene.root / name
            if not path.exists():
                raise InputError(f"{scene.config_file}: {name!r} does not exist; put it there or correct the path")
            # A transforms.json or a COLMAP model names images elsewhere below input/, which are input as well.
            posed = path.suffix == ".json" or any(path.glob("cameras.*"))
            folder = scene.root / Path(name).parts[0] if posed and not Path(name).is_absolute() else path
            files = sorted(p for p in folder.rglob("*") if p.is_file()) if folder.is_dir() else [path]
            if path.suffix == ".json":
                files += files_named(path, scene.root / source.images if source.images else None)
            digests |= {os.path.relpath(file, scene.root): digest_file(file) for file in files}
    return digests


def _depends(stage: Stage, config: SceneConfig, inputs: dict[str, str], stamps: dict[str, Stamp]) -> dict[str, Any]:
    table = dataclasses.asdict(config)
    settings: dict[str, Any] = {}
    for name in stage.config:
        section, _, key = name.partition(".")
        settings[name] = table[section][key] if key else table[section]
    if not settings.get("nerf", {}).get("refine_cameras", True):
        del settings["nerf"]["refine_cameras"]  # came later: without it a field is what it was before
    return {
        "stage": stage.name,
        "version": stage.version,
        "seed": config.seed,
        "config": settings,
        "inputs": inputs if not stage.upstream else {},
        "upstream": {name: stamps[name].result for name in stage.upstream},
    }


def _run(stage: Stage, scene: SceneDir, config: SceneConfig, depends: dict[str, Any]) -> Stamp:
    progress.say(f"{stage.name}")
    out = scene.partial(stage.name)
    out.mkdir()
    start = time.perf_counter()
    with PeakMemory() as peak:
        metrics = importlib.import_module(stage.module).run(scene, config, out)
    seconds = time.perf_counter() - start
    result, files = digest_folder(out)
    device = os.environ.get("TWIN_DEVICE", "auto")
    stamp = Stamp(
        stage.name, key_of(depends), result, depends, files, metrics, seconds, peak.bytes, device, package_versions()
    )
    commit(scene, stage.name, stamp)
    return stamp


def _report(scene: SceneDir, config: SceneConfig, stamps: dict[str, Stamp], skipped: dict[str, bool]) -> dict[str, Any]:
    report: dict[str, Any] = {
        "scene": config.name,
        "seed": config.seed,
        "versions": package_versions(),
        "peak_memory_bytes": max(stamp.peak_memory_bytes for stamp in stamps.values()),
        "seconds": sum(stamp.seconds for stamp in stamps.values()),
        "stages": {
            name: {
                "seconds": stamp.seconds,
                "peak_memory_bytes": stamp.peak_memory_bytes,
                "skipped": skipped[name],
                "device": stamp.device,
                "config": stamp.depends["config"],
            }
            for name, stamp in stamps.items()
        },
        "inputs": stamps["capture"].depends["inputs"],
    }
    report |= {name: stamp.metrics for name, stamp in stamps.items()}
    if "review" in report:  # beside the stages, as it is about all of them
        report["review"] = {k: v for k, v in report["review"].items() if k != "seen_touched"}
        report["seen_touched"] = stamps["review"].metrics.get("seen_touched")
    report["truth"] = None
    if scene.truth.exists() and "mesh" in stamps:
        from twin.report.truth import compare

        report["truth"] = compare(scene)
    return report


def _publish(scene: SceneDir, report: dict[str, Any]) -> None:
    write_json(scene.report_json, report)
    if "review" in report:
        from twin.report.page import write_page

        replace_file(scene.stage("review") / "review.mp4", scene.review_mp4)
        write_page(scene, report)


def _select_device(device: str | None) -> None:
    if device is None:
        return
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise InputError("--device cuda: no usable CUDA device; leave the option out, or use --device cpu")
    os.environ["TWIN_DEVICE"] = device


def summary(report: dict[str, Any]) -> str:
    """The table printed at the end of a build."""

    def pick(*path: str) -> Any:
        value: Any = report
        for key in path:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    def number(value: Any, form: str) -> str:
        return form.format(value) if isinstance(value, int | float) else "not measured"

    psnr = pick("field", "psnr") or {}
    follower = pick("review", "follower") or {}
    figures = {
        "capture": number(pick("capture", "frames"), "{} frames kept"),
        "cameras": f"{pick('cameras', 'registered')} of {pick('cameras', 'total')} frames registered, "
        + number(pick("cameras", "reprojection_error_px"), "{:.2f} px"),
        "metric": f"scale from {pick('metric', 'scale_source')}"
        + number(pick("metric", "scale_uncertainty"), " ± {:.1%}"),
        "field": "held-out PSNR " + ", ".join(f"{name} {value:.1f} dB" for name, value in psnr.items()),
        "mesh": number(pick("mesh", "parts"), "{} convex parts"),
        "mjcf": number(pick("mjcf", "route_length_m"), "route {:.1f} m"),
        "review": "no route to drive"
        if not follower
        else ("goal reached" if follower.get("reached_goal") else "goal NOT reached")
        + (", touched " + ", ".join(follower["touched"]) if follower.get("touched") else ", touched nothing"),
    }
    lines = [f"{'stage':<9} {'seconds':>8}  result"]
    for name, stage in report["stages"].items():
        note = " (up to date)" if stage["skipped"] else ""
        lines.append(f"{name:<9} {stage['seconds']:>8.1f}  {figures[name]}{note}")
    lines.append(f"{'total':<9} {report['seconds']:>8.1f}  peak memory {report['peak_memory_bytes'] / 2**30:.2f} GiB")
    return "\n".join(lines)


_EPILOG = """\
a scene.toml of your own road:

  [[source]]                      # one per film; several lightings make one twin
  path = "input/morning.mp4"      # video, photo folder, COLMAP model or transforms.json
  lighting = "morning"
  # mask = "input/robot.png"      # 0 = ignore (an image, or a folder named like the frames)
  # camera = { model = "PINHOLE", params = [fx, fy, cx, cy], width = 1280, height = 720 }

  [metric]                        # where the metres come from: one of
  camera_height = 1.2             #   lens above the ground [m]
  # gps = true                    #   EXIF positions
  # distance = { metres = 5.0, frame_a = "morning/000010", a = [u, v], b = [u, v] }
  # marker = { family = "DICT_APRILTAG_36h11", id = 0, size = 0.2 }
  # poses_are_metric = true       #   poses that came with the input

python -m twin.new SCENE VIDEO... writes such a folder.
"""


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m twin.build",
        description="Turn a filmed place into a drivable MuJoCo twin.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", type=Path, help="folder with scene.toml and input/")
    parser.add_argument("--until", choices=STAGES, metavar="STAGE", help=f"stop after: {', '.join(STAGES)}")
    parser.add_argument("--force", choices=STAGES, metavar="STAGE", action="append", default=[], help="run it again")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="such as nerf.steps=4000")
    parser.add_argument("--device", choices=("cpu", "cuda"), help="default: cuda where it is usable, else cpu")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    arguments = parser.parse_args(argv)
    progress.set_quiet(arguments.quiet)
    try:
        _select_device(arguments.device)
        report = build(arguments.scene, arguments.until, tuple(arguments.force), tuple(arguments.set))
    except InputError as error:
        return refuse(error)
    except OSError as error:
        # Only what the user's machine refuses; any other OSError is a bug and keeps its traceback.
        cures = {
            errno.ENOSPC: "free some space",
            errno.EDQUOT: "free some space",
            errno.EROFS: "make the folder writable",
            errno.EACCES: "make the folder writable",
            errno.EPERM: "make the folder writable",
        }
        if error.errno not in cures:
            raise
        return refuse(f"{error.filename or arguments.scene}: {error.strerror}; {cures[error.errno]} and run again")
    except KeyboardInterrupt:
        print("stopped; run the same command to resume", file=sys.stderr)
        return 130
    if not arguments.quiet:
        print(summary(report))
        if arguments.until is None:
            print(f"look at {SceneDir(arguments.scene).report_html} and {SceneDir(arguments.scene).review_mp4}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
