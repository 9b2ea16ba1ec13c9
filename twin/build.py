"""`twin build`: builds a drivable twin of a filmed place, stage by stage; stages that are up to date are skipped.

`PIPELINE` defines the stages. Each writes `build/<folder>.partial`, which is renamed at the end. After a killed build,
the next one removes partial folders and continues. `twin.scene` defines when a stage is up to date.
"""

import argparse
import dataclasses
import importlib
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin import commands, runtime
from twin.config import RouteConfig, SceneConfig
from twin.config_file import load_config
from twin.errors import InputError, join_names
from twin.files import digest_file, digest_json, is_folder, is_link, remove, write_json
from twin.runtime import PeakMemory, exclusive_lock
from twin.scene import SceneDir, Stamp, commit_stage, package_versions, recover_stages, replace_file, write_stamp


@dataclass(frozen=True)
class Stage:
    """A build stage, and what its result depends on."""

    name: str
    module: str
    """Module of the stage's `run(scene, config, out) -> metrics`, imported when the stage runs."""
    version: int
    """Incremented when a change of the code alters the result."""
    config: tuple[str, ...]
    """Sections of `scene.toml`, or single settings `section.key`, that the stage reads."""
    upstream: tuple[str, ...]
    """Stages whose results this stage reads."""


_MJCF_OF_MESH = ("mjcf.route", "mjcf.half_width", "mjcf.corridor_margin")  # the mjcf settings that stage mesh reads
PIPELINE = (
    Stage("capture", "twin.capture.frames", 5, ("source", "capture"), ()),
    Stage("cameras", "twin.capture.sfm", 6, ("cameras",), ("capture",)),
    Stage("metric", "twin.capture.metric", 4, ("metric",), ("capture", "cameras")),
    Stage("field", "twin.nerf.trainer", 11, ("nerf", "mjcf.route"), ("cameras", "metric")),
    Stage("mesh", "twin.assets.mesh", 8, ("mesh", "route", "branch", *_MJCF_OF_MESH), ("cameras", "metric", "field")),
    # It also reads `route` and `branch`; if these change, so does the result of `mesh`.
    Stage("mjcf", "twin.mjcf.scene_xml", 5, ("name", "mjcf", "robot"), ("metric", "mesh")),
    Stage(
        "review",
        "twin.report.review_video",
        5,
        ("name", "review", "mjcf.route"),
        ("cameras", "metric", "field", "mesh", "mjcf"),
    ),
)

_ON_DEVICE = ("field", "mesh")  # stages that run on the device of --device
_WRITTEN = ("build", "runs", "validation", "forecast", "lightings")  # folders to which twin writes; never inputs
# Durations [s] for the demo with 2 cores. Only their ratios matter: they are scaled by the measured durations of
# earlier stages. The remaining time is shown once the typical durations of the earlier stages add up to more than
# `_LEAST_TIMED` [s]; the first stage alone is too short to determine the speed.
_TYPICAL = {"capture": 5.0, "cameras": 90.0, "metric": 1.0, "field": 280.0, "mesh": 70.0, "mjcf": 3.0, "review": 45.0}
_LEAST_TIMED = 30.0


def build(
    root: Path,
    until: str | None = None,
    force: tuple[str, ...] = (),
    overrides: tuple[str, ...] = (),
    device: str | None = None,
) -> dict[str, Any]:
    """Builds the scene at `root` and returns its report (also written to `build/report.json`).

    Args:
        root: The folder with `scene.toml`.
        until: Last stage to run; None = all. The report also has the later stages that are up to date.
        force: Stages to run again although they are up to date.
        overrides: `section.key=value` settings that take precedence over `scene.toml`.
        device: cpu or cuda, for the stages field and mesh; None: cuda if it is usable.

    Raises:
        InputError: invalid input; earlier results are kept.
    """
    scene = SceneDir(root)
    config = load_config(scene.config_file, overrides)
    names = [stage.name for stage in PIPELINE]
    if late := [name for name in force if until and names.index(name) > names.index(until)]:
        raise InputError(f"--force {late[0]}: --until {until} ends before this stage; leave one of them out")
    if device:
        from twin.nerf.buffers import resolve_device

        resolve_device(device)  # before anything is built
    inputs = input_digests(scene, config)
    if (is_link(scene.build) and not scene.build.exists()) or (scene.build.exists() and not scene.build.is_dir()):
        raise InputError(f"{scene.build} is not a folder; move it away: builds are written there")
    scene.build.mkdir(exist_ok=True)
    with exclusive_lock(scene.build / ".lock", f"{scene.root} is being built"):
        recover_stages(scene)
        stamps: dict[str, Stamp] = {}
        skipped: dict[str, bool] = {}
        finished = False
        for stage in PIPELINE:
            depends = _depends(stage, config, inputs, stamps)
            stamp = Stamp.load(scene.stage(stage.name))
            forced = stage.name in force
            current = stamp is not None and not forced and stamp.key == digest_json(depends)
            if stamp is None or not current:
                if finished:
                    break
                if stage.name == "field":
                    _check_routes(scene, config)
                done = {name: it.seconds for name, it in stamps.items() if not skipped[name]}
                if stamp is None:
                    damaged = (scene.stage(stage.name) / "stamp.json").exists()
                    changes = ["damaged or unreadable files"] if damaged else []
                else:
                    changes = ["--force"] if forced else _changes(depends, stamp.depends) if stamp.depends else []
                _announce(stage, done, until, f", again because of {join_names(changes, 4)}" if changes else "")
                stamp = _run(stage, scene, config, depends, device)
            stamps[stage.name], skipped[stage.name] = stamp, current
            finished = finished or stage.name == until
        report = _report(config, stamps, skipped)
        publish(scene, report)
    return report


def _check_routes(scene: SceneDir, config: SceneConfig) -> None:
    """Raises InputError if `[route]` or a `[[branch]]` does not fit what was filmed: before the field is trained."""
    if config.mjcf.route and (config.branch or config.route != RouteConfig()):
        from twin.geometry.cameras import Cameras
        from twin.geometry.route import filmed_branches, filmed_route

        cameras = Cameras.load(scene.stage("metric"))
        filmed_route(cameras, config.route)
        filmed_branches(cameras, config.branch)


def _changes(depends: dict[str, Any], before: dict[str, Any]) -> list[str]:
    """Names of the settings, input files and other dependencies of a stage that differ from those of a stamp."""
    now = json.loads(json.dumps(depends))  # JSON turns tuples into lists, as in the stamp

    def changed(a: Any, b: Any, name: str) -> list[str]:
        if a == b or not isinstance(a, dict) or not isinstance(b, dict):
            return [name] if a != b else []
        return [
            one for key in (a | b) for one in changed(a.get(key), b.get(key), f"{name}.{key}" if name else str(key))
        ]

    found = ["a newer version of twin"] if now["version"] != before["version"] else []
    found += changed(now["config"], before["config"], "") + changed(now["inputs"], before["inputs"], "")
    found += [f"new results of {name}" for name in changed(now["upstream"], before["upstream"], "")]
    return [*found, "seed"] if now["seed"] != before["seed"] else found


def _announce(stage: Stage, done: dict[str, float], until: str | None, why: str) -> None:
    """Logs that a stage begins, why, and, once the speed of the build is known, the remaining time of the build.

    `done` has the durations [s] of the earlier stages that this build has run.
    """
    names = [one.name for one in PIPELINE]
    names = names[: names.index(until) + 1] if until else names
    number = names.index(stage.name)
    typical = sum(_TYPICAL[name] for name in done)
    pace = sum(done.values()) / typical if typical else 1.0
    expected = [pace * _TYPICAL[name] for name in names[number:]]
    runtime.set_stage(runtime.BuildStage(number + 1, len(names), expected[0], sum(expected[1:])))
    left = f", about {max(1, round(sum(expected) / 60))} min left" if typical > _LEAST_TIMED else ""
    runtime.log_line(f"stage {number + 1} of {len(names)}: {stage.name}{why}{left}")


def input_digests(scene: SceneDir, config: SceneConfig) -> dict[str, str]:
    """SHA-256 of every file of the sources, by path relative to the scene.

    All files of a source folder are hashed, except twin's own output. There are two exceptions: a folder that contains
    the scene itself, and a posed image set given by a relative path that leads out of the scene. Of these, only the
    files that the build reads are hashed.

    Raises:
        InputError: a source is missing, or neither a file nor a folder.
    """
    from twin.capture.formats import is_image
    from twin.capture.frames import source_files

    files: set[Path] = set()
    for source in config.source:
        for name in filter(None, (source.path, source.images, source.mask)):
            path = scene.root / name
            is_folder(path, f"create {path}, or correct the path {name!r} in {scene.config_file}")
        path = scene.root / source.path
        images = scene.root / source.images if source.images else None
        files.update(source_files(path, source.kind, images))
        posed = path.suffix == ".json" or (path.is_dir() and any(path.glob("cameras.*")))
        if posed and not Path(source.path).is_absolute():
            # A posed image set refers to files beside it, so its whole top-level folder in the scene is hashed.
            path = scene.root.joinpath(*Path(os.path.normpath(source.path)).parts[:1])
        files.update(_files_below(path, scene))
        if images:
            files.update(_files_below(images, scene))
        mask = scene.root / source.mask
        if source.mask and mask.is_dir():
            files.update(_files_below(mask, scene) or filter(is_image, mask.iterdir()))
        elif source.mask:
            files.add(mask)
    return {os.path.relpath(file, scene.root): digest_file(file) for file in sorted(files)}


def _files_below(folder: Path, scene: SceneDir) -> list[Path]:
    """The regular files below a folder, except twin's output; none if the folder contains the scene itself."""
    root, top = scene.root.resolve(), folder.resolve()
    written = {(root / name) for name in _WRITTEN}
    if not folder.is_dir() or root.is_relative_to(top) or top in written:
        return []
    found = []
    for place, folders, names in os.walk(folder):
        here = Path(place)
        folders[:] = [name for name in folders if (here / name).resolve() not in written]
        found += [here / name for name in names if (here / name).is_file()]
    return found


def _depends(stage: Stage, config: SceneConfig, inputs: dict[str, str], stamps: dict[str, Stamp]) -> dict[str, Any]:
    table, settings = dataclasses.asdict(config), {}
    for name in stage.config:
        section, _, key = name.partition(".")
        settings[name] = table[section][key] if key else table[section]
    return {
        "stage": stage.name,
        "version": stage.version,
        "seed": config.seed,
        "config": settings,
        "inputs": inputs if not stage.upstream else {},
        "upstream": {name: stamps[name].result for name in stage.upstream},
    }


def _run(stage: Stage, scene: SceneDir, config: SceneConfig, depends: dict[str, Any], device: str | None) -> Stamp:
    out = scene.partial(stage.name)
    out.mkdir()
    start = time.perf_counter()
    runtime.return_memory()
    try:
        with PeakMemory() as peak:
            choice = {"device": device} if device and stage.name in _ON_DEVICE else {}
            metrics = importlib.import_module(stage.module).run(scene, config, out, **choice)
        about = {"metrics": metrics, "seconds": time.perf_counter() - start, "peak_memory_bytes": peak.bytes}
        stamp = write_stamp(out, stage.name, depends, device=device or "auto", **about)
    except BaseException:
        remove(out)
        raise
    finally:
        runtime.set_stage(None)
    commit_stage(scene, stage.name)
    return stamp


def _report(config: SceneConfig, stamps: dict[str, Stamp], skipped: dict[str, bool]) -> dict[str, Any]:
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
    if "review" in report:  # `seen_touched` is moved to the top level, because it concerns all stages
        report["review"] = {k: v for k, v in report["review"].items() if k != "seen_touched"}
        report["seen_touched"] = stamps["review"].metrics.get("seen_touched")
    return report


def publish(scene: SceneDir, report: dict[str, Any]) -> None:
    """Writes `report.json` and, if the build is complete, `report.html` and the review video.

    Adds `truth` (the comparison with the ground truth, if there is one) and `cautions` to the report.
    """
    from twin.report.build_report import cautions, load_truth_comparison, write_page

    compared = load_truth_comparison(scene)
    report["truth"] = compared and compared["figures"]
    report["cautions"] = cautions(report)
    write_json(scene.report_json, report)
    if "review" in report:
        replace_file(scene.stage("review") / "review.mp4", scene.review_mp4)
        write_page(scene, report)


def summary(report: dict[str, Any]) -> str:
    """The text printed at the end of a build: a row per stage, then a line per caution of the report."""
    from twin.report.build_report import cautions

    def number(stage: str, key: str, form: str) -> str:
        value = report.get(stage, {}).get(key)
        return form.format(value) if isinstance(value, int | float) else "not measured"

    cameras, metric = report.get("cameras", {}), report.get("metric", {})
    psnr = report.get("field", {}).get("psnr") or {}
    review = "no route to drive"
    if follower := report.get("review", {}).get("follower"):
        review = "goal reached" if follower.get("reached_goal") else "goal NOT reached"
        review += f", touched {', '.join(follower.get('touched') or ['nothing'])}"
    figures = {
        "capture": number("capture", "frames", "{} frames kept"),
        "cameras": f"{cameras.get('registered')} of {cameras.get('total')} frames registered, "
        + number("cameras", "reprojection_error_px", "{:.2f} px"),
        "metric": f"scale from {metric.get('scale_source')}" + number("metric", "scale_uncertainty", " ± {:.1%}"),
        "field": "held-out PSNR " + ", ".join(f"{name} {value:.1f} dB" for name, value in psnr.items()),
        "mesh": number("mesh", "parts", "{} convex parts"),
        "mjcf": number("mjcf", "route_length_m", "route {:.1f} m"),
        "review": review,
    }
    lines = [f"{'stage':<9} {'seconds':>8}  result"]
    for name, stage in report["stages"].items():
        note = " (up to date)" if stage["skipped"] else ""
        lines.append(f"{name:<9} {stage['seconds']:>8.1f}  {figures[name]}{note}")
    lines.append(f"{'total':<9} {report['seconds']:>8.1f}  peak memory {report['peak_memory_bytes'] / 2**30:.2f} GiB")
    lines += [f"{'caution':<9} {it['title']}: {it['what']} What helps: {it['cure']}" for it in cautions(report)]
    return "\n".join(lines)


def command(options: argparse.Namespace) -> None:
    """Runs `twin build` with the options parsed by `twin.commands`."""
    settings = [*options.set, *([f"nerf.quality={options.quality}"] if options.quality else [])]
    report = build(options.scene, options.until, tuple(options.force), tuple(settings), options.device)
    if not options.quiet:
        print(summary(report))
        if options.until is None:
            print(f"look at {SceneDir(options.scene).report_html} and {SceneDir(options.scene).review_mp4}")


if __name__ == "__main__":
    sys.exit(commands.main("build"))
