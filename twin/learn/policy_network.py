"""The policy network, which converts a stack of pictures to an action, and its export as an ONNX graph.

A *stack* is uint8 (3 · stack, height, width), the newest picture last. Preprocessing has two steps. First, blocks of
`pool` × `pool` pixels are averaged. Then each color of each picture is scaled so that the lower half, where the ground
is, has a fixed mean and standard deviation; this removes exposure, white balance and most of the lighting. Both steps
return uint8, so that training and driving use the same values.

The *encoder* is that of DrQ (Kostrikov et al. 2020) at another size: convolutions with ReLU, then a linear layer with
layer normalization and tanh. Hidden layers with ReLU follow, and a tanh that gives actions in [-1, 1].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.errors import short_repr
from twin.types import Array32

NORM_EPSILON = 1e-5
GROUND_MEAN, GROUND_STD = 128.0, 48.0
"""Mean and standard deviation of a normalized color in the lower half of a picture."""
NOISE_STD = 4.0
"""Added to the measured standard deviation of a color, so that noise in uniform pictures is not amplified."""
_OPSET, _IR = 17, 8  # ONNX operator and file versions, old enough for the ONNX Runtime on a robot


@dataclass(frozen=True)
class Architecture:
    """Sizes of a policy network."""

    size: tuple[int, int] = (160, 90)
    """Width, height of the pictures [px]."""
    stack: int = 4
    pool: int = 2
    """Side of the averaged blocks [px]: 1, 2 or 4, since these averages are exact in floating point."""
    convolutions: tuple[tuple[int, int, int], ...] = ((32, 4, 4), (64, 3, 2))
    """Each convolution's number of channels, side of the kernel and stride."""
    features: int = 64
    """Size of the encoder's output."""
    hidden: tuple[int, ...] = (256, 256)
    actions: int = 1

    def __post_init__(self) -> None:
        """Raises ValueError: the sizes do not fit together, or are too large for a robot's computer."""
        if len(self.size) != 2:
            raise ValueError(f"size = {self.size}: expected (width, height)")
        numbers = [*self.size, self.stack, self.features, self.actions, *self.hidden, *sum(self.convolutions, ())]
        if not all(isinstance(n, int) and 1 <= n <= 4096 for n in numbers):
            raise ValueError(f"sizes {short_repr(numbers)}: expected whole numbers from 1 to 4096")
        if self.pool not in (1, 2, 4) or any(n % self.pool for n in self.size):
            raise ValueError(f"pool = {self.pool}: expected 1, 2 or 4, and a divisor of both picture sides")
        if any(len(one) != 3 for one in self.convolutions) or not 1 <= len(self.convolutions) <= 8:
            raise ValueError("convolutions: expected 1 to 8, each (channels, kernel, stride)")
        if len(self.hidden) > 8 or min(self.grid) < 1:
            raise ValueError(
                f"more than 8 hidden layers, or pictures of {self.size} px are too small for the convolutions"
            )

    @property
    def channels(self) -> int:
        return 3 * self.stack

    @property
    def pooled_size(self) -> tuple[int, int]:
        """Width, height of the pooled pictures [px]."""
        return self.size[0] // self.pool, self.size[1] // self.pool

    @property
    def grid(self) -> tuple[int, int]:
        """Width, height of the last convolution's output."""
        width, height = self.pooled_size
        for _, kernel, stride in self.convolutions:
            width, height = (width - kernel) // stride + 1, (height - kernel) // stride + 1
        return width, height

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of every weight, in torch's layout."""
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


def average_pool(pictures: NDArray[np.uint8], pool: int) -> NDArray[np.uint8]:
    """Averages blocks of `pool` × `pool` pixels (.5 rounds up); shapes (..., h, w) → (..., h/pool, w/pool)."""
    if pool == 1:
        return pictures
    *rest, height, width = pictures.shape
    squares = pictures.reshape(*rest, height // pool, pool, width // pool, pool)
    total = np.zeros((*rest, height // pool, width // pool), np.uint16)
    for row in range(pool):
        for column in range(pool):
            total += squares[..., row, :, column]
    return ((total + pool * pool // 2) // (pool * pool)).astype(np.uint8)


def normalize_colors(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Scales channels (..., height, width) so that the lower half of each has the mean `GROUND_MEAN`.

    The lower half's standard deviation becomes `GROUND_STD`, or a little less because of `NOISE_STD`.
    """
    ground = pictures[..., pictures.shape[-2] // 2 :, :].astype(np.float32)
    mean, std = ground.mean((-2, -1), keepdims=True), ground.std((-2, -1), keepdims=True)
    scaled = (pictures.astype(np.float32) - mean) * (np.float32(GROUND_STD) / (std + np.float32(NOISE_STD)))
    return (scaled + np.float32(GROUND_MEAN + 0.5)).clip(0.0, 255.0).astype(np.uint8)


def preprocess(pictures: NDArray[np.uint8], pool: int) -> NDArray[np.uint8]:
    """Pools and normalizes pictures for the convolutions; shapes (..., h, w) → (..., h/pool, w/pool)."""
    return normalize_colors(average_pool(pictures, pool))


def onnx_bytes(architecture: Architecture, weights: dict[str, Array32], notes: dict[str, str]) -> bytes:
    """Returns the contents of an ONNX file with preprocessing, network and the metadata `notes`.

    Its input is `pixels`, uint8 (n, 3 · stack, height, width); its output is `action`, (n, actions). `weights` has the
    names and shapes of `Architecture.shapes`.
    """
    from onnx import TensorProto, helper, numpy_helper

    a = architecture
    nodes: list[Any] = []
    constants = {"half": 0.5, "scale": 1.0 / 255.0, "noise": NOISE_STD, "spread": GROUND_STD}
    constants |= {"level": GROUND_MEAN + 0.5, "least": 0.0, "most": 255.0}
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
    pooled = last
    rows = {"from": [a.pooled_size[1] // 2], "to": [a.pooled_size[1]], "axis": [2]}
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
    std, last = last, pooled
    add("Sub", mean)
    add("Mul", "spread")
    add("Div", std)
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
