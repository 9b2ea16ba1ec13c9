"""The pilot: a bag of an episode gives the environment's stacks and commands bit for bit; faults stop the robot."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from picture_bag import CAMERA_INFO, START, camera_info, image, write
from rosbags.highlevel import AnyReader
from test_policy import some_weights
from tiny_twin import tiny_twin

import twin
from twin.learn.policy import Control, Policy, load_policy, save_policy
from twin.learn.policy_network import Architecture
from twin_policy import Camera, CompressedPicture, Limits, OnnxPolicy, Pilot, RawPicture
from twin_policy.pilot import DEADMAN, WAITING

MS = 1_000_000  # [ns]
STEP = 100 * MS
WHOLE = Architecture(convolutions=((4, 8, 8),), features=8, hidden=(8,))
SMALL = Architecture((32, 18), 4, 1, ((4, 5, 4),), 8, (8,), 2)
LENS = Camera(SMALL.size, (20.0, 20.0, 16.0, 9.0))


class Clock:
    """Two clocks that run together until one is set."""

    def __init__(self) -> None:
        self.true, self.offset = 0, START

    def steady(self) -> int:
        return self.true

    def now(self) -> int:
        return self.true + self.offset


def small_policy(folder: Path, control: Control | None = None, trained: dict | None = None) -> OnnxPolicy:
    save_policy(folder, SMALL, control or Control("twist"), some_weights(SMALL), trained or {})
    return OnnxPolicy(folder)


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> OnnxPolicy:
    return small_policy(tmp_path_factory.mktemp("policy"))


def pilot_of(policy: OnnxPolicy, **limits) -> tuple[Pilot, Clock]:
    clock = Clock()
    pilot = Pilot(policy, Limits(**limits), clock=clock.now, steady=clock.steady)
    pilot.set_camera(LENS)
    return pilot, clock


PICTURES = np.random.default_rng(0).integers(0, 256, (128, 18, 32, 3), np.uint8)


def picture(k: int) -> np.ndarray:
    return PICTURES[k]


def drive(pilot: Pilot, clock: Clock, count: int, first: int = 0) -> None:
    """Shows pictures, 0.1 s apart and 30 ms old; ends 30 ms after the last one was taken."""
    for k in range(first, first + count):
        clock.true = k * STEP + 30 * MS
        stamp = clock.now() - 30 * MS
        command = pilot.picture(picture(k), stamp)
        assert command.drives and command.stamp == stamp, (k, command)


# ---- the environment, through a bag


@pytest.fixture(scope="module")
def episode(tmp_path_factory) -> tuple[Path, Policy, list[np.ndarray], list[tuple[float, float]]]:
    """Scene, policy, and an episode's stacks and commands, driven by the policy in the environment."""
    scene = tiny_twin(tmp_path_factory.mktemp("scenes") / "tiny")
    weights = some_weights(WHOLE)
    weights["mean.weight"] *= 0.3  # otherwise the hyperbolic tangent is always 1
    world = twin.load_scene(scene).world()
    save_policy(scene / "runs" / "a", WHOLE, Control(), weights, {"camera": list(world.intrinsics)})
    policy = load_policy(scene / "runs" / "a")
    environment = twin.load(scene, "bend", seed=3, lighting="day", **policy.options())
    step, stacks, commands = environment.reset(), [], []
    while not step.last() and len(stacks) < 25:
        stack = step.observation["pixels"].transpose(0, 3, 1, 2).reshape(12, 90, 160)
        stacks.append(stack)
        commands.append(policy.command(policy(stack)))
        step = environment.step([commands[-1][1]])
    assert len(stacks) > 10 and np.ptp([yaw_rate for _, yaw_rate in commands]) > 1e-3
    return scene, policy, stacks, commands


def recorded(episode, encoding: str) -> list:
    """The messages of a camera with 60 ms latency, and camera_info, which is of the front camera."""
    scene, _, stacks, _ = episode
    intrinsics = twin.load_scene(scene).world().intrinsics
    messages = [camera_info(intrinsics, (160, 90), START - 1)]
    for k, stack in enumerate(stacks):
        stamp = START + k * STEP
        messages.append(image(stack[-3:].transpose(1, 2, 0), stamp, stamp + 60 * MS, encoding))
    return messages


def play(bag: Path, policy: OnnxPolicy) -> tuple[list[np.ndarray], list, Pilot]:
    """Plays a bag through a pilot as the node does; returns stacks and commands of the used pictures."""
    clock = Clock()
    pilot = Pilot(policy, Limits(), clock=clock.now, steady=clock.steady)
    stacks, commands = [], []
    with AnyReader([bag]) as reader:
        for connection, time, raw in reader.messages():
            clock.true = time - START
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == CAMERA_INFO:
                pilot.set_camera(Camera.from_info(message))
                continue
            fields = (getattr(message, name, None) for name in ("encoding", "width", "height", "step", "data"))
            shown = CompressedPicture(message.data) if hasattr(message, "format") else RawPicture(*fields)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            command = pilot.picture(shown, stamp)
            if command.stamp == stamp:
                stacks.append(pilot.stack.reshape(policy.stack_shape).copy())
                commands.append((command.v, command.yaw_rate))
    return stacks, commands, pilot


@pytest.mark.parametrize(("mcap", "encoding"), [(True, "rgb8"), (False, "bgra8"), (True, "png")])
def test_a_bag_gives_the_environments_stacks_and_the_policys_commands(episode, tmp_path, mcap, encoding):
    scene, _, stacks, commands = episode
    bag = write(tmp_path / "bag", recorded(episode, encoding), mcap)
    found, given, pilot = play(bag, OnnxPolicy(scene / "runs" / "a"))
    assert pilot.counts == {"used": len(stacks)}
    np.testing.assert_array_equal(found, stacks)  # so pictures reach the policy unchanged
    assert given == commands  # bit for bit


def test_without_onnx_runtime_the_error_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ValueError, match="ONNX Runtime is not installed"):
        OnnxPolicy(tmp_path)


def test_a_faster_camera_gives_the_same(episode, tmp_path):
    """Two thirds of a camera's pictures at 30 Hz fall between control steps, and never reach the policy."""
    scene, _, stacks, commands = episode
    messages = recorded(episode, "rgb8")
    for k in range(len(stacks) - 1):
        for third in (33, 67):
            stamp = START + k * STEP + third * MS
            messages.append(image(np.zeros((90, 160, 3), np.uint8), stamp, stamp + 60 * MS))
    found, given, pilot = play(write(tmp_path / "bag", messages), OnnxPolicy(scene / "runs" / "a"))
    assert pilot.counts == {"used": len(stacks), "between": 2 * (len(stacks) - 1)}
    np.testing.assert_array_equal(found, stacks)
    assert given == commands


def test_twist_policies_mean_the_same_as_in_twin(tmp_path):
    ours = small_policy(tmp_path, Control("twist", 0.8, 0.7, 0.1))
    theirs = load_policy(tmp_path)
    for k in range(20):
        stack = np.random.default_rng(k).integers(0, 256, ours.stack_shape, np.uint8)
        assert ours.command(stack) == theirs.command(theirs(stack))


# ---- pictures that are not as they should be


def test_nothing_drives_before_the_first_picture(policy):
    pilot, clock = pilot_of(policy)
    assert pilot.command().cause == WAITING
    bare = Pilot(policy, clock=clock.now, steady=clock.steady)
    assert "no camera_info" in bare.picture(picture(0), clock.now()).cause
    bare.set_camera(LENS)
    assert bare.picture(picture(0), clock.now()).drives  # a missing camera_info causes no rest


def test_the_first_picture_fills_the_stack(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 2)
    shown = [picture(k).transpose(2, 0, 1) for k in (0, 0, 0, 1)]
    np.testing.assert_array_equal(pilot.stack, shown)


def test_the_robot_stops_in_time_when_pictures_cease(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 5)
    taken = clock.true - 30 * MS
    clock.true = taken + 300 * MS
    assert pilot.command().drives
    clock.true += MS
    command = pilot.command()
    assert (command.v, command.yaw_rate) == (0.0, 0.0) and "newest picture is 0.30 s old" in command.cause
    clock.true = taken + 500 * MS
    assert not pilot.picture(picture(5), clock.now()).drives  # it rests
    clock.true += 1000 * MS
    assert pilot.picture(picture(6), clock.now()).drives
    np.testing.assert_array_equal(pilot.stack, [picture(6).transpose(2, 0, 1)] * 4)  # as at the start of an episode


def test_one_lost_picture_is_tolerated_and_counted(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 4)
    drive(pilot, clock, 4, first=5)
    assert pilot.counts == {"used": 8, "lost": 1}


def test_doubled_and_reordered_pictures_are_left_out(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 5)
    before, command = pilot.stack.copy(), pilot.command()
    clock.true += 10 * MS
    assert pilot.picture(picture(99), command.stamp) == command
    assert pilot.picture(picture(99), command.stamp - STEP) == command
    np.testing.assert_array_equal(pilot.stack, before)
    assert pilot.counts == {"used": 5, "doubled": 1, "reordered": 1}


def test_late_pictures_do_not_drive(policy):
    pilot, clock = pilot_of(policy)
    for k in range(10):
        clock.true = k * STEP
        command = pilot.picture(picture(k), clock.now() - 400 * MS)
        assert not command.drives and "0.40 s old" in command.cause
    assert pilot.counts == {"late": 10}
    clock.true += STEP
    assert pilot.picture(picture(10), clock.now() - 30 * MS).drives


@pytest.mark.parametrize(
    ("bad", "cause"),
    [
        (np.zeros((90, 160, 3), np.uint8), r"picture (90, 160, 3) uint8; expected 18 x 32 px"),
        (np.zeros((18, 32), np.uint8), r"expected 18 x 32 px"),
        (np.zeros(5, np.uint8), r"expected 18 x 32 px"),
        (RawPicture("rgb8", 32, 18, 96, bytes(100)), r"has 100 bytes"),
        (CompressedPicture(b"rubbish"), r"neither a JPEG nor a PNG"),
    ],
)
def test_bad_pictures_stop_it(policy, bad, cause):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 5)
    clock.true += STEP
    command = pilot.picture(bad, clock.now())
    assert not command.drives and cause in command.cause
    assert pilot.counts["refused"] == pilot.counts["stops"] == 1


@pytest.mark.parametrize("jump", [-3600.0, -0.1, 0.1, 3600.0])
def test_a_jump_of_the_clock_stops_it(policy, jump):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 5)
    clock.offset += round(jump * 1e9)
    assert f"the clock jumped by {jump:+.2f} s" in pilot.command().cause
    clock.true += 1100 * MS
    assert pilot.picture(picture(6), clock.now()).drives


def test_simulated_time_that_begins_anew_stops_it(policy):
    """As when a bag is played in a loop, or a simulation is reset."""
    clock = Clock()
    pilot = Pilot(policy, Limits(deadman=0.5), clock=clock.now, steady=clock.now)
    pilot.set_camera(LENS)
    clock.true = 3600 * 1000 * MS
    pilot.press()
    assert pilot.picture(picture(0), clock.now()).drives
    clock.true = 0
    assert "the clock jumped by -3600.00 s" in pilot.command().cause
    clock.true = 1100 * MS
    assert pilot.picture(picture(1), clock.now()).cause == DEADMAN  # its last message is too old by now
    pilot.press()
    assert pilot.picture(picture(1), clock.now()).drives


def test_stamps_from_the_future_stop_it(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 5)
    clock.true += STEP
    assert "0.20 s ahead of the clock" in pilot.picture(picture(5), clock.now() + 200 * MS).cause


class Network:
    """Stands in for ONNX Runtime's session: returns given values after a given time."""

    def __init__(self, session, clock: Clock) -> None:
        self._session, self._clock, self.takes, self.output = session, clock, 0, None

    def run(self, *given):
        self._clock.true += self.takes
        if isinstance(self.output, Exception):
            raise self.output
        return self._session.run(*given) if self.output is None else [self.output]


BAD_OUTPUTS = {
    "nan": np.array([[np.nan, 0.0]], np.float32),
    "inf": np.array([[0.0, -np.inf]], np.float32),
    "shape": np.zeros((1, 3), np.float32),
    "error": RuntimeError("out of memory\nin some kernel"),
}


@pytest.mark.parametrize("kind", BAD_OUTPUTS)
def test_outputs_that_are_no_action_stop_it(tmp_path, kind):
    pilot, clock = pilot_of(small_policy(tmp_path))
    pilot.policy._session = Network(pilot.policy._session, clock)
    drive(pilot, clock, 3)
    pilot.policy._session.output = BAD_OUTPUTS[kind]
    clock.true += STEP
    command = pilot.picture(picture(3), clock.now())
    assert not command.drives and "\n" not in command.cause and command.cause


def test_slow_inference_stops_it(tmp_path):
    pilot, clock = pilot_of(small_policy(tmp_path))
    pilot.policy._session = network = Network(pilot.policy._session, clock)
    network.takes = 90 * MS
    drive(pilot, clock, 3)
    network.takes = 110 * MS
    clock.true += 10 * MS
    assert "inference took 0.110 s" in pilot.picture(picture(3), clock.now()).cause
    loose, clock = pilot_of(small_policy(tmp_path), inference=1.0)
    loose.policy._session = network = Network(loose.policy._session, clock)
    network.takes = 310 * MS  # its picture is too old when the command is ready
    assert "newest picture is 0.31 s old" in loose.picture(picture(0), clock.now()).cause


def test_a_released_deadman_switch_stops_the_robot(policy):
    pilot, clock = pilot_of(policy, deadman=0.5)
    assert pilot.picture(picture(0), clock.now()).cause == DEADMAN
    pilot.press()
    drive(pilot, clock, 4)  # no rest is needed, since the robot has not moved
    pilot.press(False)
    assert pilot.command().cause == DEADMAN
    pilot.press()
    clock.true += STEP
    assert not pilot.picture(picture(4), clock.now()).drives  # the robot comes to rest first
    clock.true += 1000 * MS
    pilot.press()
    assert pilot.picture(picture(5), clock.now()).drives
    clock.true += 200 * MS
    assert pilot.picture(picture(6), clock.now()).drives
    clock.true += 301 * MS  # no message of the switch for longer than it holds
    assert pilot.picture(picture(7), clock.now()).cause == DEADMAN


def test_a_held_deadman_switch_is_not_the_cause_of_a_stop(policy):
    pilot, _ = pilot_of(policy, deadman=0.5)
    assert pilot.command().cause == DEADMAN
    pilot.press()
    assert pilot.command().cause == WAITING


def test_without_a_deadman_switch_its_messages_have_no_effect(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 3)
    for held in (True, False):
        pilot.press(held)
        assert pilot.command().drives


def test_a_new_calibration_stops_it_and_the_old_one_does_not(policy):
    pilot, clock = pilot_of(policy)
    drive(pilot, clock, 3)
    pilot.set_camera(Camera(LENS.size, LENS.intrinsics))
    assert pilot.command().drives
    pilot.set_camera(Camera(LENS.size, (20.5, 20.5, 16.0, 9.0)))
    assert "calibration changed" in pilot.command().cause


# ---- a thousand faulty drives


_DURATION = 2000 * MS


def faulty_drive(policy: OnnxPolicy, network: Network, clock: Clock, seed: int) -> tuple[int, int]:
    """Two seconds of a camera, a network and a clock with faults of every kind; returns commands and stops.

    Checks every output, upon pictures and by the watchdog at 20 Hz, against the true time at which the newest picture
    was taken, which the pilot does not know.
    """
    rng = np.random.default_rng(seed)
    clock.true, clock.offset = int(rng.integers(0, 10**12)), START
    network.output, network.takes = None, 0
    pilot = Pilot(policy, Limits(deadman=0.5, rest=0.4), clock=clock.now, steady=clock.steady)
    pilot.set_camera(LENS)
    events: list[tuple[int, str, object, int]] = []  # true time, kind, what, stamp of a picture less the clock's offset
    begin, period = clock.true, int(rng.choice([33, 50, 100])) * MS
    for k in range(_DURATION // period):
        taken = begin + k * period + int(rng.integers(0, 10 * MS))
        arrives = taken + int(rng.integers(5, 80)) * MS
        shown: object = picture(k)
        fate = rng.choice(["fine", "lost", "late", "doubled", "size", "rubbish", "stamp"], p=[0.86, 0.06, *[0.016] * 5])
        if fate == "lost":
            continue
        if fate == "late":  # and reordered
            arrives += int(rng.integers(100, 900)) * MS
        if fate == "size":
            shown = np.zeros((9, 32, 3), np.uint8)
        if fate == "rubbish":
            shown = CompressedPicture(rng.bytes(40))
        stamp = taken + (int(rng.integers(-5000, 5000)) * MS if fate == "stamp" and rng.random() < 0.3 else 0)
        events.append((arrives, "picture", (shown, taken if stamp == taken else None), stamp))
        if fate == "doubled":
            events.append((arrives + 3 * MS, "picture", (shown, taken), stamp))
    events += [(begin + k * 50 * MS, "watch", None, 0) for k in range(50)]
    held = begin + int(rng.integers(0, 2000)) * MS if rng.random() < 0.2 else begin + 10**10
    events += [
        (t, "press", None, 0) for t in range(begin, begin + _DURATION, 100 * MS) if not held < t < held + STEP * 7
    ]
    for _ in range(int(rng.integers(0, 3))):
        events.append(
            (
                begin + int(rng.integers(0, 2000)) * MS,
                "jump",
                int(rng.choice([-1, 1])) * 10 ** int(rng.integers(8, 13)),
                0,
            )
        )
    for _ in range(int(rng.integers(0, 3))):
        events.append((begin + int(rng.integers(0, 2000)) * MS, "network", rng.choice(["slow", *BAD_OUTPUTS]), 0))
    taken_at: dict[int, int | None] = {}
    commands = stops = 0
    for time, kind, what, stamp in sorted(events, key=lambda one: one[0]):
        clock.true = max(clock.true, time)
        if kind == "jump":
            clock.offset += what
            continue
        if kind == "network":
            network.output, network.takes = BAD_OUTPUTS.get(what), int(what == "slow") * int(rng.integers(50, 400)) * MS
            continue
        if kind == "press":
            pilot.press()
            continue
        if kind == "picture":
            shown, taken = what
            taken_at[stamp + clock.offset] = taken
            command = pilot.picture(shown, stamp + clock.offset)
            if network.takes or network.output is not None:
                network.output, network.takes = None, 0
        else:
            command = pilot.command()
        assert np.isfinite([command.v, command.yaw_rate]).all()
        if not command.drives:
            stops += 1
            assert command.v == command.yaw_rate == 0.0 and command.cause and "\n" not in command.cause
            continue
        commands += 1
        assert 0.0 <= command.v <= policy.speed and abs(command.yaw_rate) <= policy.max_yaw_rate
        assert clock.now() - command.stamp <= 0.3e9
        taken = taken_at[command.stamp]
        if taken is not None:  # otherwise its stamp is wrong in a way that no clock can reveal
            assert clock.true - taken <= 0.3e9, (seed, clock.true - taken)
    return commands, stops


def test_a_thousand_faulty_drives_obey_the_safety_rules(tmp_path):
    policy, clock = small_policy(tmp_path), Clock()
    policy._session = network = Network(policy._session, clock)
    results = np.array([faulty_drive(policy, network, clock, seed) for seed in range(1000)])
    assert (results.sum(1) > 60).all() and results[:, 0].mean() > 20 and results[:, 1].mean() > 20


# ---- files and settings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "policy.onnx").unlink(), r"policy\.onnx: no such file; copy the folder"),
        (lambda f: (f / "policy.onnx").write_bytes(b"rubbish"), r"ONNX Runtime cannot load it"),
        (lambda f: (f / "policy.json").write_text("{}"), r"policy\.json: not a policy of twin"),
        (
            lambda f: (f / "policy.json").write_text(
                (f / "policy.json").read_text().replace('"speed": 1.0', '"speed": 2.0')
            ),
            r"policy\.json describes another policy than policy\.onnx; copy the whole folder",
        ),
        (
            lambda f: (f / "policy.json").write_text(
                (f / "policy.json").read_text().replace('"version": 2', '"version": 9')
            ),
            r"version 9; expected 2",
        ),
    ],
)
def test_damaged_policies_get_one_line(tmp_path, change, message):
    save_policy(tmp_path, SMALL, Control("twist"), some_weights(SMALL), {})
    change(tmp_path)
    with pytest.raises(ValueError, match=message) as error:
        OnnxPolicy(tmp_path)
    assert "\n" not in str(error.value)


def test_a_network_of_another_size_than_its_metadata_gets_one_line(tmp_path):
    save_policy(tmp_path, SMALL, Control("twist"), some_weights(SMALL), {})
    (tmp_path / "policy.json").unlink()
    path = tmp_path / "policy.onnx"
    path.write_bytes(path.read_bytes().replace(b'"size": [32, 18]', b'"size": [30, 18]'))
    with pytest.raises(ValueError, match=r"policy\.onnx: its network does not run") as error:
        OnnxPolicy(tmp_path)
    assert "\n" not in str(error.value)


def test_the_onnx_file_alone_suffices(tmp_path):
    policy = small_policy(tmp_path, trained={"camera": [20.0, 20.0, 16.0, 9.0]})
    (tmp_path / "policy.json").unlink()
    alone = OnnxPolicy(tmp_path / "policy.onnx")
    assert alone.camera == policy.camera == LENS
    assert json.loads(json.dumps([alone.size, alone.stack, alone.timestep])) == [[32, 18], 4, 0.1]


@pytest.mark.parametrize(
    ("name", "value"), [("timeout", 0.0), ("timeout", float("nan")), ("early", 0.6), ("rest", -1.0)]
)
def test_limits_are_checked(name, value):
    with pytest.raises(ValueError, match=rf"{name} = "):
        Limits(**{name: value})
