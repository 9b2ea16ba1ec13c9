"""Policy files: saved policies act as their networks; damaged and foreign files are refused in one line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from twin.errors import InputError
from twin.learn.policy import JSON, ONNX, WEIGHTS, Control, load_policy, save_policy
from twin.learn.policy_network import Architecture, average_pool, normalize_colors, onnx_bytes, preprocess

SMALL = Architecture(convolutions=((8, 4, 4), (8, 3, 2)), features=16, hidden=(32, 32))


def some_weights(architecture: Architecture, seed: int = 0) -> dict:
    rng = np.random.default_rng(seed)
    shapes = architecture.shapes().items()
    return {k: rng.normal(0, 1.0 / np.sqrt(np.prod(s[1:]) or 1.0), s).astype(np.float32) for k, s in shapes}


def pictures(n: int, architecture: Architecture = SMALL, seed: int = 1) -> np.ndarray:
    width, height = architecture.size
    return np.random.default_rng(seed).integers(0, 256, (n, architecture.channels, height, width), np.uint8)


def naive(a: Architecture, w: dict, stack: np.ndarray) -> np.ndarray:
    """The network's output, one stack at a time, in float64."""
    height, width = stack.shape[1:]
    x = stack.reshape(-1, height // a.pool, a.pool, width // a.pool, a.pool).astype(float).mean((2, 4))
    x = np.floor(x + 0.5)
    for channel in x:
        ground = channel[len(channel) // 2 :]
        channel[:] = 128.0 + 48.0 * (channel - ground.mean()) / (ground.std() + 4.0)
    x = np.floor(np.clip(x + 0.5, 0, 255)) / 255.0 - 0.5
    for i, (_, kernel, stride) in enumerate(a.convolutions):
        windows = np.lib.stride_tricks.sliding_window_view(x, (kernel, kernel), (1, 2))[:, ::stride, ::stride]
        x = np.einsum("chwij,ocij->ohw", windows, w[f"conv.{i}.weight"]) + w[f"conv.{i}.bias"][:, None, None]
        x = np.maximum(x, 0.0)
    x = w["features.weight"] @ x.ravel() + w["features.bias"]
    x = np.tanh((x - x.mean()) / np.sqrt(x.var() + 1e-5) * w["norm.weight"] + w["norm.bias"])
    for i in range(len(a.hidden)):
        x = np.maximum(w[f"hidden.{i}.weight"] @ x + w[f"hidden.{i}.bias"], 0.0)
    return np.tanh(w["mean.weight"] @ x + w["mean.bias"])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_policy(tmp_path / "run", SMALL, Control(yaw_rate=0.8), some_weights(SMALL), {"step": 7})
    return tmp_path / "run"


@pytest.mark.parametrize("pool", [1, 2, 4])
def test_a_saved_policy_acts_as_the_network_written_out(tmp_path, pool):
    size = (160, 90) if pool < 4 else (160, 96)
    architecture = Architecture(size=size, pool=pool, convolutions=((4, 5, 3), (6, 3, 2)), features=8, hidden=(16,))
    weights, stacks = some_weights(architecture), pictures(3, architecture)
    save_policy(tmp_path, architecture, Control(), weights, {})
    policy = load_policy(tmp_path)
    expected = np.array([naive(architecture, weights, stack) for stack in stacks])
    assert np.ptp(expected) > 1e-3
    # Where normalization ends at a half, the last bit of a sum decides to which byte it goes.
    np.testing.assert_allclose(policy.actions(stacks), expected, atol=3e-4)
    np.testing.assert_array_equal(policy(stacks[1]), policy(stacks[1]))


def test_the_onnx_file_is_the_same_policy(folder):
    whole, alone, stacks = load_policy(folder), load_policy(folder / ONNX), pictures(2)
    np.testing.assert_array_equal(alone.actions(stacks), whole.actions(stacks))
    assert alone.control == whole.control == Control(yaw_rate=0.8)
    assert alone.trained == whole.trained == {"step": 7}


def test_actions_become_the_commands_that_control_states():
    from twin.learn.policy import Policy

    steer = Policy("s", lambda x: np.zeros((len(x), 1)), Control(yaw_rate=0.8, speed=0.7))
    assert steer.command(np.array([0.5])) == (0.7, 0.4)
    twist = Policy("t", lambda x: np.zeros((len(x), 2)), Control("twist", speed=0.8, yaw_rate=2.0))
    assert twist.command(np.array([-1.0, -0.5])) == (0.0, -1.0)
    assert twist.command(np.array([1.0, 0.0])) == (0.8, 0.0)


def test_pooling_is_the_mean_rounded_half_up():
    some = pictures(2)
    mean = some.reshape(2, 12, 45, 2, 80, 2).astype(float).mean((3, 5))
    np.testing.assert_array_equal(average_pool(some, 2), np.floor(mean + 0.5))
    assert average_pool(np.array([[[0, 0], [1, 1]]], np.uint8), 2).item() == 1


def test_normalized_pictures_do_not_depend_on_exposure_contrast_or_white_balance():
    rng = np.random.default_rng(3)
    road = np.clip(rng.normal(110.0, 30.0, (3, 40, 60)), 30, 220)
    other = np.array([0.55, 0.5, 0.35])[:, None, None] * road + np.array([20.0, 12.0, 30.0])[:, None, None]
    as_bytes = [np.round(one).astype(np.uint8) for one in (road, other)]
    first, second = (normalize_colors(one).astype(int) for one in as_bytes)
    assert np.abs(as_bytes[0].astype(int) - as_bytes[1]).mean() > 20
    assert np.abs(first - second).mean() < 6 and np.abs(first - second).max() < 25
    ground = first[:, 20:].reshape(3, -1)
    np.testing.assert_allclose(ground.mean(1), 128, atol=1)
    assert (ground.std(1) > 38).all() and (ground.std(1) < 48).all()
    assert (normalize_colors(np.full((3, 4, 4), 77, np.uint8)) == 128).all()
    # Noise in a plain picture is not amplified.
    assert normalize_colors(rng.integers(9, 11, (3, 40, 60), np.uint8)).std() < 8


def test_preprocessing_is_pooling_and_then_normalization():
    some = pictures(2)
    np.testing.assert_array_equal(preprocess(some, 2), normalize_colors(average_pool(some, 2)))


def test_neither_torch_nor_sb3_is_needed(folder, tmp_path):
    for name in ("torch", "stable_baselines3"):
        (tmp_path / "none" / name).mkdir(parents=True)
        (tmp_path / "none" / name / "__init__.py").write_text("raise ImportError('not here')")
    code = (
        "import numpy as np, twin.validate; from twin.learn.policy import load_policy\n"
        f"print(load_policy({str(folder)!r})(np.zeros((12, 90, 160), np.uint8)))"
    )
    paths = os.pathsep.join([str(tmp_path / "none"), str(Path(__file__).parents[1])])
    run = subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths}, capture_output=True)
    assert run.returncode == 0, run.stderr.decode()


def flip(path: Path, where: int) -> None:
    blob = bytearray(path.read_bytes())
    blob[where] ^= 1
    path.write_bytes(blob)


def edit(folder: Path, **changes) -> None:
    head = json.loads((folder / JSON).read_text())
    for key, value in changes.items():
        at = head
        *outer, last = key.split("__")
        for name in outer:
            at = at[name]
        at[last] = value
    (folder / JSON).write_text(json.dumps(head))


DAMAGE = {
    "weights changed": (lambda f: flip(f / WEIGHTS, -5), "is not the file"),
    "weights cut": (lambda f: (f / WEIGHTS).write_bytes((f / WEIGHTS).read_bytes()[:500]), "is not the file"),
    "weights gone": (lambda f: (f / WEIGHTS).unlink(), "is missing"),
    "json cut": (lambda f: (f / JSON).write_text((f / JSON).read_text()[:90]), "no valid JSON|no UTF-8"),
    "json binary": (lambda f: (f / JSON).write_bytes(b"\xff\xfe\x00"), "no valid JSON|no UTF-8"),
    "json gone": (lambda f: (f / JSON).unlink(), "has no policy.json"),
    "json of others": (lambda f: (f / JSON).write_text("[1, 2]"), "not a policy of twin"),
    "later version": (lambda f: edit(f, version=3), "version 3"),
    "another shape": (lambda f: edit(f, network__hidden=[32, 33]), "expected float32"),
    "another depth": (lambda f: edit(f, network__hidden=[32, 32, 32]), "missing"),
    "no network": (lambda f: edit(f, network=3), "policy.json: "),
    "no such size": (lambda f: edit(f, network__features=-1), "whole numbers"),
    "a huge size": (lambda f: edit(f, network__features=10**9), "whole numbers"),
    "one side": (lambda f: edit(f, network__size=[16]), r"expected \(width, height\)"),
    "no such control": (lambda f: edit(f, control__thrust=1.0), "thrust"),
    "no such speed": (lambda f: edit(f, control__speed="fast"), "speed = 'fast'"),
    "no such action": (lambda f: edit(f, control__action="fly"), "fly"),
    "no training": (lambda f: edit(f, trained=5), "trained = 5; expected a table"),
    "actions that do not fit": (lambda f: edit(f, control__action="twist"), "expected 2"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_folder_is_refused_in_one_line(folder, what):
    damage, words = DAMAGE[what]
    load_policy(folder)
    damage(folder)
    with pytest.raises(InputError, match=words) as caught:
        load_policy(folder)
    assert "\n" not in str(caught.value)


def test_weights_that_are_not_numbers_are_refused(tmp_path):
    weights = some_weights(SMALL)
    weights["mean.bias"][0] = np.nan
    save_policy(tmp_path, SMALL, Control(), weights, {})
    with pytest.raises(InputError, match=r"mean\.bias .*not finite"):
        load_policy(tmp_path)


def foreign(path: Path, kind=TensorProto.FLOAT, shape=("n", 12, 90, 160), actions=2, external=False) -> Path:
    """An ONNX policy that twin did not write: the mean of the pictures' values, once per action."""
    one = numpy_helper.from_array(np.full((1, actions), 1 / 255, np.float32), "one")
    if external:
        one.data_location = TensorProto.EXTERNAL
        one.ClearField("raw_data")
        entry = one.external_data.add()
        entry.key, entry.value = "location", "../../etc/passwd"
    nodes = [
        helper.make_node("Cast", ["x"], ["f"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["f"], ["flat"]),
        helper.make_node("ReduceMean", ["flat"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("MatMul", ["mean", "one"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", kind, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", actions])],
        [one],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.UINT8])
def test_foreign_onnx_files_are_policies(tmp_path, kind):
    policy, stacks = load_policy(foreign(tmp_path / "theirs.onnx", kind)), pictures(2)
    assert policy.control.action == "twist" and policy.size == (160, 90) and policy.stack == 4
    expected = np.repeat(stacks.reshape(2, -1).mean(1)[:, None] / 255, 2, 1)
    np.testing.assert_allclose(policy.actions(stacks), expected, rtol=1e-4)


def test_onnx_files_that_are_no_policies_are_refused(tmp_path):
    for name, settings, words in (
        ("rank", {"shape": ("n", 12)}, "one input"),
        ("gray", {"shape": ("n", 4, 90, 160)}, "one input"),
        ("kind", {"kind": TensorProto.DOUBLE}, "uint8 or float32"),
        ("elsewhere", {"external": True}, "other files"),
        ("three", {"actions": 3}, "1 or 2"),
        ("four_at_once", {"shape": (4, 12, 90, 160)}, "n dynamic or 1"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            load_policy(foreign(tmp_path / f"{name}.onnx", **settings))
        assert "\n" not in str(caught.value)
    (tmp_path / "text.onnx").write_text("hello")
    (tmp_path / "empty.onnx").write_bytes(b"")
    whole = foreign(tmp_path / "whole.onnx").read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) // 2])
    for name in ("text", "empty", "cut"):
        with pytest.raises(InputError) as caught:
            load_policy(tmp_path / f"{name}.onnx")
        assert "\n" not in str(caught.value)


def test_an_onnx_file_with_a_damaged_note_is_refused(tmp_path):
    notes = {"twin": '{"format": "twin policy", "version": 1, "network": 5}'}
    (tmp_path / "a.onnx").write_bytes(onnx_bytes(SMALL, some_weights(SMALL), notes))
    with pytest.raises(InputError, match=r"a\.onnx"):
        load_policy(tmp_path / "a.onnx")
    assert onnx.load(tmp_path / "a.onnx", load_external_data=False).metadata_props[0].key == "twin"


def test_a_callable_is_a_policy(tmp_path, monkeypatch):
    code = "import numpy as np\nspeed = 1.0\ndef act(pixels):\n    return [pixels.mean() / 255]\n"
    (tmp_path / "my_driver.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    policy, stacks = load_policy("my_driver:act"), pictures(2)
    np.testing.assert_allclose(policy(stacks[0]), stacks[0].mean() / 255, rtol=1e-6)
    for name in ("my_driver:none", "no_module_of_that_name:act", "nothing", ":act", "my_driver:speed"):
        with pytest.raises(InputError):
            load_policy(name)


def sb3_model(algorithm: str = "SAC", images=None, low: float = -1.0, **settings):
    """An untrained model of stable-baselines3 for pictures of 64 × 36 px."""
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    import gymnasium

    class Road(gymnasium.Env):
        observation_space = images or gymnasium.spaces.Box(0, 255, (12, 36, 64), np.uint8)
        action_space = gymnasium.spaces.Box(low, 1, (2,), np.float32)

    kind = "MultiInputPolicy" if isinstance(images, gymnasium.spaces.Dict) else "CnnPolicy"
    keywords = {"net_arch": [8], "normalize_images": not images or images.dtype != np.float32}
    return getattr(sb3, algorithm)(kind, Road(), policy_kwargs=keywords, **settings)


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [("SAC", {"buffer_size": 1}), ("TD3", {"buffer_size": 1}), ("PPO", {}), ("PPO", {"use_sde": True})],
)
def test_an_sb3_zip_needs_trust(tmp_path, algorithm, settings):
    (model := sb3_model(algorithm, **settings)).save(tmp_path / "theirs.zip")
    with pytest.raises(InputError, match="--trust"):
        load_policy(tmp_path / "theirs.zip")
    policy = load_policy(tmp_path / "theirs.zip", trust=True)
    stacks = np.random.default_rng(0).integers(0, 256, (2, 12, 36, 64), np.uint8)
    np.testing.assert_allclose(policy.actions(stacks), model.predict(stacks, deterministic=True)[0], atol=1e-6)


def test_an_sb3_zip_trained_on_floats_of_0_to_255(tmp_path):
    spaces = pytest.importorskip("gymnasium").spaces
    model = sb3_model("PPO", spaces.Box(0, 255, (12, 36, 64), np.float32))
    model.save(tmp_path / "floats.zip")
    stacks = np.random.default_rng(0).integers(0, 256, (2, 12, 36, 64), np.uint8)
    expected = model.predict(stacks.astype(np.float32), deterministic=True)[0]
    assert np.ptp(expected) > 0.0
    actions = load_policy(tmp_path / "floats.zip", trust=True).actions(stacks)
    np.testing.assert_allclose(actions, expected, atol=1e-6)


def test_an_sb3_zip_that_does_not_fit_is_refused(tmp_path):
    spaces = pytest.importorskip("gymnasium").spaces
    images = spaces.Dict({"pixels": spaces.Box(0, 255, (12, 36, 64), np.uint8), "state": spaces.Box(-1, 1, (2,))})
    (tmp_path / "no.zip").write_bytes(b"PK nothing")
    sb3_model("PPO", images).save(tmp_path / "odometry.zip")
    sb3_model("PPO", low=0.0).save(tmp_path / "rescaled.zip")
    sb3_model("PPO", spaces.Box(0, 1, (12, 36, 64), np.float32)).save(tmp_path / "scaled.zip")
    sb3_model("PPO", spaces.Box(-1, 255, (12, 36, 64), np.float32)).save(tmp_path / "shifted.zip")
    for name, message in (
        ("no", "not a model"),
        ("odometry", "observes pixels and state; expected pictures alone.* train it without the option state"),
        ("scaled", "expected pictures .*uint8 or floats of 0 to 255"),
        ("shifted", "expected pictures .*uint8 or floats of 0 to 255"),
        ("rescaled", "range of twin"),
    ):
        with pytest.raises(InputError, match=message):
            load_policy(tmp_path / f"{name}.zip", trust=True)


def test_pictures_that_do_not_fit_are_refused(folder):
    policy = load_policy(folder)
    with pytest.raises(InputError, match=r"expected uint8 \(12, 90, 160\)"):
        policy(np.zeros((12, 45, 80), np.uint8))
    with pytest.raises(InputError, match="float64"):
        policy(np.zeros((12, 90, 160)))


@pytest.mark.parametrize(
    "code",
    [
        "def act(pixels): raise KeyError('x')",
        "def act(pixels): raise SystemExit(3)",
        "def act(pixels): return 'left'",
        "def act(pixels): return [1, 2, 3]",
        "act = 5",
        "raise OSError('no such robot')",
        "import sys; sys.exit(4)",
        "def act(",
    ],
)
def test_a_callable_that_is_no_policy_is_refused_in_one_line(tmp_path, monkeypatch, code):
    name = f"theirs_{abs(hash(code))}"
    (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match=name) as refused:
        load_policy(f"{name}:act")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["subprocess:run", "os:abort_", "..:..", "a b:c", ":x", "x:"])
def test_unknown_policy_names_are_refused(name):
    with pytest.raises(InputError):
        load_policy(name)


def test_a_callable_that_raises_is_named(tmp_path, monkeypatch):
    code = "left = [1]\ndef act(pixels):\n    left.pop()\n    return [0.0]\n"
    (tmp_path / "tired_policy.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    policy = load_policy("tired_policy:act")
    with pytest.raises(InputError, match=r"tired_policy:act: raised IndexError.*; it was given uint8 \(12, 90, 160\)"):
        policy(np.zeros((12, 90, 160), np.uint8))


def _hidden_tensors():
    """Models with a tensor in another file, each at another place."""
    outside = helper.make_tensor("w", TensorProto.FLOAT, [1], [0.0])
    outside.data_location = TensorProto.EXTERNAL
    outside.external_data.add(key="location", value="elsewhere")
    constant = helper.make_node("Constant", [], ["y"], value=outside)
    function = helper.make_function("own", "f", [], ["y"], [constant], [helper.make_opsetid("", 17)])
    sparse = onnx.SparseTensorProto(values=outside, indices=outside, dims=[1])
    return {
        "function": lambda model: model.functions.append(function),
        "sparse": lambda model: model.graph.sparse_initializer.append(sparse),
        "training": lambda model: model.training_info.add().algorithm.initializer.append(outside),
    }


@pytest.mark.parametrize("place", _hidden_tensors())
def test_weights_in_other_files_are_found_wherever_they_are_named(tmp_path, place):
    model = onnx.load(foreign(tmp_path / "a.onnx"))
    _hidden_tensors()[place](model)
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="its weights are in other files"):
        load_policy(tmp_path / "a.onnx")


def test_an_onnx_file_that_asks_for_huge_pictures_is_refused(tmp_path):
    model = onnx.load(foreign(tmp_path / "a.onnx"))
    for axis in (2, 3):
        model.graph.input[0].type.tensor_type.shape.dim[axis].dim_value = 100_000
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match=r"100000 × 100000 px|not an ONNX file"):
        load_policy(tmp_path / "a.onnx")
