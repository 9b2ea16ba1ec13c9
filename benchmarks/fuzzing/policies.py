"""Fuzz targets of policies: run folders, ONNX files, callables by name, zips with pickles."""

import hashlib
import json
import shutil
import struct
from pathlib import Path
from random import Random

import numpy as np

from fuzzing.cases import Case
from fuzzing.values import OUTSIDE_PATH, corrupted, hostile_text, json_text, mutated, mutated_json


def policy_folder(case: Case) -> None:
    from twin.learn.policy import load_policy

    rng, folder = case.rng, case.folder / "run"
    shutil.copytree(case.samples.twin / "runs" / rng.choice(("ahead", "left")), folder)
    head = folder / "policy.json"
    if rng.choice(("policy.json", "policy.json", "policy.safetensors")) == "policy.json":
        head.write_bytes(mutated_json(rng, json.loads(head.read_text())))
    else:
        weights = folder / "policy.safetensors"
        data = _mutated_safetensors(rng, weights.read_bytes())
        weights.write_bytes(data)
        table = json.loads(head.read_text()) | {"weights_sha256": hashlib.sha256(data).hexdigest()}
        head.write_text(json.dumps(table))
    policy = load_policy(folder, rng.random() < 0.2)
    if rng.random() < 0.3:
        width, height = policy.size
        if 3 * policy.stack * width * height < 1 << 22:
            policy(np.zeros((3 * policy.stack, height, width), np.uint8))


def _mutated_safetensors(rng: Random, data: bytes) -> bytes:
    """A safetensors file with a mutated header or corrupted bytes."""
    if rng.random() >= 0.5:
        return corrupted(rng, data)
    size = struct.unpack("<Q", data[:8])[0]
    header = json_text(mutated(rng, json.loads(data[8 : 8 + size]))).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", rng.choice((len(header), 2**31, 2**63, 0))) + header + data[8 + size :]


def onnx_file(case: Case) -> None:
    from twin.learn.policy import load_policy

    rng, path = case.rng, case.folder / "policy.onnx"
    data = (case.samples.twin / "runs" / "ahead" / "policy.onnx").read_bytes()
    path.write_bytes(_mutated_onnx(rng, data) if rng.random() < 0.5 else corrupted(rng, data))
    load_policy(path, rng.random() < 0.2)


def _mutated_onnx(rng: Random, data: bytes) -> bytes:
    """A model with one change: shape, metadata, external data, operator, missing node, weights or opset."""
    import onnx

    model = onnx.load_model_from_string(data)
    graph = model.graph
    what = rng.randrange(7)
    if what == 0:
        dim = rng.choice(rng.choice((*graph.input, *graph.output)).type.tensor_type.shape.dim)
        dim.dim_value = rng.choice((0, -1, 1, 3, 2**31, 2**62))
    elif what == 1:
        metadata = {"format": "twin policy", "version": 2, "control": {"action": "twist", "speed": 1.0}}
        text = json_text(mutated(rng, metadata)).encode("utf-8", "replace").decode()
        model.metadata_props.add(key="twin", value=text)
    elif what == 2:
        weights = rng.choice(graph.initializer)
        weights.data_location = onnx.TensorProto.EXTERNAL
        weights.external_data.add(key="location", value=OUTSIDE_PATH)
    elif what == 3:
        node = rng.choice(graph.node)
        node.op_type = rng.choice(("Loop", "NoSuch", "Identity", "Resize", "", "Relu"))
    elif what == 4:
        del graph.node[rng.randrange(len(graph.node))]
    elif what == 5:
        weights = rng.choice(graph.initializer)
        weights.dims[:] = [rng.choice((0, -1, 2**31, 2**40)) for _ in weights.dims]
    else:
        model.opset_import[0].version = rng.choice((0, -1, 1, 999))
    return model.SerializeToString()


def drive_ahead(stack: np.ndarray) -> tuple[float, float]:
    """A callable that is a valid policy."""
    return 1.0, 0.0


_CALLABLES = (
    *(f"{__name__}:{drive_ahead.__name__}",) * 4,
    *("math:pi", "math:floor", "builtins:len", "operator:not_", "json:nothing", "a.b:c", ":", "::", "a:", ":a"),
    *(".os:x", "nothing:f", "math:", "math:.", "math.x:y", "..:..", "no such:f", "math:sin", "builtins:repr"),
    *("builtins:complex", "builtins:iter", "builtins:int", "operator:index", "operator:neg", "numpy:ravel"),
    *("numpy:mean", "numpy:array"),
)


def callable_name(case: Case) -> None:
    from twin.learn.policy import load_policy

    rng = case.rng
    name = rng.choice(_CALLABLES)
    if rng.random() < 0.4:
        text = hostile_text(rng)
        name = rng.choice((f"{text}:{text}", f"{text}:f", f"math:{text}", text))
        if Path(OUTSIDE_PATH).name in name:
            name = f"nothing:{name}"
    load_policy(name, False)


def zip_file(case: Case) -> None:
    from twin.learn.policy import load_policy

    path = case.folder / "policy.zip"
    data = case.rng.choice(list(case.samples.zips.values()))
    path.write_bytes(corrupted(case.rng, data) if case.rng.random() < 0.5 else data)
    load_policy(path, False)
