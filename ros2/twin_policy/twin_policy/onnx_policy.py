"""A policy of `twin` run by ONNX Runtime: `policy.onnx`, and `policy.json` beside it.

A *stack* is the last pictures, uint8 (3 · stack, height, width), the newest last. The network's output becomes a
command exactly as in `twin`: one number is the yaw rate at constant speed (steering), two numbers are speed and yaw
rate (twist).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from twin_policy.pictures import Camera, PictureError

FORMAT, VERSION = "twin policy", 2
_MAX_BYTES = 256 << 20
_ENTRIES = ("format", "version", "control", "network", "trained")


class OnnxPolicy:
    """A deterministic policy, on one core of the CPU."""

    def __init__(self, source: str | Path) -> None:
        """
        Args:
            source: A policy folder of `twin train`, or its `policy.onnx`.

        Raises:
            ValueError: no such file, not a policy of this version, or no ONNX Runtime. The message is one line.
        """
        try:
            import onnxruntime
        except ImportError:
            raise ValueError("ONNX Runtime is not installed; see the README for how to install it") from None

        path = Path(source)
        path = path / "policy.onnx" if path.is_dir() else path
        if not path.is_file():
            raise ValueError(f"{path}: no such file; copy the folder of the run, with policy.onnx and policy.json")
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"{path}: {path.stat().st_size} bytes; expected at most {_MAX_BYTES}")
        settings = onnxruntime.SessionOptions()
        # One thread, as in twin, so that sums have the same order.
        settings.intra_op_num_threads = settings.inter_op_num_threads = 1
        settings.log_severity_level = 4
        try:  # from memory, so that weights in other files are refused
            self._session = onnxruntime.InferenceSession(
                path.read_bytes(), settings, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's exceptions have no other common base
            raise ValueError(f"{path}: ONNX Runtime cannot load it: {str(error).splitlines()[0]}") from None
        head = _parse(self._session.get_modelmeta().custom_metadata_map.get("twin", ""), f"{path}: its metadata")
        beside = path.with_name("policy.json")
        if beside.is_file():
            other = _parse(beside.read_text(encoding="utf-8", errors="replace"), str(beside))
            if any(other.get(name) != head.get(name) for name in _ENTRIES):
                raise ValueError(f"{beside} describes another policy than {path.name}; copy the whole folder again")
        try:
            control, network, trained = head["control"], head["network"], dict(head.get("trained") or {})
            self.action = str(control["action"])
            self.speed, self.max_yaw_rate = float(control["speed"]), float(control["yaw_rate"])
            self.timestep = float(control["control_timestep"])
            self.size = int(network["size"][0]), int(network["size"][1])
            self.stack = int(network["stack"])
            self.camera: Camera | None = None
            if trained.get("camera"):
                fx, fy, cx, cy = map(float, trained["camera"])
                self.camera = Camera(self.size, (fx, fy, cx, cy))
        except (KeyError, TypeError, ValueError, IndexError, PictureError) as error:
            raise ValueError(f"{path}: {type(error).__name__}: {error}; expected a policy of twin train") from None
        numbers = (self.speed, self.max_yaw_rate, self.timestep)
        if self.action not in ("steering", "twist") or not all(0.0 < x <= 10.0 for x in numbers) or self.timestep > 1.0:
            raise ValueError(f"{path}: control {control}; expected steering or twist, and numbers in (0, 10]")
        self.name = path.parent.name if path.name == "policy.onnx" else path.stem
        self._actions = 1 if self.action == "steering" else 2
        try:
            (self._input,) = self._session.get_inputs()
            self.run(np.zeros(self.stack_shape, np.uint8))  # the first run is slow, and fails if the shapes do not fit
        except Exception as error:  # as above
            raise ValueError(f"{path}: its network does not run: {str(error).splitlines()[0]}") from None

    @property
    def stack_shape(self) -> tuple[int, int, int]:
        """Shape of a stack: (3 · stack, height, width)."""
        return 3 * self.stack, self.size[1], self.size[0]

    def run(self, stack: np.ndarray) -> np.ndarray:
        """A stack uint8 (3 · stack, height, width) → the network's output, float32 (1 or 2,).

        Raises ValueError: another shape, or an output that is not an action.
        """
        if stack.shape != self.stack_shape or stack.dtype != np.uint8:
            raise ValueError(f"stack {stack.dtype} {stack.shape}; expected uint8 {self.stack_shape}")
        kind = np.float32 if self._input.type == "tensor(float)" else np.uint8
        out = np.asarray(self._session.run(None, {self._input.name: stack[None].astype(kind, copy=False)})[0])
        if out.shape != (1, self._actions) or not np.isfinite(out).all():
            raise ValueError(f"policy {self.name}: output {out.tolist()}; expected {self._actions} finite number(s)")
        return out[0].astype(np.float32)

    def command(self, stack: np.ndarray) -> tuple[float, float]:
        """A stack → v [m/s], yaw rate [rad/s]. Raises ValueError as `run` does."""
        action = np.clip(self.run(stack), -1.0, 1.0)
        v = self.speed if self.action == "steering" else (float(action[0]) + 1.0) / 2.0 * self.speed
        return v, float(action[-1]) * self.max_yaw_rate


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        head = json.loads(text or "null")
    except (ValueError, RecursionError):
        head = None
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise ValueError(f"{where}: not a policy of twin; expected the files that twin train writes")
    if head.get("version") != VERSION:
        raise ValueError(
            f"{where}: version {head.get('version')!r}; expected {VERSION}: install the twin_policy of the twin that "
            "wrote it"
        )
    return head
