"""A drive as a recording of Rerun: read back, it has the drive's instants, poses, pictures and commands."""

import sys

import cv2
import numpy as np
import pytest
from tiny_twin import tiny_twin

import twin
from twin import commands
from twin.env.drivers import RouteDriver
from twin.env.episode import record_episode

TIMED = {
    *("/world/robot", "/world/driven", "/world/robot/camera", "/speed/wanted", "/speed/driven", "/yaw_rate/wanted"),
    *("/yaw_rate/driven", "/cross_track", "/progress", "/trust", "/reward"),
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_twin(tmp_path_factory.mktemp("twin"))


def columns(path):
    """The timed values of each entity in order: (times [s], component → list of values)."""
    from rerun.chunk import RrdReader

    out = {}
    for chunk in RrdReader(path).stream().to_chunks():
        table = chunk.to_record_batch()
        if chunk.is_static or "drive" not in table.schema.names:
            continue
        times, values = out.setdefault(chunk.entity_path, ([], {}))
        times += (np.array(table.column("drive").cast("int64")) / 1e9).tolist()
        for name in set(table.schema.names) - {"drive", "log_time"}:
            values.setdefault(name, []).extend(table.column(name).to_pylist())
    return out


def test_a_recording_holds_the_drive(scene, tmp_path, capsys):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    path = tmp_path / "drive.rrd"
    options = ["--task", "ahead", "--lighting", "night", "--seed", "3"]
    assert (
        commands.main("film", [str(scene), *options, "--rerun", str(path), "--out", str(tmp_path / "drive.mp4")]) == 0
    )
    assert f"look at it: rerun {path}" in capsys.readouterr().out
    seen = []
    environment = twin.load(scene, "ahead", 3, lighting="night")
    episode = record_episode(
        environment, RouteDriver(), lambda step: seen.append(step.observation["pixels"][-1].copy())
    )
    found = columns(path)
    assert set(found) >= TIMED
    for entity in TIMED:
        np.testing.assert_allclose(found[entity][0], episode.times, atol=1e-6)

    def values(entity, component):
        (name,) = [name for name in found[entity][1] if name.endswith(component)]
        return found[entity][1][name]

    at = np.array(values("/world/robot", "translation"))[:, 0]
    np.testing.assert_allclose(at, episode.base_to_world[:, :3, 3], atol=1e-5)
    for entity, wanted in (("/progress", episode.progress), ("/reward", episode.rewards), ("/trust", episode.trust)):
        np.testing.assert_allclose(np.ravel(values(entity, "scalars")), wanted, atol=1e-6)
    np.testing.assert_allclose(np.ravel(values("/yaw_rate/wanted", "scalars")), episode.actions[:, -1], atol=1e-6)
    assert np.ravel(values("/speed/driven", "scalars")).max() == pytest.approx(episode.speed.max())
    jpegs = values("/world/robot/camera", "blob")
    for jpeg, picture in zip(jpegs[::10], seen[::10], strict=True):
        decoded = cv2.cvtColor(cv2.imdecode(np.array(jpeg[0], np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        assert decoded.shape == picture.shape and np.abs(decoded.astype(int) - picture).mean() < 8.0
    text = " ".join(np.ravel(values("/events", "text")).tolist())
    assert "goal after 3." in text and "lighting night" in text
    assert "task ahead, seed 3" in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rerun", "no/drive.rrd"], "there is no folder no"),
        (["--rerun", "drive.mp4"], "drive.mp4: expected a file ending in .rrd"),
        (["--rerun", "drive.rrd", "--lerobot", "drives"], "--rerun records one drive"),
    ],
)
def test_impossible_recordings_are_refused_in_one_line(scene, capsys, options, words):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    assert commands.main("film", [str(scene), "--task", "ahead", "--quiet", *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and words in error and error.count("\n") == 1


def test_without_the_package_one_line_says_what_to_install(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert (
        commands.main("film", [str(scene), "--task", "ahead", "--quiet", "--rerun", str(tmp_path / "drive.rrd")]) == 2
    )
    error = "error: a Rerun recording needs the missing package rerun-sdk: pip install 'twin[rerun]'\n"
    assert capsys.readouterr().err == error
