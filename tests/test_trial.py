"""Trials on the road: a bag of an episode is judged as the episode was, replays to its path, and joins real.csv."""

import json
import re
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from films import video_info
from picture_bag import CAMERA_INFO, MESSAGES, START, TYPES, Recorded, camera_info, command, image, odometry, write
from scipy.spatial.transform import Rotation
from test_policy import some_weights
from tiny_twin import tiny_twin

import twin
from twin import commands, trial
from twin.capture.bag_film import read_contents
from twin.commands import parser_of
from twin.config import CAUSES
from twin.env.env_factory import EnvFactory
from twin.errors import InputError
from twin.evaluation.trial_judge import view
from twin.evaluation.trials import Cell, Trial, read_results, read_trials
from twin.learn.policy import Control, load_policy, save_policy
from twin.learn.policy_network import Architecture
from twin.nerf.lightings import Fog
from twin.report.drive_dataset import write_bag_dataset
from twin.report.video_writer import read_frames
from twin.robot import PixelCamera
from twin.sysid.trial_recording import fit_frame, read_trial

STEP = 100_000_000  # [ns]
SMALL = Architecture((64, 36), 2, 1, ((4, 8, 8),), 8, (8,), 1)


def drive(scene: Path, name: str, turn: float) -> list[Recorded]:
    """Saves a policy that turns by about `turn` [rad/s] and drives an episode; returns what a robot records."""
    weights = some_weights(SMALL)
    weights["mean.weight"] *= 0.05
    weights["mean.bias"][:] = np.arctanh(turn)
    world = twin.load_scene(scene).world()
    camera = world.camera.resized(SMALL.size)
    save_policy(scene / "runs" / name, SMALL, Control(), weights, {"camera": list(camera.intrinsics)})
    policy = load_policy(scene / "runs" / name)
    options = policy.options() | {"start_offset": 0.1, "start_heading": 2.0}
    environment = twin.load(scene, "ahead", seed=1, lighting="day", **options)
    step, k = environment.reset(), 0
    messages = [camera_info(camera.intrinsics, SMALL.size, START - STEP)]
    while True:
        stamp = START + k * STEP
        messages.append(odometry(environment.physics.base_to_world, stamp))
        if step.last():
            break
        pixels = step.observation["pixels"]
        messages.append(image(pixels[-1], stamp))
        stack = pixels.transpose(0, 3, 1, 2).reshape(policy.stack * 3, *SMALL.size[::-1])
        v, yaw_rate = policy.command(policy(stack))
        messages.append(command(v, yaw_rate, stamp))
        step, k = environment.step([yaw_rate]), k + 1
    messages.append(_outcome(environment.task.cause, environment.task.progress, k))
    return messages


def _outcome(cause: str, progress: float, steps: int) -> Recorded:
    """The episode's truth, which a robot does not record, beside the bag."""
    return Recorded("", "", (cause, progress, steps), 0)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> tuple[Path, dict[str, list[Recorded]]]:
    scene = tiny_twin(tmp_path_factory.mktemp("trials") / "tiny")
    return scene, {name: drive(scene, name, turn) for name, turn in (("ahead", 0.0), ("left", 0.9))}


def bag_of(messages: list[Recorded], folder: Path) -> Path:
    return write(folder, [one for one in messages if one.topic])


@pytest.mark.parametrize("name", ["ahead", "left"])
def test_a_bag_of_an_episode_is_judged_as_the_episode_was(place, tmp_path, name, capsys):
    scene, drives = place
    cause, progress, steps = drives[name][-1].message
    assert cause == {"ahead": "goal", "left": "out_of_bounds"}[name]
    out, bag = tmp_path / "real.csv", bag_of(drives[name], tmp_path / "monday")
    given = ["--policy", name, "--task", "ahead", "--lighting", "day", "--frame", "scene", "--out", str(out)]
    assert commands.main("trial", [str(scene), str(bag), *given]) == 0
    printed = capsys.readouterr().out
    assert f"{name}, ahead, day: {cause} after {progress:.1f} m and {steps * 0.1:.1f} s" in printed
    assert f"counted in {out}\n" in printed
    (row,) = read_trials(tmp_path / "real_trials.csv")
    assert (row.cause, row.steps, row.policy) == (cause, steps, name)
    assert row.progress == pytest.approx(progress, abs=1e-3)
    (cell,) = read_results([out], [Cell(name, "ahead", "day", 20, 10)])
    assert (cell.trials, cell.successes) == (1, int(cause == "goal"))
    folder = Path(printed.splitlines()[-1].removeprefix("look at ")).parent
    figures = json.loads((folder / "trial.json").read_text())
    assert figures["policy"] == {"commands": steps, "same": 1.0, "v_rms": 0.0, "yaw_rate_rms": 0.0}
    # The replay settles on the ground again, and pictures are rendered from a robot at rest.
    assert figures["replay"]["end_m"] < 0.02 and abs(figures["replay"]["end_deg"]) < 1.0
    assert figures["pictures"]["psnr_median"] > 33.0 and figures["pictures"]["lighting"] == "day"
    film = video_info(folder / "trial.mp4")
    assert film["fps"] == 10.0 and film["frames"] >= steps


@pytest.mark.parametrize("same", [0.3, 0.9])
def test_a_trial_that_another_policy_drove_gets_a_caution(same):
    figures = {
        "seconds": 3.0,
        "cross_track_max_m": 0.1,
        "start": {"along_m": 0.1 + 2.0 * same, "cross_track_m": 0.0, "heading_deg": 0.0},
        "frame": {"located": 0},
        "replay": {"after_2_s_m": None, "end_m": 0.1, "end_deg": 0.0},
        "pictures": {"lighting": "day", "psnr_median": 30.0, "psnr_matched_median": 31.0, "trust_mean": 1.0},
        "policy": {"commands": 30, "same": same, "yaw_rate_rms": 0.1},
    }
    text = trial.summary(Trial("first", "ahead", "day", 0, "goal", 3.0, 30), figures)
    assert ("caution: was it first that drove?" in text) == (same < 0.5)
    assert ("caution: it started +1.9 m along the task" in text) == (same == 0.9)


def test_bags_become_a_dataset_with_what_the_robot_saw_and_was_told(place, tmp_path, capsys):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    scene, drives = place
    bags, out = [str(bag_of(drives[name], tmp_path / name)) for name in ("ahead", "left")], tmp_path / "drives"
    given = ["--policy", "ahead", "--task", "ahead", "--lighting", "monday", "--frame", "scene", "--lerobot", str(out)]
    assert commands.main("trial", [str(scene), *bags, *given]) == 0
    counts = [drives[name][-1].message[2] for name in ("ahead", "left")]
    assert f"2 drives, 1 to the goal, {sum(counts)} frames: {out}" in capsys.readouterr().out
    rows = parquet.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
    sent = [_column(drives[name], "/cmd_vel", lambda m: (m.twist.linear.x, m.twist.angular.z)) for name in drives]
    np.testing.assert_allclose(rows["action"], np.concatenate(sent), atol=1e-6)
    where = [
        _column(drives[name], "/odom", lambda m: (m.pose.pose.position.x, m.pose.pose.position.y))[:-1]
        for name in drives
    ]
    np.testing.assert_allclose(np.array(rows["observation.environment_state"])[:, :2], np.concatenate(where), atol=1e-5)
    for (start, end), places in zip(((0, counts[0]), (counts[0], sum(counts))), where, strict=True):
        moved = np.linalg.norm(places[2:] - places[:-2], axis=1) / 0.2
        np.testing.assert_allclose(np.array(rows["observation.state"])[start + 2 : end, 0], moved, atol=0.02)
    assert np.flatnonzero(rows["next.success"]).tolist() == [counts[0] - 1]
    last = np.flatnonzero(rows["next.done"])
    assert last.tolist() == [counts[0] - 1, sum(counts) - 1]
    np.testing.assert_allclose(np.array(rows["next.reward"])[last], [0.1, -5.0], atol=1e-6)
    episodes = parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["twin.cause"] == ["goal", "out_of_bounds"] and episodes["twin.lighting"] == ["monday"] * 2
    for k, name in enumerate(drives):
        saw = [one.message for one in drives[name] if one.topic == "/camera/image"]
        saw = [one.data.reshape(one.height, one.step)[:, : 3 * one.width].reshape(one.height, -1, 3) for one in saw]
        frames = list(read_frames(out / f"videos/observation.images.front/chunk-000/file-{k:03d}.mp4"))
        assert len(frames) == counts[k]
        error = _luma_error(frames, saw)
        # The codec halves the resolution of colors, which are strong here. A frame's neighbors are twice as far off.
        assert error < 4.0 and error < 0.6 * min(_luma_error(frames, saw[1:]), _luma_error(frames[1:], saw))
    assert not (scene / "real.csv").exists()


def test_a_drive_by_hand_needs_no_policy_and_no_outcome(place, tmp_path):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    scene, drives = place
    cut = [one for one in drives["ahead"] if one.topic and one.stamp < START + 20 * STEP]
    fast = [command(0.5, 0.1, one.stamp + STEP // 2) for one in cut if one.topic == "/cmd_vel"]
    few = [one for one in fast if one.stamp < START + 10 * STEP]  # then the operator lets go
    given = [one for one in cut if one.topic != "/cmd_vel"]
    bag = write(tmp_path / "by_hand", [*given, *few, *[command(0.3, -0.1, one.stamp + 7) for one in few]])
    (drive,) = write_bag_dataset(scene, [bag], tmp_path / "drives", "ahead", frame="scene")
    assert drive.cause == "" and not drive.success
    np.testing.assert_allclose(drive.actions[:9], np.tile([0.4, 0.0], (9, 1)))
    np.testing.assert_allclose(drive.actions[10:14], np.tile([0.3, -0.1], (4, 1)))
    assert not drive.actions[16:].any()
    info = json.loads((tmp_path / "drives/meta/info.json").read_text())
    assert info["features"]["observation.images.front"]["shape"] == [90, 160, 3]
    assert info["twin"]["action_range"] == {"linear_velocity": [0.0, 1.0], "angular_velocity": [-1.0, 1.0]}
    (drive,) = write_bag_dataset(scene, [bag], tmp_path / "hit", "ahead", cause="collision", frame="scene")
    assert drive.cause == "collision" and drive.rewards[-1] == -4.0
    gap = [one for one in cut if "image" not in one.topic or not START + STEP < one.stamp < START + 9 * STEP]
    with pytest.raises(
        InputError, match=r"0\.8 s after the first command, the nearest picture on /camera/image is 0\.7 s away"
    ):
        write_bag_dataset(scene, [write(tmp_path / "gap", gap)], tmp_path / "none", "ahead", frame="scene")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["a", "b", "--policy", "ahead", "--lighting", "day"],
            "2 bags: expected the bag of one trial; for several, use --lerobot DIR",
        ),
        (["a", "--lighting", "day"], "a trial needs --policy; without a policy, --lerobot DIR records"),
        (["a", "--policy", "ahead"], "a trial needs --lighting"),
        (["a", "b", "--lerobot", "out", "--cause", "stuck"], "--cause stuck applies to one bag; there are 2"),
        (["a", "--lerobot", "out", "--out", "real.csv"], "--out and --twin-lighting are for real.csv"),
    ],
)
def test_options_that_contradict_each_other_are_refused_in_one_line(place, options, words, capsys):
    assert commands.main("trial", [str(place[0]), *options, "--task", "ahead", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


def _luma_error(shown: list[np.ndarray], wanted: list[np.ndarray]) -> float:
    """Mean difference of brightness, picture by picture."""
    pairs = zip(shown, wanted, strict=False)
    return float(np.mean([np.abs((a.astype(float) - b) @ [0.299, 0.587, 0.114]).mean() for a, b in pairs]))


def _column(messages: list[Recorded], topic: str, value) -> np.ndarray:
    return np.array([value(one.message) for one in messages if one.topic == topic])


def test_pictures_are_compared_with_those_of_the_days_photo(place):
    """Its fog is in the twin's pictures, as in those of an episode under this lighting."""
    scene, _ = place
    factory = EnvFactory.open(scene, "ahead", {"size": (64, 36)})
    day, fog = factory.field.embedding("day"), Fog(0.1, (0.9, 0.8, 0.7))
    factory.field.add_lightings({"monday": day}, fogs={"monday": fog})
    camera = PixelCamera((60.0, 60.0, 32.0, 18.0), (64, 36))
    gray = [np.full((36, 64, 3), 100, np.uint8)]
    clear, foggy = (view(factory, np.zeros((1, 3)), gray, camera, name).twin[0] for name in ("day", "monday"))
    sky = np.array([0.9, 0.8, 0.7]) * 255.0
    assert np.abs(foggy[0] - sky).mean() < np.abs(clear[0] - sky).mean() - 10.0


def test_trials_add_up_and_a_bag_counts_once(place, tmp_path):
    scene, drives = place
    out = tmp_path / "real.csv"
    later = [replace(one, stamp=one.stamp + 10**12) for one in deepcopy(drives["left"]) if one.topic]
    for one in later:
        one.message.header.stamp.sec += 1000
    bags = [bag_of(drives["ahead"], tmp_path / "a"), write(tmp_path / "b", later)]
    for bag in (bags[0], bags[1], bags[0]):
        trial.evaluate_trial(scene, bag, "ahead", "ahead", "dusk", out, "day+randomised", frame="scene")
    (cell,) = read_results([out], [Cell("ahead", "ahead", "day+randomised", 20, 10)])
    assert (cell.trials, cell.successes, cell.lighting) == (2, 1, "dusk")


def test_a_trial_with_a_corrected_name_counts_once(place, tmp_path):
    scene, drives = place
    out = tmp_path / "real.csv"
    bag = bag_of(drives["ahead"], tmp_path / "a")
    moved = tmp_path / "archive" / bag.name
    for lighting in ("mondy", "monday"):
        trial.evaluate_trial(scene, bag, "ahead", "ahead", lighting, out, "day+randomised", frame="scene")
        if lighting == "mondy":  # the bag is known wherever it lies
            moved.parent.mkdir()
            bag = bag.rename(moved)
    assert [line.split(",")[1:3] for line in out.read_text().splitlines()[1:]] == [["monday", "1"]]
    with pytest.raises(InputError, match=r"are compared with 'day\+randomised', not with 'held-out'"):
        trial.evaluate_trial(scene, bag, "ahead", "ahead", "monday", out, "held-out", frame="scene")
    _, figures, _ = trial.evaluate_trial(scene, bag, "ahead", "ahead", "monday", out, frame="scene")
    assert figures["twin_lighting"] == "day+randomised"
    before = out.read_bytes()
    with pytest.raises(InputError, match="'dya': unknown; did you mean 'day'"):  # before the bag is read
        trial.evaluate_trial(scene, tmp_path / "none", "ahead", "ahead", "dusk", out, "dya", frame="scene")
    assert out.read_bytes() == before


def test_bags_of_the_same_name_have_folders_of_their_own(place, tmp_path):
    scene, drives = place
    later = [replace(one, stamp=one.stamp + 10**12) for one in deepcopy(drives["ahead"]) if one.topic]
    for one in later:
        one.message.header.stamp.sec += 1000
    (tmp_path / "tuesday").mkdir()
    bags = [bag_of(drives["ahead"], tmp_path / "run"), write(tmp_path / "tuesday" / "run", later)]
    out = tmp_path / "real.csv"
    folders = [
        trial.evaluate_trial(scene, bag, "ahead", "ahead", "dusk", out, "day+randomised", frame="scene")[2]
        for bag in (*bags, *bags)
    ]
    assert folders[:2] == folders[2:] and folders[0] != folders[1]


def test_trials_of_two_policies_that_start_at_once_both_count(place, tmp_path):
    scene, drives = place
    out = tmp_path / "real.csv"
    for name in ("ahead", "left"):
        trial.evaluate_trial(
            scene, bag_of(drives[name], tmp_path / name), name, "ahead", "dusk", out, "day+randomised", frame="scene"
        )
    assert [line.split(",")[:3] for line in out.read_text().splitlines()[1:]] == [
        ["ahead", "dusk", "1"],
        ["left", "dusk", "1"],
    ]


def test_a_table_written_by_hand_is_not_lost(place, tmp_path):
    scene, drives = place
    out = tmp_path / "real.csv"
    out.write_text("policy,lighting,trials,successes\nahead,day,10,8\n")
    with pytest.raises(
        InputError, match=r"10 trials of ahead under day, but real_trials\.csv has 0 of them; give another"
    ):
        trial.evaluate_trial(
            scene, bag_of(drives["ahead"], tmp_path / "bag"), "ahead", "ahead", "day", out, frame="scene"
        )
    assert out.read_text().endswith("10,8\n")


def test_the_operator_says_what_poses_do_not_show(place, tmp_path):
    scene, drives = place
    cut = [one for one in drives["ahead"] if one.topic and one.stamp < START + 20 * STEP]
    bag, out = write(tmp_path / "cut", cut), tmp_path / "real.csv"
    common = (scene, bag, "ahead", "ahead", "day", out)
    with pytest.raises(InputError, match=r"ends after 1\.9 s and \d\.\d m without an outcome; .*--cause collision"):
        trial.evaluate_trial(*common, frame="scene")
    row, _, _ = trial.evaluate_trial(*common, cause="collision", frame="scene")
    assert row.cause == "collision" and not row.success and row.steps == 19
    with pytest.raises(InputError, match="expected a cause of failure"):
        trial.evaluate_trial(*common, cause="goal", frame="scene")
    (action,) = [a for a in parser_of("trial")._actions if a.dest == "cause"]
    assert {"goal", *action.choices} == set(CAUSES)


def _without(topic: str):
    return lambda messages: [one for one in messages if topic not in one.topic]


def _standing(messages: list[Recorded]) -> list[Recorded]:
    return [command(0.0, 0.0, one.stamp) if one.topic == "/cmd_vel" else one for one in messages]


def _scaled(messages: list[Recorded], scale: float) -> list[Recorded]:
    """The messages with the quaternions of all poses multiplied by `scale`."""
    out = deepcopy(messages)
    for one in out:
        if one.topic == "/odom":
            q = one.message.pose.pose.orientation
            for name in ("x", "y", "z", "w"):
                object.__setattr__(q, name, scale * getattr(q, name))
    return out


BAD = {
    "no pictures": (_without("/camera/image"), r"no topic with pictures among /camera/camera_info, /cmd_vel, /odom"),
    "no camera": (_without("camera_info"), r"no topic of sensor_msgs/msg/CameraInfo among"),
    "no poses": (_without("/odom"), r"no topic with poses"),
    "no commands": (_without("/cmd_vel"), r"no topic with commands"),
    "standing": (_standing, r"no command on /cmd_vel moves the robot; record the whole trial"),
    "uncalibrated": (
        lambda m: [camera_info((0.0, 0.0, 0.5, 0.5), (64, 36), START) if o.topic == CAMERA_INFO else o for o in m],
        r"is the camera calibrated",
    ),
    "no orientation": (lambda m: _scaled(m, 0.0), r"/odom: (\d+) of \1 poses have no orientation; .* by --poses"),
    "short": (lambda m: [o for o in m if o.topic != "/odom" or o.stamp <= START], r"1 usable poses; expected many"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_bags_are_refused_in_one_line(place, tmp_path, kind, capsys):
    scene, drives = place
    change, message = BAD[kind]
    bag = write(tmp_path / "bag", change([one for one in drives["ahead"] if one.topic]))
    given = ["--policy", "ahead", "--task", "ahead", "--lighting", "day", "--frame", "scene", "--quiet"]
    assert commands.main("trial", [str(scene), str(bag), *given, "--out", str(tmp_path / "real.csv")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert re.search(message, said), said
    assert not (tmp_path / "real.csv").exists()


@pytest.mark.parametrize(
    ("kind", "topic"), [("pictures", "/odom"), ("camera", "/odom"), ("poses", "/joy_vel"), ("commands", "/odom")]
)
def test_a_topic_of_another_kind_is_refused(kind, topic, tmp_path):
    stamps = [START + k * STEP for k in range(3)]
    twists = [command(0.5, 0.0, stamp) for stamp in stamps]
    messages = [camera_info((30.0, 30.0, 32.0, 18.0), (64, 36), START), image(np.zeros((36, 64, 3), np.uint8), START)]
    messages += [*twists, *(odometry(np.eye(4), stamp) for stamp in stamps)]
    bag = write(tmp_path / "bag", messages + [replace(one, topic="/joy_vel") for one in twists])
    assert len(read_trial(bag).poses) == 3
    with pytest.raises(InputError, match=rf"{topic} \({kind}\) has \w+/msg/\w+; expected \w+/msg/\w+"):
        read_trial(bag, {kind: topic})


@pytest.mark.parametrize("scale", [0.9, 2.0, -1.0])
def test_the_scale_of_a_quaternion_does_not_matter(place, tmp_path, scale):
    messages = [one for one in place[1]["left"] if one.topic]
    true, scaled = (read_trial(write(tmp_path / f"bag_{s}", _scaled(messages, s))) for s in (1.0, scale))
    np.testing.assert_allclose(scaled.poses, true.poses, atol=1e-9)
    np.testing.assert_allclose(scaled.uprightness, true.uprightness, atol=1e-9)
    missing = [_scaled([one], 0.0)[0] if one.stamp // STEP % 3 == 0 else one for one in messages]
    assert 0.5 < len(read_trial(write(tmp_path / "bag", missing)).poses) / len(true.poses) < 0.8


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/front_direct/image_raw", False),
        ("/camera/unrectified", False),
        ("/front/image_rect", True),
        ("/front/image_rect_color/compressed", True),
        ("/front/rectified/image", True),
    ],
)
def test_pictures_are_rectified_if_a_word_of_their_topic_says_so(topic, rectified, tmp_path):
    info = camera_info((50.0, 50.0, 32.0, 18.0), (64, 36), START)
    info.message.distortion_model, info.message.d = "plumb_bob", np.array([-0.1, 0.0, 0.0, 0.0, 0.0])
    info.message.p[[0, 5]] = 40.0
    shown = image(np.zeros((36, 64, 3), np.uint8), START)
    poses = [odometry(np.eye(4), START + k * STEP) for k in range(3)]
    bag = write(tmp_path / "bag", [info, replace(shown, topic=topic), *poses, *_twists([START])])
    camera, lens = read_trial(bag).camera, read_contents(bag).lens
    assert lens is not None and camera.is_distorted == lens.is_distorted == (not rectified)
    assert camera.intrinsics[0] == lens.intrinsics[0] == (40.0 if rectified else 50.0)


def test_a_topic_that_was_published_twice_is_read_whole(tmp_path, capsys):
    """By a node that was started again with messages of another type."""
    stamps = [START + k * STEP for k in range(5)]
    twist = [replace(one, type="geometry_msgs/msg/Twist", message=one.message.twist) for one in _twists(stamps[3:])]
    messages = [camera_info((30.0, 30.0, 32.0, 18.0), (64, 36), START), image(np.zeros((36, 64, 3), np.uint8), START)]
    messages += [*_twists(stamps[:3]), *twist, *(odometry(np.eye(4), stamp) for stamp in stamps)]
    messages += [replace(odometry(np.eye(4), stamp), topic="/platform/odom") for stamp in stamps]
    messages += [replace(odometry(np.eye(4), stamp), topic="/platform/odom/filtered") for stamp in stamps]
    assert len(read_trial(write(tmp_path / "bag", messages)).commands) == 5
    assert "poses /odom, commands /cmd_vel" in capsys.readouterr().err
    some = [one for one in messages if one.topic != "/odom"]
    assert read_trial(write(tmp_path / "some", some)).topics["poses"] == "/platform/odom/filtered"


def _twists(stamps: list[int]) -> list[Recorded]:
    return [command(0.5, 0.0, stamp) for stamp in stamps]


def test_missing_and_foreign_files_are_refused_in_one_line(place, tmp_path):
    with pytest.raises(InputError, match="no such bag"):
        read_trial(tmp_path / "none")
    (tmp_path / "bad.mcap").write_bytes(b"rubbish" * 100)
    with pytest.raises(InputError, match="not a readable bag"):
        read_trial(tmp_path / "bad.mcap")


# ---- frames and clocks


def test_the_frame_of_the_poses_is_found_though_some_pictures_are_misplaced():
    rng = np.random.default_rng(0)
    poses = np.column_stack([np.linspace(0, 12, 24), np.sin(np.linspace(0, 3, 24)), np.linspace(0, 0.5, 24)])
    yaw, shift = 2.3, np.array([40.0, -7.0])
    located = np.column_stack(
        [poses[:, :2] @ Rotation.from_euler("z", yaw).as_matrix()[:2, :2].T + shift, poses[:, 2] + yaw]
    )
    located[:, :2] += rng.normal(0, 0.02, (24, 2))
    located[[3, 11, 17], :2] += [[2.0, -1.0], [0.0, 5.0], [-9.0, 0.0]]
    fit = fit_frame(poses, located, "bag")
    assert fit.located == 21 and fit.residual < 0.04 and fit.yaw == pytest.approx(yaw, abs=0.005)
    assert fit.scale == pytest.approx(1.0, abs=0.005)
    good = np.delete(np.arange(24), [3, 11, 17])
    np.testing.assert_allclose(fit(poses)[good], located[good], atol=0.07)
    bent = poses + np.column_stack([np.zeros(24), np.linspace(-1, 1, 24) ** 2 * 3, np.zeros(24)])
    with pytest.raises(InputError, match=r"differ by \d\.\d+ m .*wheel odometry drifts"):
        fit_frame(bent, located, "bag")
    with pytest.raises(InputError, match="4 pictures were located in the scene"):
        fit_frame(poses[:4], located[:4], "bag")


def test_satellite_fixes_are_metres_and_headings_those_of_motion(tmp_path):
    messages = [camera_info((50.0, 50.0, 32.0, 18.0), (64, 36), START), command(1.0, 0.0, START)]
    earth = 6_378_137.0
    for k in range(60):  # 6 m to the north-east
        stamp, way = START + k * STEP, 0.1 * k / np.sqrt(2)
        messages.append(image(np.zeros((36, 64, 3), np.uint8), stamp))
        status = TYPES["sensor_msgs/msg/NavSatStatus"](0 if k != 30 else -1, 1)
        north, east = np.degrees(way / earth), np.degrees(way / earth / np.cos(np.radians(49.0)))
        fix = TYPES["sensor_msgs/msg/NavSatFix"](
            MESSAGES.header(stamp), status, 49.0 + north, 8.0 + east, 100.0, np.zeros(9), 2
        )
        fix = replace(fix, latitude=0.0, longitude=0.0) if k == 0 else fix  # as before the first fix
        messages.append(Recorded("/gps/fix", "sensor_msgs/msg/NavSatFix", fix, stamp))
    found = read_trial(write(tmp_path / "bag", messages))
    assert found.topics["poses"] == "/gps/fix" and len(found.poses) == 58  # two had no fix
    assert np.linalg.norm(found.poses[-1, :2] - found.poses[0, :2]) == pytest.approx(5.8, abs=0.05)
    np.testing.assert_allclose(found.poses[:, 2], np.pi / 4, atol=0.02)


def test_headers_of_another_clock_are_replaced_by_times_of_recording(place, tmp_path):
    _, drives = place
    messages = [one for one in drives["ahead"] if one.topic]
    shifted = [
        image(np.zeros((36, 64, 3), np.uint8), one.stamp - 10**15, one.stamp) if "image" in one.topic else one
        for one in messages
    ]
    found = read_trial(write(tmp_path / "bag", shifted))
    np.testing.assert_array_equal(found.shutter, found.arrival)
    assert abs(found.shutter[0] - found.pose_times[0]) < STEP


# ---- the played robot


@pytest.mark.slow
def test_the_played_robots_bag_has_what_its_pilot_saw(tmp_path, monkeypatch):
    """The pilot drives on JPEG pictures; the recorded commands are the policy's for the recorded pictures."""
    from test_examples import example

    from twin.reality.recordings import write_robot_bag

    weights = some_weights(SMALL)
    weights["mean.bias"][:] = np.arctanh(0.95)  # leaves the road soon
    save_policy(tmp_path / "left", SMALL, Control(), weights, {})
    row = write_robot_bag(tmp_path / "bag", tmp_path / "left", "straight", "haze", seed=3)
    assert row.cause in ("out_of_bounds", "collision") and row.policy == "left"
    found = read_trial(tmp_path / "bag")
    assert found.camera.size == (640, 360) and len(found.shutter) == len(found.commands) == row.steps + 15
    played = example("play_bag").play(tmp_path / "left", tmp_path / "bag")
    np.testing.assert_array_equal([(command.v, command.yaw_rate) for _, command in played], found.commands)
    assert [time for time, _ in played] == found.arrival.tolist()
    with pytest.raises(InputError, match="exists; give another --out"):
        write_robot_bag(tmp_path / "bag", None, "straight", "haze")
    monkeypatch.setattr("twin.reality.recordings.cv2.imencode", _interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_robot_bag(tmp_path / "cut", None, "straight", "haze")
    assert not (tmp_path / "cut").exists()


def _interrupt(*_):
    raise KeyboardInterrupt
