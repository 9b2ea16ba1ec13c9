"""The verb `build`, on a pipeline of stages that take no time."""

import errno
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
import types
from dataclasses import replace
from pathlib import Path

import pytest

from twin import build as verb
from twin import commands
from twin.config import MjcfConfig, SceneConfig, SourceConfig
from twin.files import digest_json
from twin.scene import SceneDir, Stamp, replace_file

_TOML = '[[source]]\npath = "input/a.txt"\n[metric]\ncamera_height = 1.0\n'


@pytest.fixture
def pipeline(monkeypatch, tmp_path):
    """A scene, and a pipeline capture → cameras → field whose stages record that they ran."""
    ran: list[str] = []
    reads = {"capture": "capture.fps", "cameras": "cameras.features", "field": "nerf.steps"}
    upstream = {"capture": (), "cameras": ("capture",), "field": ("cameras",)}
    stages = []
    for name, setting in reads.items():

        def run(scene, config, out, name=name, setting=setting):
            ran.append(name)
            section, key = setting.split(".")
            before = [(scene.stage(u) / "result.txt").read_text() for u in upstream[name]]
            text = (scene.root / "input/a.txt").read_text() if not before else "".join(before)
            # Only the whole part counts, so that a small change upstream may leave the result as it was.
            (out / "result.txt").write_text(f"{text}|{int(getattr(getattr(config, section), key))}")
            return {"ran": name}

        module = types.ModuleType(f"fake_{name}")
        module.run = run
        monkeypatch.setitem(sys.modules, f"fake_{name}", module)
        stages.append(verb.Stage(name, f"fake_{name}", 1, ("source", setting), upstream[name]))
    monkeypatch.setattr(verb, "PIPELINE", tuple(stages))
    root = tmp_path / "scene"
    (root / "input").mkdir(parents=True)
    (root / "input/a.txt").write_text("film")
    (root / "scene.toml").write_text(_TOML)
    return types.SimpleNamespace(root=root, ran=ran, scene=SceneDir(root))


def _rerun(pipeline, *overrides, force=()):
    pipeline.ran.clear()
    verb.build(pipeline.root, force=force, overrides=overrides)
    return list(pipeline.ran)


def test_runs_once_then_only_what_a_change_touches(pipeline):
    assert _rerun(pipeline) == ["capture", "cameras", "field"]
    assert _rerun(pipeline) == []
    assert _rerun(pipeline, "nerf.steps=7") == ["field"]
    assert _rerun(pipeline, "nerf.steps=7", "cameras.features=9") == ["cameras", "field"]
    assert _rerun(pipeline) == ["cameras", "field"]
    assert _rerun(pipeline, "mesh.voxel=0.3") == []
    assert _rerun(pipeline, "seed=5") == ["capture", "cameras", "field"]


def test_a_stage_that_runs_again_says_why(pipeline, capsys):
    """The first line of a build names the changes."""

    def first(*overrides, force=()):
        capsys.readouterr()
        _rerun(pipeline, *overrides, force=force)
        return capsys.readouterr().err.splitlines()[0].partition(": ")[2]

    assert first() == "capture"
    assert first("nerf.steps=7") == "field, again because of nerf.steps"
    assert first("nerf.steps=7", force=("field",)) == "field, again because of --force"
    assert first("nerf.steps=7", "seed=5") == "capture, again because of seed"
    (pipeline.root / "input/a.txt").write_text("another film")
    assert first("nerf.steps=7", "seed=5") == "capture, again because of input/a.txt"
    for stamp in pipeline.root.glob("build/*/stamp.json"):  # as in an unpacked pack
        replace(Stamp.verified(stamp.parent), depends={}, key="").save(stamp.parent)
    assert first() == "capture"
    (pipeline.scene.stage("cameras") / "result.txt").write_text("half of it")
    assert first() == "cameras, again because of damaged or unreadable files"


def test_settings_of_a_stage_are_in_its_key():
    """A setting changes the stage's own key, or that of an upstream stage."""
    sections = {f.name for f in verb.dataclasses.fields(SceneConfig)} - {"name", "seed"}
    keys: dict[str, set[str]] = {}
    for stage in verb.PIPELINE:
        keys[stage.name] = set(stage.config).union(*(keys[name] for name in stage.upstream))
        source = Path(importlib.import_module(stage.module).__file__).read_text(encoding="utf-8")
        reads = {match for match in re.findall(r"\bconfig\.(\w+)(?:\.(\w+))?", source) if match[0] in sections}
        assert reads, stage.name
        missing = {".".join(filter(None, r)) for r in reads if not {r[0], ".".join(r)} & keys[stage.name]}
        assert not missing, f"{stage.name} reads {missing}"
    assert [stage.name for stage in verb.PIPELINE if "name" in stage.config] == ["mjcf", "review"]  # that show it


def test_a_scene_without_a_route_needs_another_field():
    """Without a route, the camera's height is not assumed to be constant."""
    (stage,) = (one for one in verb.PIPELINE if one.name == "field")
    stamps = {name: types.SimpleNamespace(result="same") for name in stage.upstream}
    drive, object_filmed, wider = (
        digest_json(verb._depends(stage, SceneConfig(mjcf=mjcf), {}, stamps))
        for mjcf in (MjcfConfig(), MjcfConfig(route=False), MjcfConfig(half_width=2.0))
    )
    assert drive != object_filmed and drive == wider


def test_an_upstream_rerun_with_the_same_result_stops_there(pipeline):
    _rerun(pipeline)
    assert _rerun(pipeline, "capture.fps=2.5") == ["capture"]


def test_a_change_of_input_version_or_files_reruns_what_depends_on_it(pipeline, monkeypatch):
    _rerun(pipeline)
    (pipeline.root / "input/a.txt").write_text("another film")
    assert _rerun(pipeline) == ["capture", "cameras", "field"]
    assert _rerun(pipeline, force=("cameras",)) == ["cameras"]
    newer = [verb.dataclasses.replace(s, version=2) if s.name == "field" else s for s in verb.PIPELINE]
    monkeypatch.setattr(verb, "PIPELINE", tuple(newer))
    assert _rerun(pipeline) == ["field"]
    (pipeline.scene.stage("cameras") / "result.txt").unlink()
    assert _rerun(pipeline) == ["cameras"]
    result = pipeline.scene.stage("cameras") / "result.txt"
    result.write_text(result.read_text()[::-1])  # of the same size
    assert _rerun(pipeline) == ["cameras"]
    stamp = pipeline.scene.stage("capture") / "stamp.json"
    stamp.write_text(stamp.read_text().replace('"capture"', '"capturf"', 1))
    assert _rerun(pipeline) == ["capture"]


def test_images_listed_in_transforms_json_are_inputs_in_any_folder(tmp_path):
    root, elsewhere = tmp_path / "scene", tmp_path / "photos"
    (root / "input").mkdir(parents=True)
    elsewhere.mkdir()
    for name in ("a.png", "b.JPG", "mask.png"):
        (elsewhere / name).write_bytes(name.encode())
    frames = [
        {"file_path": "../../photos/a.png", "mask_path": "../../photos/mask.png"},
        {"file_path": "../../photos/b"},  # as instant-ngp writes it
        {"file_path": "../../photos/absent.png"},
        {"file_path": 3},
        "no frame",
    ]
    (root / "input/transforms.json").write_text(json.dumps({"frames": frames}))
    config = SceneConfig(source=(SourceConfig(path="input/transforms.json"),))
    digests = verb.input_digests(SceneDir(root), config)
    names = {"a.png", "b.JPG", "mask.png"}
    assert set(digests) == {"input/transforms.json", *(f"../photos/{name}" for name in names)}
    (elsewhere / "a.png").write_bytes(b"another")
    assert verb.input_digests(SceneDir(root), config) != digests
    (root / "input/transforms.json").write_text("{")
    assert set(verb.input_digests(SceneDir(root), config)) == {"input/transforms.json"}


def test_until_stops_after_its_stage_and_the_report_is_written(pipeline):
    report = verb.build(pipeline.root, until="cameras")
    assert pipeline.ran == ["capture", "cameras"] and list(report["stages"]) == ["capture", "cameras"]
    written = json.loads(pipeline.scene.report_json.read_text())
    assert written == json.loads(json.dumps(report))
    assert written["peak_memory_bytes"] > 1e6 and written["seed"] == 0 and written["versions"]["numpy"]


def test_a_route_that_was_not_filmed_is_refused_before_the_field_is_trained(pipeline, monkeypatch):
    def refuse(cameras, config):
        raise verb.InputError(f"route: no pass {config.passes[0]!r}")

    monkeypatch.setattr("twin.geometry.cameras.Cameras.load", lambda _: None)
    monkeypatch.setattr("twin.geometry.route.filmed_route", refuse)
    (pipeline.root / "scene.toml").write_text(_TOML + '[route]\npasses = ["dusk:2"]\n')
    with pytest.raises(verb.InputError, match="no pass 'dusk:2'"):
        verb.build(pipeline.root)
    assert pipeline.ran == ["capture", "cameras"]
    verb.build(pipeline.root, overrides=("mjcf.route=false",))
    assert pipeline.ran[-1] == "field"


def test_until_keeps_later_stages_in_the_report_if_they_are_up_to_date(pipeline):
    """Without a change, `--until` loses no numbers; after a change, numbers of stale stages are left out."""
    verb.build(pipeline.root)
    assert list(verb.build(pipeline.root, until="capture")["stages"]) == ["capture", "cameras", "field"]
    stale = verb.build(pipeline.root, until="capture", overrides=("cameras.features=9",))
    assert list(stale["stages"]) == ["capture"] and pipeline.ran == ["capture", "cameras", "field"]


def test_a_stage_forced_beyond_the_last_one_is_refused(pipeline):
    with pytest.raises(verb.InputError, match="--force field: --until cameras ends before"):
        verb.build(pipeline.root, until="cameras", force=("field",))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_full_or_read_only_disk_is_one_line_and_loses_nothing(pipeline, capsys, code):
    _rerun(pipeline)
    before = (pipeline.scene.stage("field") / "result.txt").read_text()

    def refuse(scene, config, out):
        (out / "half.txt").write_text("half")
        raise OSError(code, os.strerror(code), str(out / "half.txt"))

    sys.modules["fake_field"].run = refuse
    capsys.readouterr()
    assert commands.main("build", [str(pipeline.root), "--set", "nerf.steps=9", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "half.txt" in error and ("again" in error or "writable" in error)
    assert (pipeline.scene.stage("field") / "result.txt").read_text() == before
    assert not list(pipeline.scene.build.glob("*.partial")) and not (pipeline.scene.build / ".lock").exists()


def test_bad_input_exits_2_and_a_bug_keeps_its_traceback(pipeline, capsys):
    assert commands.main("build", [str(pipeline.root), "--set", "nerf.stepz=9"]) == 2
    assert "did you mean 'steps'" in capsys.readouterr().err
    assert commands.main("build", [str(pipeline.root / "nowhere")]) == 2
    (pipeline.root / "input/a.txt").unlink()
    assert commands.main("build", [str(pipeline.root)]) == 2
    assert "input/a.txt" in capsys.readouterr().err
    (pipeline.root / "input/a.txt").write_text("film")

    def bug(scene, config, out):
        raise KeyError("bug")

    sys.modules["fake_capture"].run = bug
    with pytest.raises(KeyError):
        commands.main("build", [str(pipeline.root), "--quiet"])


def test_a_killed_build_resumes_and_a_second_one_refuses(pipeline, tmp_path):
    """A build is killed by SIGKILL in a stage: the next one removes the partial folder, keeps finished stages, and
    gives the same result.
    """
    script = textwrap.dedent(
        """
        import sys, time, types
        from pathlib import Path
        from twin import build as verb
        def slow(scene, config, out):
            (out / "half.txt").write_text("half")
            Path(sys.argv[2]).touch()
            time.sleep(60)
        def quick(scene, config, out):
            (out / "result.txt").write_text("film|2")
            return {"ran": "capture"}
        for name, run in (("capture", quick), ("cameras", slow)):
            module = types.ModuleType(f"fake_{name}")
            module.run = run
            sys.modules[f"fake_{name}"] = module
        verb.PIPELINE = (
            verb.Stage("capture", "fake_capture", 1, ("source", "capture.fps"), ()),
            verb.Stage("cameras", "fake_cameras", 1, ("source", "cameras.features"), ("capture",)),
        )
        verb.build(Path(sys.argv[1]))
        """
    )
    started = tmp_path / "started"
    process = subprocess.Popen([sys.executable, "-c", script, str(pipeline.root), str(started)])
    try:
        deadline = time.monotonic() + 60
        while not started.exists():
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.05)
        with pytest.raises(verb.InputError, match=f"process {process.pid}"):
            verb.build(pipeline.root)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert pipeline.scene.partial("cameras").exists()
    assert _rerun(pipeline) == ["cameras", "field"]
    assert not pipeline.scene.partial("cameras").exists()
    defaults = SceneConfig()
    expected = f"film|2|{defaults.cameras.features}|{defaults.nerf.steps}"
    assert (pipeline.scene.stage("field") / "result.txt").read_text() == expected


def test_a_kill_between_the_two_renames_loses_nothing(pipeline):
    _rerun(pipeline)
    final = pipeline.scene.stage("cameras")
    final.rename(final.with_name(final.name + ".old"))
    assert _rerun(pipeline) == []
    assert Stamp.load(final) is not None


def test_a_film_published_again_leaves_no_partial_file(tmp_path):
    source, target = tmp_path / "stage" / "review.mp4", tmp_path / "review.mp4"
    source.parent.mkdir()
    for content in (b"first", b"first", b"second"):
        if not source.exists() or source.read_bytes() != content:
            source.unlink(missing_ok=True)
            source.write_bytes(content)
        replace_file(source, target)
        assert target.read_bytes() == content and sorted(tmp_path.iterdir()) == [target, source.parent]
