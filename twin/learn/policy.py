"""Trained policies: reading, writing and running them, without torch and stable-baselines3.

    policy = load_policy("scenes/demo/runs/night_owl")
    action = policy(pixels)                 # pixels: uint8 (12, 90, 160), newest picture last; action: in [-1, 1]
    v, yaw_rate = policy.command(action)    # m/s, rad/s

A *policy folder* contains three files. `policy.json` describes the control, the network's sizes and the training.
`policy.safetensors` contains the weights. `policy.onnx` contains all of this in one file, for robots with ONNX Runtime
but without this package: there, `ros2/twin_policy` runs it, and stops the robot when something is wrong. `load_policy`
lists the other formats. Loading a file runs code from it only if the user trusts it.
"""

import contextlib
import dataclasses
import glob
import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as safetensors_load
from safetensors.numpy import save as safetensors_save

from twin.config import STEERING, TWIST
from twin.errors import InputError, name_hint, short_repr
from twin.files import atomic_path, digest_file, digest_json, json_bytes, parse_json, read_bytes, read_json
from twin.learn.policy_network import Architecture, onnx_bytes
from twin.types import Array32, Image

ActFunction = Callable[[Image], Array32]
"""Stacks of pictures (n, 3 · stack, height, width) → actions (n, actions)."""

JSON, WEIGHTS, ONNX = "policy.json", "policy.safetensors", "policy.onnx"
FORMAT, VERSION = "twin policy", 2

_MAX_SIDE, _MAX_STACK = 4096, 64  # largest side of a picture [px]; largest number of pictures in a stack
_MAX_BYTES = 256 << 20  # largest size of a file
_METADATA_KEY = "twin"  # name of the policy's description in an ONNX file's metadata


@dataclass(frozen=True)
class Control:
    """Meaning and timing of a policy's actions. The defaults apply to policies of unknown origin."""

    action: str = STEERING
    """`steering`: an action is the yaw rate. `twist`: an action is speed and yaw rate."""
    speed: float = 1.0
    """For `steering`, the constant speed [m/s]. For `twist`, the speed at action 1 [m/s]; at action -1, it is 0."""
    yaw_rate: float = 1.0
    """Yaw rate at action 1, positive to the left [rad/s]."""
    control_timestep: float = 0.1
    """Time between two actions, and between two pictures of a stack [s]."""

    def __post_init__(self) -> None:
        """Raises ValueError: an unknown action, or a number out of range."""
        if self.action not in (STEERING, TWIST):
            raise ValueError(f"action = {self.action!r} is neither {STEERING!r} nor {TWIST!r}")
        for name, most in (("speed", 10.0), ("yaw_rate", 10.0), ("control_timestep", 1.0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value <= most:
                raise ValueError(f"{name} = {value!r} is not in (0, {most:g}]")

    @property
    def actions(self) -> int:
        """Number of components of an action."""
        return 1 if self.action == STEERING else 2


@dataclass(frozen=True)
class Policy:
    """A deterministic policy."""

    name: str
    act: ActFunction
    """Runs the network; `actions` also checks input and output."""
    control: Control
    size: tuple[int, int] = (160, 90)
    """Width, height of the pictures [px]."""
    stack: int = 4
    trained: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Description of the training, such as scene, task, run and step; empty if unknown."""

    def actions(self, stacks: Image) -> Array32:
        """Actions (n, actions), each component in [-1, 1], for stacks uint8 (n, 3 · stack, height, width).

        Raises InputError: the stacks have another shape, or the network's output is not a valid action.
        """
        width, height = self.size
        expected = (3 * self.stack, height, width)
        if stacks.dtype != np.uint8 or stacks.shape[1:] != expected:
            raise InputError(
                f"policy {self.name}: pictures {stacks.dtype} {stacks.shape[1:]}; expected uint8 {expected}, "
                f"the last {self.stack} pictures of {width} × {height} px, the newest last"
            )
        out = np.asarray(self.act(stacks), np.float32)
        if out.shape != (len(stacks), self.control.actions) or not np.isfinite(out).all():
            raise InputError(
                f"policy {self.name}: output {out.shape} for {len(stacks)} stacks; expected "
                f"{(len(stacks), self.control.actions)}, finite ({self.control.action})"
            )
        return np.clip(out, -1.0, 1.0)

    def __call__(self, stack: Image) -> Array32:
        """The action (actions,) for one stack, uint8 (3 · stack, height, width)."""
        return self.actions(stack[None])[0]

    def command(self, action: Array32) -> tuple[float, float]:
        """Speed [m/s] and yaw rate [rad/s] that an action (actions,) stands for."""
        c = self.control
        v = c.speed if c.action == STEERING else (float(action[0]) + 1.0) / 2.0 * c.speed
        return v, float(action[-1]) * c.yaw_rate

    def options(self) -> dict[str, Any]:
        """Options of `twin.load` for an environment that fits the policy."""
        return {**dataclasses.asdict(self.control), "size": self.size, "stack": self.stack}


def save_policy(
    folder: Path, architecture: Architecture, control: Control, weights: dict[str, Array32], trained: dict[str, Any]
) -> None:
    """Writes a policy folder.

    Args:
        weights: See `Architecture.shapes`.
        trained: Description of the training, JSON-able; see `Policy.trained`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: np.ascontiguousarray(weights[name], np.float32) for name in architecture.shapes()}
    head: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    head |= {"control": dataclasses.asdict(control), "network": dataclasses.asdict(architecture)}
    blob = safetensors_save(weights)
    onnx = onnx_bytes(architecture, weights, {_METADATA_KEY: json.dumps({**head, "trained": trained})})
    table = {**head, "weights_sha256": hashlib.sha256(blob).hexdigest(), "trained": trained}
    _replace_policy(folder, {WEIGHTS: blob, ONNX: onnx, JSON: json_bytes(table)})


def copy_policy(source: Path, folder: Path) -> None:
    """Replaces the policy in `folder` by the one in `source`."""
    _replace_policy(folder, {name: read_bytes(source / name) for name in (WEIGHTS, ONNX, JSON)})


def _replace_policy(folder: Path, files: dict[str, bytes]) -> None:
    """Replaces files, policy.json last. If the disk is full, the old policy remains complete."""
    with contextlib.ExitStack() as stack:  # on exit, it renames the temporary files in reverse order
        temporary = {name: stack.enter_context(atomic_path(folder / name)) for name in reversed(files)}
        for name, content in files.items():
            temporary[name].write_bytes(content)
        (folder / JSON).unlink(missing_ok=True)  # the old description must not be beside the new weights


def find_policy(root: Path, source: str) -> str:
    """Converts a name from a table (`run` or `run/checkpoint`) to its folder in `runs/`, for `load_policy`.

    Existing paths become absolute, since nodes of a cluster have other working folders. `module:function` is returned
    unchanged.

    Raises InputError: there is no such policy in `runs/`, which has others. If it has none, `source` is returned.
    """
    run, _, checkpoint = source.partition("/")
    folder = root / "runs" / run
    folder = folder / "checkpoints" / checkpoint if checkpoint else folder
    where = folder if not Path(source).exists() and (folder / JSON).exists() else Path(source)
    if where.exists():
        return str(where.resolve())
    if Path(source).is_absolute() or ":" in source or where.suffix in (".onnx", ".zip"):
        return source
    of_run = bool(checkpoint) and (root / "runs" / run).is_dir()
    found = sorted((root / "runs").glob(f"{glob.escape(run)}/checkpoints/*/{JSON}" if of_run else f"*/{JSON}"))
    names = [f"{run}/{path.parent.name}" if of_run else path.parent.name for path in found]
    if names := [name for name in names if not name.startswith(".")]:
        raise InputError(f"no policy {source} in {root / 'runs'}; {name_hint(source if of_run else run, names)}")
    return source


def policy_digest(source: str) -> str:
    """Digest of a policy's files. For a function, whose code is unknown, the digest of its name."""
    path = Path(source)
    if path.is_dir():
        return digest_file(path / JSON)  # it contains the digest of the weights
    return digest_file(path) if path.is_file() else digest_json(source)


def load_policy(source: str | Path, trust: bool = False) -> Policy:
    """Loads a policy from

    - a policy folder (or its policy.json), such as the folder of a run or of a checkpoint;
    - an ONNX file with one input, uint8 or float32 (n, 3 · stack, height, width) with values 0 to 255, and one output
      (n, 1 or 2) with values in [-1, 1];
    - `module:function`: the user's own function, which receives one stack of the default size, uint8 (12, 90, 160);
    - a zip file of any algorithm of stable-baselines3 that sees pictures; `trust` must be True, since loading the file
      runs code from it.

    Raises InputError: there is no such policy, or it is damaged or has another format.
    """
    path = Path(source)
    if path.name == JSON:
        path = path.parent
    if path.is_dir():
        return _from_folder(path)
    if path.is_file() and path.suffix == ".onnx":
        return _from_onnx(path)
    if path.is_file() and path.suffix == ".zip":
        if not trust:
            raise InputError(f"{path}: loading a stable-baselines3 zip runs code from it; if you trust it, add --trust")
        return _from_zip(path)
    if path.exists():
        raise InputError(f"{path}: expected a policy folder, an .onnx file or a stable-baselines3 .zip")
    if ":" in str(source):
        return _from_callable(str(source))
    raise InputError(
        f"no policy {source}; expected a run's folder, an .onnx file or module:function; "
        "twin unpack demo FOLDER gives a trained one, FOLDER/runs/first"
    )


def _from_folder(folder: Path) -> Policy:
    if not (folder / JSON).exists():
        raise InputError(f"{folder} has no {JSON}: not a policy folder, or a run that has not saved a policy yet")
    head = _head(read_json(folder / JSON), folder / JSON)
    architecture, control = _parts(head, folder / JSON)
    path = folder / WEIGHTS
    blob = _read(path)
    if digest_file(path) != head.get("weights_sha256"):
        raise InputError(f"{path} is not the file that {JSON} was written with; copy the whole run again")
    try:
        weights = safetensors_load(blob)
    except SafetensorError as error:
        raise InputError(f"{path} is not a safetensors file: {error}") from None
    for name, shape in architecture.shapes().items():
        found = weights.get(name)
        if found is None or found.shape != shape or found.dtype != np.float32 or not np.isfinite(found).all():
            what = "missing" if found is None else f"{found.dtype} {found.shape}, or not finite"
            raise InputError(f"{path}: {name} is {what}; expected float32 {shape}, as {JSON} says")
    act = _session(onnx_bytes(architecture, weights, {}), path)
    full = folder.resolve()
    name = f"{full.parent.parent.name}/{full.name}" if full.parent.name == "checkpoints" else full.name
    return Policy(name, act, control, architecture.size, architecture.stack, head.get("trained", {}))


def _from_onnx(path: Path) -> Policy:
    import onnx

    try:
        model = onnx.load_model_from_string(_read(path))
        # External files are refused before the checker runs, which would open them.
        if any(one.data_location == onnx.TensorProto.EXTERNAL for one in _tensors(model)):
            raise InputError(f"{path}: its weights are in other files; save it with its weights inside")
        onnx.checker.check_model(model)
    except InputError:
        raise
    except Exception as error:  # errors of protobuf or of the checker, or a RecursionError
        raise InputError(f"{path}: not an ONNX file: {type(error).__name__}: {error}") from None
    names = {one.name for one in model.graph.initializer}
    inputs = [one for one in model.graph.input if one.name not in names]
    shapes = [[d.dim_value for d in one.type.tensor_type.shape.dim] for one in (*inputs, *model.graph.output)]
    fits = len(inputs) == 1 and [len(shape) for shape in shapes] == [4, 2]
    # A dynamic axis has dim_value 0.
    if not fits or shapes[0][1] % 3 or 0 in shapes[0][1:] or shapes[0][0] > 1 or shapes[1][1] not in (1, 2):
        raise InputError(
            f"{path}: inputs and outputs {shapes}; expected one input (n, 3 · stack, height, width) and one output "
            "(n, 1 or 2), with n dynamic or 1"
        )
    _, channels, height, width = shapes[0]
    if channels > 3 * _MAX_STACK or max(height, width) > _MAX_SIDE:
        raise InputError(
            f"{path}: takes pictures of {width} × {height} px in {channels} channels; expected at most {_MAX_SIDE} px "
            f"per side and {_MAX_STACK} stacked pictures of 3 channels"
        )
    notes = {one.key: one.value for one in model.metadata_props}
    control, trained = Control(STEERING if shapes[1][1] == 1 else TWIST), {}
    if _METADATA_KEY in notes:
        try:
            head = _head(parse_json(notes[_METADATA_KEY], f"{path}: its metadata"), path)
        except UnicodeError as error:
            raise InputError(f"{path}: its metadata are not text: {error}") from None
        control, trained = _parts(head, path)[1], head.get("trained", {})
    act = _session(model.SerializeToString(), path)
    return Policy(path.stem, act, control, (width, height), channels // 3, trained)


def _tensors(model: Any) -> Iterator[Any]:
    """Yields every tensor of an ONNX model, at any depth of nesting."""
    waiting = [model]
    while waiting:
        message = waiting.pop()
        if message.DESCRIPTOR.name == "TensorProto":
            yield message
        for field, value in message.ListFields():
            if field.type == field.TYPE_MESSAGE:
                waiting += [value] if hasattr(value, "ListFields") else list(value)


def _from_callable(name: str) -> Policy:
    # Imported only here, so that policy files load without the environments.
    from twin.env.drivers import find_callable

    function = find_callable(name)

    def output_of(stack: Image) -> Array32:
        try:
            return np.asarray(function(stack), np.float32)
        except (Exception, SystemExit) as error:  # the user's code may raise anything
            given = f"{stack.dtype} {stack.shape}, the last {len(stack) // 3} pictures"
            raise InputError(f"policy {name}: raised {type(error).__name__}: {error}; it was given {given}") from error

    def act(stacks: Image) -> Array32:
        outputs = [output_of(stack) for stack in stacks]
        if any(one.shape != example.shape for one in outputs):
            raise InputError(
                f"policy {name}: returned {short_repr(outputs)}; expected {example.shape[0]} number(s), as before"
            )
        return np.stack(outputs)

    example = output_of(np.zeros((12, 90, 160), np.uint8))
    if example.shape not in ((1,), (2,)):
        raise InputError(
            f"policy {name}: returned {short_repr(example)}; expected 1 number in [-1, 1] (steering) or 2 (twist)"
        )
    return Policy(name, act, Control(STEERING if example.shape == (1,) else TWIST))


def _from_zip(path: Path) -> Policy:
    try:
        from stable_baselines3.common.save_util import load_from_zip_file
    except ImportError:
        raise InputError(f"{path}: needs stable-baselines3; pip install 'twin[learn]'") from None
    try:
        # Only the network: a model's `load` also allocates its replay buffer, and needs the algorithm's class.
        data, weights, _ = load_from_zip_file(path, device="cpu")
        if data is None:
            raise ValueError("no description of the model")
        pictures, range_ = data["observation_space"], data["action_space"]
        settings = {name: value for name, value in data["policy_kwargs"].items() if name != "device"}
        settings |= {"use_sde": True} if data["use_sde"] else {}
        network = data["policy_class"](pictures, range_, lambda _: 0.0, **settings)
        network.load_state_dict(weights["policy"])
    except Exception as error:  # damaged zips and pickles raise many kinds of errors
        raise InputError(f"{path}: not a model of stable-baselines3: {type(error).__name__}: {error}") from None
    shape, actions = pictures.shape, range_.shape
    if shape is None:
        raise InputError(
            f"{path}: observes {' and '.join(pictures)}; expected pictures alone, since a robot's policy gets nothing "
            "else: train it without the option state, or measure it by evaluate_policy, as examples/ppo.py does"
        )
    whole = pictures.dtype == np.uint8 or (
        np.issubdtype(pictures.dtype, np.floating) and (pictures.low == 0.0).all() and (pictures.high == 255.0).all()
    )
    if not whole or len(shape) != 3 or shape[0] % 3 or actions not in ((1,), (2,)):
        raise InputError(
            f"{path}: observes {pictures}, acts in {range_}; expected pictures (3 · stack, height, width), uint8 or "
            "floats of 0 to 255, and 1 or 2 numbers"
        )
    if (range_.low != -1.0).any() or (range_.high != 1.0).any():
        raise InputError(f"{path}: acts in {range_}; expected -1 to 1, the range of twin's environments")
    control = Control(STEERING if actions == (1,) else TWIST)

    def act(stacks: Image) -> Array32:
        return network.predict(stacks, deterministic=True)[0]

    return Policy(path.stem, act, control, (shape[2], shape[1]), shape[0] // 3)


def _session(model: bytes, path: Path) -> ActFunction:
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    # One thread: environments already run in parallel, and the order of sums must not vary.
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    settings.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(model, settings, providers=["CPUExecutionProvider"])
    except Exception as error:  # the only common base of ONNX Runtime's exceptions
        raise InputError(f"{path}: ONNX Runtime cannot load it: {error}") from None
    (source,) = session.get_inputs()
    dtypes = {"tensor(uint8)": np.uint8, "tensor(float)": np.float32}
    if source.type not in dtypes:
        raise InputError(f"{path}: takes {source.type}; expected uint8 or float32 pictures of values 0 to 255")

    def act(stacks: Image) -> Array32:
        try:
            return session.run(None, {source.name: stacks.astype(dtypes[source.type], copy=False)})[0]
        except Exception as error:
            raise InputError(f"{path}: ONNX Runtime fails on pictures {stacks.shape}: {error}") from None

    return act


def _head(head: Any, path: Path) -> dict[str, Any]:
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise InputError(f"{path}: not a policy of twin (format {FORMAT!r})")
    if head.get("version") != VERSION:
        raise InputError(
            f"{path}: version {head.get('version')!r}; expected {VERSION}: it was written by another version of twin"
        )
    if not isinstance(head.get("trained", {}), dict):
        raise InputError(f"{path}: trained = {short_repr(head['trained'])}; expected a table; copy the whole run again")
    return head


def _parts(head: dict[str, Any], path: Path) -> tuple[Architecture, Control]:
    try:
        network = dict(head["network"])
        network["size"], network["hidden"] = tuple(network["size"]), tuple(network["hidden"])
        network["convolutions"] = tuple(tuple(one) for one in network["convolutions"])
        architecture, control = Architecture(**network), Control(**head["control"])
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {type(error).__name__}: {error}") from None
    if architecture.actions != control.actions:
        raise InputError(f"{path}: {architecture.actions} actions; expected {control.actions} ({control.action})")
    return architecture, control


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise InputError(f"{path} is missing; copy the whole run")
    return read_bytes(path, _MAX_BYTES)
