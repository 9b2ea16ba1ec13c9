"""The network that a policy is: from a stack of pictures to an action, and the same as an ONNX graph.

A *stack* is uint8, (3 · stack, height, width), the newest three channels last. It is shrunk by averaging squares of
`pool` pixels and rounding, and *levelled*: every colour of every picture is given the same mean and spread in the lower
half, where the ground is. So the road looks much the same by day and by night, in haze and under a red sky, whatever
the camera's exposure and white balance. Both end in bytes: what a policy was trained on is what it acts on.

Convolutions with ReLU follow, then a linear layer with layer normalisation and tanh (Kostrikov et al. 2020, DrQ, whose
encoder this is but for its size), hidden layers with ReLU, and a tanh: an action, each of its numbers in [-1, 1].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.types import Array32

NORM_EPSILON = 1e-5
LEVEL, SPREAD = 128.0, 48.0
"""Mean and standard deviation of a levelled colour in the lower half of a picture."""
NOISE = 4.0
"""Added to the spread that a colour has, so that a camera's noise is not blown up where there is nothing else."""
_OPSET, _IR = 17, 8  # old enough for the ONNX Runtime of a robot's computer


@dataclass(frozen=True)
class Architecture:
    """Sizes of a network."""

    size: tuple[int, int] = (160, 90)
    """Width, height of the pictures [px]."""
    stack: int = 4
    """Pictures in a stack."""
    pool: int = 2
    """Side of the squares that are averaged [px]: 1, 2 or 4, which are exact in floating point."""
    convolutions: tuple[tuple[int, int, int], ...] = ((32, 4, 4), (64, 3, 2))
    """Channels, kernel, stride of each."""
    features: int = 64
    """Numbers that the pictures become."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers."""
    actions: int = 1
    """Numbers in an action."""

    def __post_init__(self) -> None:
        """Raises ValueError: sizes that fit no network, or one that fits no robot's computer."""
        if len(self.size) != 2:
            raise ValueError(f"size = {self.size} is not a width and a height")
        numbers = [*self.size, self.stack, self.features, self.actions, *self.hidden, *sum(self.convolutions, ())]
        if not all(isinstance(n, int) and 1 <= n <= 4096 for n in numbers):
            raise ValueError("sizes are whole numbers from 1 to 4096")
        if self.pool not in (1, 2, 4) or any(n % self.pool for n in self.size):
            raise ValueError(f"pool = {self.pool} is 1, 2 or 4 and divides the pictures' sides")
        if any(len(one) != 3 for one in self.convolutions) or not 1 <= len(self.convolutions) <= 8:
            raise ValueError("convolutions are 1 to 8 times channels, kernel, stride")
        if len(self.hidden) > 8 or min(self.grid) < 1:
            raise ValueError(f"pictures of {self.size} px are too small for the convolutions")

    @property
    def channels(self) -> int:
        return 3 * self.stack

    @property
    def small(self) -> tuple[int, int]:
        """Width, height of the shrunken pictures [px]."""
        return self.size[0] // self.pool, self.size[1] // self.pool

    @property
    def grid(self) -> tuple[int, int]:
        """Width, height of what the last convolution gives."""
        width, height = self.small
        for _, kernel, stride in self.convolutions:
            width, height = (width - kernel) // stride + 1, (height - kernel) // stride + 1
        return width, height

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Every weight's name and shape, as torch lays them out."""
        out: dict[str, tuple[int, ...]] = {}
        before = self.channels
        for i, (channels, kernel, _) in enumerate(self.convolutions):
            out |= {f"conv.{i}.weight": (channels, before, kernel, kernel), f"conv.{i}.bias": (channels,)}
            before = channels
        out |= {"features.weight": (self.features, before * self.grid[0] * self.grid[1])}
        out |= dict.fromkeys(("features.bias", "norm.weight", "norm.bias"), (self.features,))
        before = self.features
        for i, width in enumerate(self.hidden):
            out |= {f"hidden.{i}.weight": (width, before), f"hidden.{i}.bias": (width,)}
            before = width
        return out | {"mean.weight": (self.actions, before), "mean.bias": (self.actions,)}


def shrink(pictures: NDArray[np.uint8], pool: int) -> NDArray[np.uint8]:
    """Means of squares of `pool` pixels, halves rounded up; shapes (..., h, w) → (..., h/pool, w/pool)."""
    if pool == 1:
        return pictures
    *rest, height, width = pictures.shape
    squares = pictures.reshape(*rest, height // pool, pool, width // pool, pool)
    total = np.zeros((*rest, height // pool, width // pool), np.uint16)
    for row in range(pool):
        for column in range(pool):
            total += squares[..., row, :, column]
    return ((total + pool * pool // 2) // (pool * pool)).astype(np.uint8)


def normalized(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Every channel with `LEVEL` and about `SPREAD` in the lower half of its rows; shape (..., height, width)."""
    ground = pictures[..., pictures.shape[-2] // 2 :, :].astype(np.float32)
    mean, spread = ground.mean((-2, -1), keepdims=True), ground.std((-2, -1), keepdims=True)
    scaled = (pictures.astype(np.float32) - mean) * (np.float32(SPREAD) / (spread + np.float32(NOISE)))
    return (scaled + np.float32(LEVEL + 0.5)).clip(0.0, 255.0).astype(np.uint8)


def prepared(pictures: NDArray[np.uint8], pool: int) -> NDArray[np.uint8]:
    """What the convolutions are given: shrunk and levelled; shapes (..., h, w) → (..., h/pool, w/pool)."""
    return normalized(shrink(pictures, pool))


def onnx_bytes(architecture: Architecture, weights: dict[str, Array32], notes: dict[str, str]) -> bytes:
    """The network as an ONNX file: `pixels` uint8 (n, 3 · stack, height, width) → `action` float32 (n, actions).

    Args:
        architecture: Sizes.
        weights: See `Architecture.shapes`.
        notes: Go into the file's metadata.
    """
    from onnx import TensorProto, helper, numpy_helper

    a = architecture
    nodes: list[Any] = []
    constants = {"half": 0.5, "scale": 1.0 / 255.0, "noise": NOISE, "spread": SPREAD, "level": LEVEL + 0.5}
    constants |= {"least": 0.0, "most": 255.0}
    tensors = [numpy_helper.from_array(np.array(value, np.float32), name) for name, value in constants.items()]
    tensors += [numpy_helper.from_array(np.ascontiguousarray(weights[name]), name) for name in a.shapes()]
    last = "pixels"

    def add(kind: str, *more: str, **attributes: Any) -> None:
        nonlocal last
        nodes.append(helper.make_node(kind, [last, *more], [f"t{len(nodes)}"], **attributes))
        last = f"t{len(nodes) - 1}"

    add("Cast", to=TensorProto.FLOAT)
    if a.pool > 1:
        add("AveragePool", kernel_shape=[a.pool, a.pool], strides=[a.pool, a.pool])
        add("Add", "half")
        add("Floor")
    small = last
    rows = {"from": [a.small[1] // 2], "to": [a.small[1]], "axis": [2]}
    tensors += [numpy_helper.from_array(np.array(value, np.int64), name) for name, value in rows.items()]
    add("Slice", *rows)
    ground = last
    add("ReduceMean", axes=[2, 3])
    mean, last = last, ground
    add("Sub", mean)
    add("Mul", last)
    add("ReduceMean", axes=[2, 3])
    add("Sqrt")
    add("Add", "noise")
    spread, last = last, small
    add("Sub", mean)
    add("Mul", "spread")
    add("Div", spread)
    add("Add", "level")
    add("Clip", "least", "most")
    add("Floor")
    add("Mul", "scale")
    add("Sub", "half")
    for i, (_, kernel, stride) in enumerate(a.convolutions):
        add("Conv", f"conv.{i}.weight", f"conv.{i}.bias", kernel_shape=[kernel, kernel], strides=[stride, stride])
        add("Relu")
    add("Flatten")
    add("Gemm", "features.weight", "features.bias", transB=1)
    add("LayerNormalization", "norm.weight", "norm.bias", epsilon=NORM_EPSILON)
    add("Tanh")
    for i in range(len(a.hidden)):
        add("Gemm", f"hidden.{i}.weight", f"hidden.{i}.bias", transB=1)
        add("Relu")
    add("Gemm", "mean.weight", "mean.bias", transB=1)
    nodes.append(helper.make_node("Tanh", [last], ["action"]))
    width, height = a.size
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("pixels", TensorProto.UINT8, ["n", a.channels, height, width])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", a.actions])],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], producer_name="twin")
    model.ir_version = _IR
    helper.set_model_props(model, notes)
    return model.SerializeToString()
