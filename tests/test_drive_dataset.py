"""Drives as a LeRobot dataset: what its readers need, on made-up drives."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from twin.env.episode import Episode
from twin.errors import InputError
from twin.files import read_json
from twin.report import drive_dataset
from twin.report.drive_dataset import CAMERA, DriveDataset, read_drives
from twin.report.video_writer import read_frames

pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow")
parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")

SIZE = (64, 36)
LENGTHS = (12, 7)
ACTIONS = {"linear_velocity": (0.0, 0.8), "angular_velocity": (-0.5, 0.5)}


def drive(count: int, seed: int, cause: str) -> tuple[Episode, list[np.ndarray], np.ndarray]:
    """A drive of `count` instants: episode, pictures, motion."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (count, 2))
    actions[-1] = 0.0
    base = np.tile(np.eye(4), (count, 1, 1))
    base[:, 0, 3] = np.arange(count) * 0.1
    episode = Episode(
        times=np.arange(count) * 0.1,
        base_to_world=base,
        qpos=np.zeros((count, 7)),
        actions=actions,
        rewards=rng.uniform(0, 1, count),
        speed=rng.uniform(0, 1, count),
        cross_track=rng.uniform(-1, 1, count),
        progress=np.arange(count) * 0.1,
        trust=np.ones(count),
        cause=cause,
        touched=(),
        task="straight",
        lighting="day",
        seed=seed,
        randomisation={},
        obstacles=(),
    )
    ramp = np.linspace(0, 200, SIZE[0])[None, :, None] * np.ones((SIZE[1], 1, 3))
    pictures = [np.clip(ramp + 4 * k, 0, 255).astype(np.uint8) for k in range(count)]
    return episode, pictures, rng.uniform(-1, 1, (count, 2))


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Path, list]:
    folder = tmp_path_factory.mktemp("dataset")
    drives = [drive(LENGTHS[0], 3, "goal"), drive(LENGTHS[1], 4, "collision")]
    dataset = DriveDataset(folder, SIZE, 0.1, ACTIONS, "Drive.")
    for one in drives:
        dataset.add(*one)
    dataset.finish()
    return folder, drives


def table(folder: Path, name: str) -> dict[str, list]:
    return parquet.read_table(folder / name).to_pydict()


def test_a_bags_pictures_are_those_that_had_arrived() -> None:
    """A policy acts on a picture when it arrives, 90 ms after its exposure."""
    shutter = np.arange(4) * 100_000_000
    recording = SimpleNamespace(
        shutter=shutter,
        arrival=shutter + 90_000_000,
        rectified=lambda stamps, _: ((stamp, f"picture {stamp // 10**8}") for stamp in stamps.tolist()),
    )
    at = np.array([50, 100, 189, 190, 390]) * 1_000_000
    names = drive_dataset._pictures_at(recording, None, at)
    assert names == ["picture 0", "picture 0", "picture 0", "picture 1", "picture 3"]


def test_frames_pair_each_picture_with_the_action_that_followed(written):
    folder, drives = written
    rows = table(folder, "data/chunk-000/file-000.parquet")
    counts = [count - 1 for count in LENGTHS]
    assert rows["index"] == list(range(sum(counts)))
    assert rows["episode_index"] == [0] * counts[0] + [1] * counts[1]
    assert rows["frame_index"] == [*range(counts[0]), *range(counts[1])]
    np.testing.assert_array_equal(np.float32(rows["timestamp"]), np.float32(np.array(rows["frame_index"]) / 10))
    for name, of in (("action", lambda e, m: e.actions[:-1]), ("observation.state", lambda e, m: m[:-1])):
        wanted = np.concatenate([of(episode, motion) for episode, _, motion in drives])
        np.testing.assert_array_equal(np.float32(rows[name]), np.float32(wanted))
    np.testing.assert_array_equal(
        np.float32(rows["next.reward"]), np.float32(np.concatenate([episode.rewards[1:] for episode, _, _ in drives]))
    )
    assert np.flatnonzero(rows["next.done"]).tolist() == [counts[0] - 1, sum(counts) - 1]
    assert np.flatnonzero(rows["next.success"]).tolist() == [counts[0] - 1]


def test_films_show_the_pictures_at_their_times(written):
    folder, drives = written
    episodes = table(folder, "meta/episodes/chunk-000/file-000.parquet")
    for number, (_, pictures, _) in enumerate(drives):
        assert episodes[f"videos/{CAMERA}/file_index"][number] == number
        frames = list(read_frames(folder / f"videos/{CAMERA}/chunk-000/file-{number:03d}.mp4"))
        assert len(frames) == episodes["length"][number] == len(pictures) - 1
        assert np.abs(np.array(frames, int) - np.array(pictures[:-1], int)).mean() < 2.0  # of 255: the codec's error
    assert episodes["dataset_from_index"] == [0, LENGTHS[0] - 1]
    assert episodes["dataset_to_index"] == [LENGTHS[0] - 1, sum(LENGTHS) - 2]


def test_statistics_are_those_of_all_frames(written):
    folder, drives = written
    stats = read_json(folder / "meta/stats.json")
    actions = np.concatenate([episode.actions[:-1] for episode, _, _ in drives]).astype(np.float32)
    for kind, wanted in (("mean", actions.mean(0)), ("std", actions.std(0)), ("min", actions.min(0))):
        np.testing.assert_allclose(stats["action"][kind], wanted, rtol=1e-5)
    parts = [episode.actions[:-1].astype(np.float32) for episode, _, _ in drives]
    for kind, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        each = [np.quantile(part, share, axis=0) for part in parts]
        np.testing.assert_allclose(stats["action"][kind], np.average(each, 0, [len(part) for part in parts]), rtol=1e-5)
        each = [np.quantile(np.array(one[:-1]).reshape(-1, 3) / 255, share, 0) for _, one, _ in drives]
        wanted = np.average(each, 0, [len(part) for part in parts])
        np.testing.assert_allclose(np.ravel(stats[CAMERA][kind]), wanted, atol=1 / 255)
    colors = np.concatenate([pictures[:-1] for _, pictures, _ in drives]).reshape(-1, 3) / 255
    np.testing.assert_allclose(np.ravel(stats[CAMERA]["mean"]), colors.mean(0))
    np.testing.assert_allclose(np.ravel(stats[CAMERA]["std"]), colors.std(0))
    assert np.shape(stats[CAMERA]["max"]) == (3, 1, 1) and stats[CAMERA]["count"] == [sum(LENGTHS) - 2]


def test_info_describes_every_column(written):
    folder, _ = written
    info = read_json(folder / "meta/info.json")
    assert info["codebase_version"] == "v3.0" and info["fps"] == 10
    assert info["features"]["action"]["names"] == list(ACTIONS)
    assert info["twin"]["action_range"] == {name: list(ends) for name, ends in ACTIONS.items()}
    assert (info["total_episodes"], info["total_frames"]) == (2, sum(LENGTHS) - 2)
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    assert set(info["features"]) == {*rows.column_names, CAMERA}
    for name in rows.column_names:
        feature, kind = info["features"][name], rows.schema.field(name).type
        vector = isinstance(kind, pyarrow.FixedSizeListType)
        assert feature["shape"] == ([kind.list_size] if vector else [1])
        assert pyarrow.type_for_alias(feature["dtype"]) == (kind.value_type if vector else kind)
    index = json.loads(parquet.read_schema(folder / "meta/tasks.parquet").metadata[b"pandas"])["index_columns"]
    assert index == ["task"] and table(folder, "meta/tasks.parquet") == {"task_index": [0], "task": ["Drive."]}


def test_what_a_film_cannot_hold_is_refused(tmp_path):
    with pytest.raises(InputError, match="even width and height"):
        DriveDataset(tmp_path, (63, 36), 0.1, ACTIONS, "Drive.")
    with pytest.raises(InputError, match="needs a whole number"):
        DriveDataset(tmp_path, SIZE, 0.15, ACTIONS, "Drive.")


def test_lerobot_reads_it(written):
    reader = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot is not installed")
    folder, drives = written
    dataset = reader.LeRobotDataset("twin/drives", root=folder, video_backend="pyav")
    assert len(dataset) == sum(LENGTHS) - 2
    for i in range(len(dataset)):
        item = dataset[i]
        assert item["index"].item() == i and item["task"] == "Drive."
        number, frame = item["episode_index"].item(), item["frame_index"].item()
        assert (number, frame) == ((0, i) if i < LENGTHS[0] - 1 else (1, i - LENGTHS[0] + 1))
        assert item["timestamp"].item() == np.float32(frame / 10)
        episode, pictures, motion = drives[number]
        np.testing.assert_array_equal(item["observation.state"].numpy(), np.float32(motion[frame]))
        np.testing.assert_array_equal(item["action"].numpy(), np.float32(episode.actions[frame]))
        shown = item[CAMERA].numpy().transpose(1, 2, 0) * 255
        assert np.abs(shown - pictures[frame]).mean() < 2.0


def test_drives_are_read_back_as_an_environment_takes_them(written, tmp_path):
    """Actions are scaled to [-1, 1]; pictures are within the video's loss; every drive begins with frame 0."""
    folder, drives = written
    pictures, actions, frame = read_drives(folder)
    shown = np.concatenate([one[1][:-1] for one in drives]).astype(float)
    assert pictures.shape == shown.shape and np.abs(pictures - shown).mean() < 2.0
    given = np.concatenate([episode.actions[:-1] for episode, _, _ in drives])
    assert np.allclose(actions[:, 0], given[:, 0] / 0.4 - 1.0, atol=1e-5)  # 0 to 0.8 m/s
    assert np.allclose(actions[:, 1], given[:, 1] / 0.5, atol=1e-5)  # -0.5 to 0.5 rad/s
    assert frame.tolist() == [*range(LENGTHS[0] - 1), *range(LENGTHS[1] - 1)]
    with pytest.raises(InputError, match=r"info\.json"):
        read_drives(tmp_path)
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / f"videos/{CAMERA}/chunk-000/file-001.mp4").unlink()
    with pytest.raises(InputError, match="11 pictures and 17 actions; expected 17 of each"):
        read_drives(copy)
    whole = read_json(copy / "meta/info.json")
    for twin in (None, {"action_range": 3}, {"action_range": {"angular_velocity": [-1.0, 1.0]}}):
        (copy / "meta/info.json").write_text(json.dumps(whole | {"twin": twin}))
        with pytest.raises(InputError, match="expected a dataset of twin film"):
            read_drives(copy)
