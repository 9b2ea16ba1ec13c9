"""The targets of `fuzz.py`: how each draws its cases, and the reader or verb that it gives them to."""

import dataclasses
import importlib
import io
import json
import os
import pickle
import shutil
import socket
import struct
import zipfile
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from fuzz import Broken, Case, Target, call_verb
from fuzz_values import DEEP, OUTSIDE, anything, damaged, json_text, literal, mangled_text, spoiled, toml_text, word

from twin.errors import InputError


class Payload:
    """Makes a marker file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("import os, pathlib; pathlib.Path(os.environ['TWIN_FUZZ_MARKER']).write_text('ran')",)


class Stuff:
    """Good files that cases start from, made once a process and never written to again."""

    def __init__(self, work: Path) -> None:
        self.folder = work / "stuff"
        self.folder.mkdir()
        _ = self.twin, self.film

    @cached_property
    def twin(self) -> Path:
        """A small built scene with two policies, a run and validated episodes."""
        from tiny_runs import tiny_runs
        from tiny_twin import tiny_twin

        root = self.folder / "tiny"
        root.mkdir()
        tiny_twin(root)
        tiny_runs(root, {"step": 100, "task": "ahead", "observe": "nerf", "lighting": "training"})
        (root / "runs" / "ahead" / "episodes.csv").write_text(TRAINING_CSV)
        return root

    @cached_property
    def film(self) -> bytes:
        """A film of ten frames."""
        import av

        path = self.folder / "film.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=10)
            stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
            for i in range(10):
                pixels = np.full((64, 96, 3), 20 * i, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            container.mux(stream.encode(None))
        return path.read_bytes()

    @cached_property
    def images(self) -> dict[str, bytes]:
        """A small picture in every format, by suffix."""
        from PIL import Image

        pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        kinds = {".png": "PNG", ".jpg": "JPEG", ".tif": "TIFF", ".webp": "WEBP", ".bmp": "BMP"}
        out = {}
        for suffix, kind in kinds.items():
            Image.fromarray(pixels).save(buffer := io.BytesIO(), kind)
            out[suffix] = buffer.getvalue()
        return out

    @cached_property
    def log(self) -> dict[str, np.ndarray]:
        """A log of six seconds, columns by name."""
        t = np.arange(0.0, 6.0, 0.05)
        ones = np.ones_like(t)
        return {
            "time": t,
            "cmd_v": 0.8 * ones,
            "cmd_yaw_rate": 0.1 * np.sin(t),
            "left_wheel_vel": 4.8 * ones,
            "right_wheel_vel": 4.9 * ones,
            "x": 0.8 * t,
            "y": 0.01 * t,
            "yaw": 0.05 * t,
            "acceleration_x": 0.1 * np.cos(t),
            "acceleration_y": 0.0 * ones,
        }

    @cached_property
    def cells(self) -> list[Any]:
        from twin.evaluation.trials import Cell

        return [Cell(p, t, "day", 10, 5) for p in ("ahead", "left") for t in ("ahead", "bend")]

    @cached_property
    def environment(self) -> Any:
        import twin

        environment = twin.load(self.twin, "ahead", 0, pixels=False)
        environment.reset()
        return environment

    @cached_property
    def forecast(self) -> Any:
        from twin.evaluation.forecasting import make_forecast
        from twin.evaluation.trials import Cell

        twin = [Cell(p, "ahead", "day", 10, k) for p, k in (("a", 3), ("b", 6), ("c", 9))]
        real = [dataclasses.replace(c, trials=5, successes=c.successes // 2, twin_lighting="day") for c in twin]
        (folder := self.folder / "forecast").mkdir()
        make_forecast("tiny", twin, real).save(folder)
        return json.loads((folder / "forecast.json").read_text())

    @cached_property
    def zips(self) -> dict[str, bytes]:
        """Pickles with a payload, as a zip of stable-baselines3 and as others."""
        bad = pickle.dumps(Payload())
        out = {}
        for name, inner in (("data", b"{}"), ("policy.pth", bad), ("pytorch_variables.pth", bad), ("a.npy", bad)):
            buffer = io.BytesIO()
            with zipfile.ZipFile(buffer, "w") as archive:
                archive.writestr("data", b'{"policy_class": {":type:": "x", ":serialized:": "gASVAAAA"}}')
                archive.writestr(name, inner)
            out[name] = buffer.getvalue()
        return out


TRAINING_CSV = "step,wall_s,seed,lighting,success,cause,progress_m,steps,reward,start_m\n" + "".join(
    f"{10 * k},{k}.0,{k},day,{k % 2},goal,4.0,40,3.0,0.0\n" for k in range(1, 13)
)
EPISODES_CSV = "policy,task,lighting,seed,success,cause,progress_m,steps,trust\n" + "".join(
    f"{p},ahead,day,{k},{k % 2},{'goal' if k % 2 else 'collision'},3.5,40,0.9000\n" for p in "ab" for k in range(5)
)
RESULTS_CSV = "policy,lighting,trials,successes,task,twin_lighting\nahead,day,10,4,ahead,day\nleft,day,10,6,bend,\n"
_SCENE: dict[str, Any] = {
    "name": "tiny",
    "seed": 0,
    "source": [{"path": "input/day.mp4", "lighting": "day", "camera": {"model": "PINHOLE", "params": [9, 9, 5, 5]}}],
    "metric": {"camera_height": 1.2},
    "task": [{"name": "ahead", "start": 0.5, "length": 4.0}],
    "obstacle": [{"kind": "cone", "station": 2.0, "to": [3.0, 1.0], "color": [1, 0, 0]}],
}


def _defaults(kind: type) -> dict[str, Any]:
    """The defaults of a config as TOML has them."""
    out = {}
    for name, value in dataclasses.asdict(kind()).items():
        if value is not None:
            out[name] = list(value) if isinstance(value, tuple) else value
    return out


def _scene_table(rng: Random) -> dict[str, Any]:
    from twin.config import SceneConfig

    table = {**_SCENE}
    whole = _defaults(SceneConfig)
    for name in rng.sample([n for n, v in whole.items() if isinstance(v, dict) and n != "metric"], 3):
        table[name] = {k: v for k, v in whole[name].items() if v is not None}
    return table


# ---- scene.toml, robot.toml


def _scene(case: Case) -> None:
    from twin.config_file import load_config

    path = case.folder / "scene.toml"
    path.write_bytes(mangled_text(case.rng, toml_text(spoiled(case.rng, _scene_table(case.rng), True))))
    if case.rng.random() < 0.1:
        (case.folder / "robot.toml").write_bytes(mangled_text(case.rng, "friction = 0.5\n"))
    load_config(path)


def _robot(case: Case) -> None:
    from twin.config_file import read_robot
    from twin.robot import HuskyParams

    path = case.folder / "robot.toml"
    path.write_bytes(mangled_text(case.rng, toml_text(spoiled(case.rng, _defaults(HuskyParams), True))))
    read_robot(path)


def _override(rng: Random) -> str:
    from twin.config import SceneConfig

    table = _defaults(SceneConfig)
    section = rng.choice(list(table))
    key = f"{section}.{rng.choice(list(table[section]))}" if isinstance(table[section], dict) else section
    what = rng.random()
    if what < 0.15:
        key = rng.choice(("", ".", "a", "a.b", f"{key}.x", f".{key}", f"{key}.", "name.x", "source.0.path", word(rng)))
    elif what < 0.17:
        key = "a." * DEEP + "a"
    return rng.choice((f"{key}={literal(rng, True)}", f"{key}={word(rng)}", key, f"{key}==", f"{key}=1\nb = 2"))


def _overrides(case: Case) -> None:
    from twin.config_file import load_config

    path = case.folder / "scene.toml"
    path.write_text(toml_text(_SCENE))
    load_config(path, tuple(_override(case.rng) for _ in range(case.rng.choice((1, 1, 2)))))


# ---- captures


def _transforms(case: Case) -> None:
    from twin.capture.formats import listed_files, read_transforms

    pose = np.eye(4).tolist()
    table = {
        "camera_model": "OPENCV",
        "fl_x": 30.0,
        "fl_y": 30.0,
        "cx": 16.0,
        "cy": 12.0,
        "w": 32,
        "h": 24,
        "k1": 0.01,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "camera_angle_x": 0.9,
        "scale": 1.0,
        "applied_transform": pose[:3],
        "frames": [{"file_path": f"{k}.png", "transform_matrix": pose, "mask_path": "0.png"} for k in range(3)],
    }
    for k in range(3):
        (case.folder / f"{k}.png").write_bytes(case.stuff.images[".png"])
    path = case.folder / "transforms.json"
    path.write_bytes(mangled_text(case.rng, json_text(spoiled(case.rng, table))))
    (listed_files if case.rng.random() < 0.1 else read_transforms)(path)


_CAMERAS_TXT = "# cameras\n1 PINHOLE 32 24 30 30 16 12\n2 OPENCV 32 24 30 30 16 12 0.1 0 0 0\n"
_IMAGES_TXT = "# images\n1 1 0 0 0 0.1 0.2 0.3 1 a.png\n1.0 2.0 -1\n2 0.7 0.7 0 0 1 2 3 2 b.png\n\n"


def _colmap_text(case: Case) -> None:
    texts = {"cameras.txt": _CAMERAS_TXT, "images.txt": _IMAGES_TXT, "points3D.txt": ""}
    spoil = case.rng.choice(("cameras.txt", "images.txt", "points3D.txt"))
    for name, text in texts.items():
        if name != spoil:
            (case.folder / name).write_text(text)
            continue
        words = [line.split(" ") for line in text.split("\n")]
        if case.rng.random() < 0.6:
            line = case.rng.choice(words)
            line[case.rng.randrange(len(line))] = case.rng.choice((word(case.rng), str(literal(case.rng))))
        text = "\n".join(" ".join(line) for line in words)
        (case.folder / name).write_bytes(mangled_text(case.rng, text))
    _read_colmap(case)


def _colmap_binary(case: Case) -> None:
    cameras = struct.pack("<Q", 1) + struct.pack("<iiQQ4d", 1, 1, 32, 24, 30.0, 30.0, 16.0, 12.0)
    image = struct.pack("<i7di", 1, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 1) + b"a.png\0" + struct.pack("<Q", 1)
    images = struct.pack("<Q", 1) + image + struct.pack("<ddq", 1.0, 2.0, -1)
    spoil = case.rng.choice(("cameras.bin", "images.bin"))
    for name, data in (("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", bytes(8))):
        (case.folder / name).write_bytes(damaged(case.rng, data) if name == spoil else data)
    _read_colmap(case)


def _read_colmap(case: Case) -> None:
    from twin.capture.formats import read_colmap

    for name in ("a.png", "b.png"):
        (case.folder / name).write_bytes(case.stuff.images[".png"])
    read_colmap(case.folder)


def _forged(rng: Random, suffix: str, data: bytes) -> bytes:
    """An image whose header promises another size, with a right checksum where there is one."""
    import zlib

    out = bytearray(data)
    sizes = [rng.choice((0, 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 30_000)) for _ in range(2)]
    if suffix == ".png":
        out[16:24] = struct.pack(">II", *sizes)
        out[24] = rng.choice((8, 16, out[24], 255))
        out[29:33] = struct.pack(">I", zlib.crc32(bytes(out[12:29])))
    elif suffix == ".bmp":
        out[18:26] = struct.pack("<II", *sizes)
    elif suffix == ".jpg":
        at = out.find(b"\xff\xc0")
        out[at + 5 : at + 9] = struct.pack(">HH", *(size % 2**16 for size in sizes))
    else:
        return damaged(rng, data)
    return bytes(out)


def _image(case: Case) -> None:
    from twin.capture.capture_data import read_mask
    from twin.capture.formats import image_size
    from twin.capture.photos import load_photo
    from twin.geometry.images import read_image

    rng = case.rng
    suffix, data = rng.choice(list(case.stuff.images.items()))
    data = _forged(rng, suffix, data) if rng.random() < 0.4 else damaged(rng, data)
    path = case.folder / f"image{suffix if rng.random() < 0.9 else '.png'}"
    path.write_bytes(data)
    readers: list[Callable[[Path], Any]] = [
        lambda p: load_photo(p, None),
        read_image,
        lambda p: read_mask(p, 32, 24),
        image_size,
    ]
    rng.choice(readers)(path)


def _exif(case: Case) -> None:
    from PIL import ExifTags, Image

    from twin.capture.photos import load_photo

    rng = case.rng
    exif = Image.Exif()
    values: list[Any] = [
        "",
        "x\x00y",
        -1,
        0,
        2**31,
        7,
        3.5,
        float("nan"),
        float("inf"),
        (1, 2, 3),
        "2020:13:99 25:61:61",
    ]
    values += [(1.0, 2.0, 3.0), ((1, 0), (2, 0), (3, 0)), b"\xff\x00", "9" * 5000, (float("nan"),) * 3]
    exif[ExifTags.Base.Orientation] = rng.choice((1, 6, 0, 9, 65535))
    exif[ExifTags.Base.Model] = "x"
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
    tags = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DateTimeOriginal)
    tags += (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneResolutionUnit, ExifTags.Base.SubsecTime)
    for tag in rng.sample(tags, 3):
        photo[tag] = rng.choice(values)
    for tag in rng.sample(range(1, 8), 4):
        gps[tag] = rng.choice([*values, "N", "S", (48, 8, 30)])
    picture, path = Image.new("RGB", (32, 24)), case.folder / "photo.jpg"
    try:
        picture.save(path, "JPEG", exif=exif)
        data = path.read_bytes()
    except Exception:  # a value that PIL writes no header with
        picture.save(path, "JPEG", exif=b"Exif\0\0MM\0\x2a\0\0\0\x08\0\1\1\x12\0\3\0\0\0\1\0\6\0\0\0\0\0\0")
        data = path.read_bytes()
    if rng.random() < 0.7:
        data = data[:24] + damaged(rng, data[24 : 24 + 400]) + data[424:]
    path.write_bytes(data)
    load_photo(path, None)


def _film(case: Case) -> None:
    from twin.capture.video import probe

    path = case.folder / case.rng.choice(("film.mp4", "film.mkv", "film.avi", "film.mov"))
    path.write_bytes(damaged(case.rng, case.stuff.film))
    probe(path)


# ---- tables and logs


def _table(rng: Random, text: str) -> bytes:
    """A CSV with a cell or a row changed."""
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(rng.choice((1, 1, 2))):
        row = rng.choice(rows[1:] if rng.random() < 0.8 else rows)
        what = rng.random()
        if what < 0.7:
            row[rng.randrange(len(row))] = rng.choice((word(rng), str(literal(rng))))
        elif what < 0.8:
            row.append(word(rng))
        elif what < 0.9:
            row.pop()
            row = row or [""]
        else:
            rows.append(list(row))
        rows = [one or [""] for one in rows]
    return mangled_text(rng, "\n".join(",".join(row) for row in rows) + "\n")


def _results(case: Case) -> None:
    from twin.evaluation.trials import read_results

    path = case.folder / "results.csv"
    path.write_bytes(_table(case.rng, RESULTS_CSV))
    read_results(path, case.stuff.cells)


def _episodes(case: Case) -> None:
    from twin.evaluation.trials import read_trials

    path = case.folder / "episodes.csv"
    path.write_bytes(_table(case.rng, EPISODES_CSV))
    read_trials(path)


def _training(case: Case) -> None:
    from twin.evaluation.training_curves import read_episodes

    (case.folder / "episodes.csv").write_bytes(_table(case.rng, TRAINING_CSV))
    read_episodes(case.folder)


def _log_csv(case: Case) -> None:
    from twin.sysid.logs import read_log

    log = case.stuff.log
    rows = zip(*(column[:60] for column in log.values()), strict=True)
    text = ",".join(log) + "\n" + "".join(",".join(f"{value:.5g}" for value in row) + "\n" for row in rows)
    path = case.folder / "log.csv"
    path.write_bytes(_table(case.rng, text))
    read_log(path)


def _log_npz(case: Case) -> None:
    from twin.sysid.logs import read_log

    rng, columns = case.rng, dict(case.stuff.log)
    path = case.folder / "log.npz"
    n = len(columns["time"])
    if rng.random() < 0.2:
        names = [f"{side}_vel" for side in ("left_wheel", "right_wheel")]
        for name in ("icp_x", "icp_y", "icp_yaw", "cmd_left", "cmd_right", *names, "imu_acceleration_x"):
            columns[name] = np.zeros((3, 40))
        columns |= {"calib_step": np.arange(3), "gt_icp_x": np.zeros(3), "imu_acceleration_y": np.zeros((3, 40))}
        columns |= {"gt_icp_y": np.zeros(3), "gt_icp_yaw": np.zeros(3)}
    for name in rng.sample(sorted(columns), rng.choice((0, 1, 2))):
        column = columns[name].copy()
        what = rng.random()
        if what < 0.3 and column.dtype.kind == "f":
            column.flat[rng.randrange(column.size)] = rng.choice((np.nan, np.inf, 1e308, -1e9))
        elif what < 0.5:
            kinds = (bool, np.int8, complex, "U5", "S3", np.float16, "M8[s]", "m8[s]", np.uint64, [("a", "f8")])
            kind = rng.choice(kinds)
            column = np.zeros(n, kind)  # type: ignore[arg-type]
        elif what < 0.7:
            column = rng.choice((np.zeros(()), column[:3], np.zeros((0, 40)), column[:, None], np.zeros((n, 0))))
        elif what < 0.8:
            column = np.array([Payload()] * 3, object)
        else:
            column = np.sort(column)[::-1] * rng.choice((1.0, 1e3, 1e9, 0.0))
        columns[name] = column
    np.savez(path, **columns)  # type: ignore[arg-type]
    if rng.random() < 0.4:
        _forge_npz(rng, path)
    elif rng.random() < 0.3:
        path.write_bytes(damaged(rng, path.read_bytes()))
    read_log(path)


def _forge_npz(rng: Random, path: Path) -> None:
    """Puts another header before an array, or an array that unpacks to gigabytes."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(parts))
    if rng.random() < 0.1:
        parts[name] = parts[name][:128] + bytes(64 << 20)
    else:
        shape = rng.choice(
            ("(2147483648,)", "(9223372036854775807, 8)", "(-1,)", "(1e3,)", "()", "(0,)", "'a'", "(True,)")
        )
        descr = rng.choice(("'<f8'", "'|O'", "'<U99999999'", "'x'", "[('a', '<f8')]", "'<V2147483647'", "None"))
        text = rng.choice(
            (
                f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}",
                "{" * 5000,
                "(" * 200,
                "",
                "{'descr': '<f8'}",
                "__import__('os').getcwd()",
            )
        )
        version = rng.choice(((1, 0), (2, 0), (3, 0), (9, 9)))
        size = struct.pack("<H" if version == (1, 0) else "<I", rng.choice((len(text), 65535, 0)))
        parts[name] = b"\x93NUMPY" + bytes(version) + size + text.encode() + parts[name][128:]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in parts.items():
            archive.writestr(name, data)


# ---- policies


def _policy_folder(case: Case) -> None:
    from twin.learn.policy import load_policy

    rng, folder = case.rng, case.folder / "run"
    shutil.copytree(case.stuff.twin / "runs" / rng.choice(("ahead", "left")), folder)
    which = rng.choice(("policy.json", "policy.json", "policy.safetensors"))
    if which == "policy.json":
        table = spoiled(rng, json.loads((folder / which).read_text()))
        (folder / which).write_bytes(mangled_text(rng, json_text(table)))
    else:
        data = (folder / which).read_bytes()
        if rng.random() < 0.5:  # the header alone
            size = struct.unpack("<Q", data[:8])[0]
            head = json_text(spoiled(rng, json.loads(data[8 : 8 + size]))).encode("utf-8", "surrogatepass")
            data = struct.pack("<Q", rng.choice((len(head), 2**31, 2**63, 0))) + head + data[8 + size :]
        else:
            data = damaged(rng, data)
        (folder / which).write_bytes(data)
        import hashlib

        table = json.loads((folder / "policy.json").read_text())
        table["weights_sha256"] = hashlib.sha256(data).hexdigest()
        (folder / "policy.json").write_text(json.dumps(table))
    policy = load_policy(folder, rng.random() < 0.2)
    if rng.random() < 0.3:
        width, height = policy.size
        if 3 * policy.stack * width * height < 1 << 22:
            policy(np.zeros((3 * policy.stack, height, width), np.uint8))


def _onnx(case: Case) -> None:
    import onnx

    from twin.learn.policy import load_policy

    rng, path = case.rng, case.folder / "policy.onnx"
    data = (case.stuff.twin / "runs" / "ahead" / "policy.onnx").read_bytes()
    if rng.random() < 0.5:
        model = onnx.load_model_from_string(data)
        what = rng.randrange(7)
        if what == 0:
            dim = rng.choice(rng.choice((*model.graph.input, *model.graph.output)).type.tensor_type.shape.dim)
            dim.dim_value = rng.choice((0, -1, 1, 3, 2**31, 2**62))
        elif what == 1:
            note = {"format": "twin policy", "version": 2, "control": {"action": "twist", "speed": 1.0}}
            model.metadata_props.add(
                key="twin", value=json_text(spoiled(rng, note)).encode("utf-8", "replace").decode()
            )
        elif what == 2:
            one = rng.choice(model.graph.initializer)
            one.data_location = onnx.TensorProto.EXTERNAL
            one.external_data.add(key="location", value=OUTSIDE)
        elif what == 3:
            node = rng.choice(model.graph.node)
            node.op_type = rng.choice(("Loop", "NoSuch", "Identity", "Resize", "", "Relu"))
        elif what == 4:
            del model.graph.node[rng.randrange(len(model.graph.node))]
        elif what == 5:
            one = rng.choice(model.graph.initializer)
            one.dims[:] = [rng.choice((0, -1, 2**31, 2**40)) for _ in one.dims]
        else:
            model.opset_import[0].version = rng.choice((0, -1, 1, 999))
        data = model.SerializeToString()
    else:
        data = damaged(rng, data)
    path.write_bytes(data)
    load_policy(path, rng.random() < 0.2)


def ahead(stack: np.ndarray) -> tuple[float, float]:
    """A callable that is a policy."""
    return 1.0, 0.0


_CALLABLES = (
    *(
        *(f"{__name__}:ahead",) * 4,
        "math:pi",
        "math:floor",
        "builtins:len",
        "operator:not_",
        "json:nothing",
        "a.b:c",
        ":",
        "::",
        "a:",
        ":a",
        ".os:x",
    ),
    *(
        "nothing:f",
        "math:",
        "math:.",
        "math.x:y",
        "..:..",
        "no such:f",
        "math:sin",
        "builtins:repr",
        "builtins:complex",
    ),
    *("builtins:iter", "builtins:int", "operator:index", "operator:neg", "numpy:ravel", "numpy:mean", "numpy:array"),
)


def _callable(case: Case) -> None:
    from twin.learn.policy import load_policy

    rng = case.rng
    name = rng.choice(_CALLABLES)
    if rng.random() < 0.4:
        text = word(rng)
        name = rng.choice((f"{text}:{text}", f"{text}:f", f"math:{text}", text))
        if Path(OUTSIDE).name in name:
            name = f"nothing:{name}"
    load_policy(name, False)


def _zip(case: Case) -> None:
    from twin.learn.policy import load_policy

    path = case.folder / "policy.zip"
    data = case.rng.choice(list(case.stuff.zips.values()))
    path.write_bytes(damaged(case.rng, data) if case.rng.random() < 0.5 else data)
    load_policy(path, False)


# ---- what twin itself wrote


def _lighting(case: Case) -> None:
    import twin
    from twin.scene import stage_result

    root = case.folder / "scene"
    (root / "lightings").mkdir(parents=True)
    shutil.copyfile(case.stuff.twin / "scene.toml", root / "scene.toml")
    (root / "build").symlink_to(case.stuff.twin / "build")
    scene = twin.load_scene(root).scene
    table = {"format": 2, "name": "dusk", "embedding": [0.1, 0.2, 0.3, 0.4], "field": stage_result(scene, "field")}
    table |= {"air": {"extinction": 0.01, "airlight": [0.5, 0.5, 0.5]}, "photo": "a.jpg", "figures": {"psnr": 20.0}}
    text = mangled_text(case.rng, json_text(spoiled(case.rng, table)))
    name = case.rng.choice(("dusk", "dusk", "day", "training", "a b", "a:b", "+randomised"))
    (root / "lightings" / f"{name}.json").write_bytes(text)
    twin.load_scene(root).field()


_STAGES = ("2_metric", "3_field", "4_mesh", "5_mjcf")


def _damage_stage(rng: Random, root: Path, good: Path, sealed: bool) -> str:
    """A copy of a built scene (its whole stages are links) in which one file is damaged; returns the stage's folder."""
    from twin.scene import write_stamp

    (root / "build").mkdir(parents=True)
    shutil.copyfile(good / "scene.toml", root / "scene.toml")
    stage = rng.choice(_STAGES)
    for name in _STAGES:
        if name == stage:
            shutil.copytree(good / "build" / name, root / "build" / name)
        else:
            (root / "build" / name).symlink_to(good / "build" / name)
    folder = root / "build" / stage
    names = sorted(p for p in folder.rglob("*") if p.is_file() and (p.name != "stamp.json" or not sealed))
    path = rng.choice(names)
    if path.suffix == ".json" and rng.random() < 0.7:
        path.write_bytes(mangled_text(rng, json_text(spoiled(rng, json.loads(path.read_text())))))
    elif path.suffix == ".npz" and rng.random() < 0.5:
        _spoil_arrays(rng, path)
    else:
        path.write_bytes(damaged(rng, path.read_bytes()))
    if rng.random() < 0.05:
        path.unlink()
    if sealed:
        write_stamp(folder, {"2_metric": "metric", "3_field": "field", "4_mesh": "mesh", "5_mjcf": "mjcf"}[stage])
    return stage


def _spoil_arrays(rng: Random, path: Path) -> None:
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    name = rng.choice(sorted(arrays))
    one = arrays[name]
    what = rng.randrange(6)
    if what == 0:
        del arrays[name]
    elif what == 1:
        arrays[name] = one[:1] if one.ndim else np.zeros((2, 2))
    elif what == 2:
        arrays[name] = one.astype(rng.choice(("U8", "f4", "i8", "c16", "?", "O")))  # type: ignore[arg-type]
    elif what == 3:
        arrays[name] = np.full(one.shape, rng.choice((np.nan, np.inf, -1.0, 1e308)))
    elif what == 4:
        arrays[name + "_more"] = arrays.pop(name)
    else:
        arrays[name] = np.zeros((0, *one.shape[1:]))
    np.savez(path, **arrays)  # type: ignore[arg-type]


def _built(case: Case) -> None:
    import twin
    from twin.assets.ground import Ground

    root = case.folder / "scene"
    stage = _damage_stage(case.rng, root, case.stuff.twin, sealed=case.rng.random() < 0.6)
    scene = twin.load_scene(root)
    if stage == "2_metric":
        scene.cameras()
    elif stage == "3_field":
        scene.field()
    elif stage == "5_mjcf":
        scene.world()
    else:
        from twin.scene import require_stage

        Ground.load(require_stage(scene.scene, "mesh"))


def _parts(case: Case) -> None:
    """Files of stages by themselves: points, captures and cameras."""
    from twin.capture.capture_data import Capture, SourceInfo
    from twin.geometry.cameras import Cameras, SparsePoints

    rng, folder = case.rng, case.folder / "stage"
    folder.mkdir()
    which = rng.randrange(3)
    if which == 0:
        n = np.zeros(4, np.int64)
        SparsePoints(np.zeros((2, 3)), np.zeros((2, 3), np.uint8), np.zeros(2), n, n).save(folder)
        load: Callable[[Path], Any] = SparsePoints.load
    elif which == 1:
        info = SourceInfo("day", "day", "video", 32, 24, "PINHOLE", (30.0, 30.0, 16.0, 12.0), True, 1.2)
        n = np.zeros(2, np.int64)
        Capture((info,), ("day/000000", "day/000001"), n, np.arange(2.0), n > 0, np.full((2, 3), np.nan)).save(folder)
        load = Capture.load
    else:
        for name in ("cameras.json", "cameras.npz"):
            shutil.copyfile(case.stuff.twin / "build" / "2_metric" / name, folder / name)
        load = Cameras.load
    path = rng.choice(sorted(folder.iterdir()))
    if path.suffix == ".json":
        path.write_bytes(mangled_text(rng, json_text(spoiled(rng, json.loads(path.read_text())))))
    elif rng.random() < 0.5:
        _spoil_arrays(rng, path)
    else:
        path.write_bytes(damaged(rng, path.read_bytes()))
    load(folder)


def _forecast(case: Case) -> None:
    from twin.evaluation.forecasting import Forecast

    table = spoiled(case.rng, case.stuff.forecast)
    (case.folder / "forecast.json").write_bytes(mangled_text(case.rng, json_text(table)))
    Forecast.load(case.folder)


def _noted(case: Case) -> None:
    """JSON beside runs and validations."""
    from twin.evaluation.training_curves import CHOICE_FILE, training_summaries, write_success_curve
    from twin.learn import sac, training
    from twin.scene import digest_file

    rng, root = case.rng, case.folder / "scene"
    which = rng.random()
    if which < 0.4:
        shutil.copytree(case.stuff.twin / "runs" / "ahead", root / "runs" / "ahead")
        head = root / "runs" / "ahead" / "policy.json"
        table = json.loads(head.read_text())
        if rng.random() < 0.5:
            table["trained"] = spoiled(rng, table["trained"])
        head.write_bytes(json_text(table).encode("utf-8", "surrogatepass"))
        noted: dict[str, Any] = {"roads": {"ahead, day": "x"}, "policies": {"ahead": digest_file(head)}}
        (root / "validation").mkdir()
        text = json_text(spoiled(rng, noted) if rng.random() < 0.5 else noted)
        (root / "validation" / "validated.json").write_bytes(mangled_text(rng, text))
        training_summaries(root, ["ahead", "left", "ahead/100", rng.choice(("", "..", "/", "a" * 300, "../ahead"))])
    elif which < 0.6:
        root.mkdir()
        said = {"road": "x", "steps": 100, "seed": 0, "task": "ahead"}
        (root / "config.json").write_bytes(mangled_text(rng, json_text(spoiled(rng, said))))
        training._check_same(root, said)
    elif which < 0.9:
        (root / "state").mkdir(parents=True)
        names = [name for name in vars(sac).values() if isinstance(name, str) and name.endswith(".json")]
        for name in names:
            told = {"steps": 100, "updates": 50, "resumed": 0}
            (root / "state" / name).write_bytes(mangled_text(rng, json_text(spoiled(rng, told))))
        sac.saved_steps(root / "state")
    else:
        root.mkdir()
        (root / "episodes.csv").write_text(TRAINING_CSV)
        one = {"step": 100, "trials": 8, "successes": 4, "reward": 1.0}
        choice = {"steps": 200, "candidates": [one, one | {"step": 150}], "chosen": one | {"trials": 20}}
        (root / CHOICE_FILE).write_bytes(mangled_text(rng, json_text(spoiled(rng, choice))))
        write_success_curve(root)


# ---- keywords and actions


def _keywords(rng: Random, kind: type) -> dict[str, Any]:
    names = [one.name for one in dataclasses.fields(kind)]
    out = {rng.choice(names): anything(rng) for _ in range(rng.choice((1, 1, 2)))}
    if rng.random() < 0.05:
        out[word(rng)] = anything(rng)
    return out


def _options(case: Case) -> None:
    from twin.env.domain_randomization import Ranges
    from twin.env.options import Options, Rewards, parse_options

    given = _keywords(case.rng, Options)
    what = case.rng.random()
    if what < 0.1:
        given["rewards"] = _keywords(case.rng, Rewards)
    elif what < 0.2:
        known = {one.name for one in dataclasses.fields(Ranges)}
        ranges = {k: v for k, v in _keywords(case.rng, Ranges).items() if k in known}
        given["randomise"] = Ranges(**ranges)
    parse_options(given)


def _train_config(case: Case) -> None:
    from twin.learn.train_config import TrainConfig

    given = {k: v for k, v in _keywords(case.rng, TrainConfig).items() if k in TrainConfig.__dataclass_fields__}
    TrainConfig(**given)


def _actions(case: Case) -> bool:
    rng, environment = case.rng, case.stuff.environment
    environment.reset()
    good = np.array([0.5, 0.1])
    what = rng.random()
    if what < 0.5:
        action: Any = anything(rng)
    elif what < 0.8:
        action = [rng.choice((0.5, float("nan"), float("inf"), 1e308, -1e308, -1, None, "a", 10**400)) for _ in "ab"]
    else:
        arrays = (np.zeros(3), np.zeros((1, 2)), np.full(2, np.nan), np.array(["a", "b"]), np.zeros(2, complex), good)
        action = rng.choice([*arrays, np.array([None, None]), np.zeros(2, bool), np.zeros((2, 0)), good.astype("f4")])
    accepted = True
    try:
        environment.step(action)
    except ValueError as error:
        if "\n" in str(error) or len(str(error)) > 1700:
            raise Broken(f"refused in a long message: {str(error)[:200]!r}") from None
        accepted = False
    after = environment.step(good)
    for name, value in after.observation.items():
        if not np.isfinite(np.asarray(value, float)).all():
            raise Broken(f"{name} is not finite after {str(action)[:100]}")
    if not accepted:
        raise InputError("refused")
    return True


# ---- odd paths


def _path(case: Case) -> None:
    rng = case.rng
    name, read = rng.choice(_readers(case.stuff))
    folder, suffix = case.folder, Path(name).suffix
    path = folder / name
    what = rng.randrange(14)
    if what == 0:
        os.mkfifo(path)
    elif what in (1, 2):
        path.symlink_to("/dev/null" if what == 1 else "/dev/zero")
    elif what == 3:
        path.mkdir()
    elif what == 4:
        path.symlink_to(folder / "nothing")
    elif what == 5:
        path.symlink_to(path)
    elif what == 6:
        at = os.getcwd()  # noqa: PTH109
        os.chdir(folder)  # or its name would be too long
        try:
            with socket.socket(socket.AF_UNIX) as one:
                one.bind(name)
        finally:
            os.chdir(at)
    elif what == 7:
        path = folder / ("x" * 300 + suffix)
    elif what == 8:
        path = folder / f"a\nb\x1b[31m{suffix}"
        path.write_bytes(b"a\nb")
    elif what == 9:
        path = folder / f"a\x00b{suffix}"
    elif what == 10:
        path = folder / os.fsdecode(b"\xff\xfe" + suffix.encode())
        path.write_bytes(b"\xff")
    elif what == 11:
        path.write_bytes(b"")
    elif what == 12:
        path = Path("/dev/zero") if rng.random() < 0.5 else Path()
    else:
        path = folder / "file" / name
        (folder / "file").write_bytes(b"")
    read(path)


def _readers(stuff: Stuff) -> list[tuple[str, Callable[[Path], Any]]]:
    from twin.assets.ground import Ground
    from twin.capture import formats, frames
    from twin.capture.capture_data import Capture, read_mask
    from twin.capture.photos import load_photo
    from twin.capture.video import probe
    from twin.config_file import load_config, read_robot
    from twin.evaluation.forecasting import Forecast
    from twin.evaluation.training_curves import read_episodes
    from twin.evaluation.trials import read_results, read_trials
    from twin.geometry.cameras import Cameras, SparsePoints
    from twin.geometry.images import read_image
    from twin.learn.policy import load_policy
    from twin.mjcf.world import World
    from twin.nerf.baked import BakedField
    from twin.scene import Stamp
    from twin.sysid.logs import read_log

    return [
        ("scene.toml", load_config),
        ("robot.toml", read_robot),
        ("transforms.json", formats.read_transforms),
        ("cameras.txt", lambda p: formats.read_colmap(p.parent)),
        ("cameras.bin", lambda p: formats.read_colmap(p.parent)),
        ("photo.png", lambda p: load_photo(p, None)),
        ("photo.jpg", formats.image_size),
        ("image.png", read_image),
        ("mask.png", lambda p: read_mask(p, 8, 8)),
        ("film.mp4", probe),
        ("any.mp4", frames.detect_kind),
        ("results.csv", lambda p: read_results(p, stuff.cells)),
        ("table.csv", read_trials),
        ("episodes.csv", lambda p: read_episodes(p.parent)),
        ("log.csv", read_log),
        ("log.npz", read_log),
        ("policy.json", load_policy),
        ("policy.onnx", load_policy),
        ("policy.zip", load_policy),
        ("forecast.json", lambda p: Forecast.load(p.parent)),
        ("ground.npz", lambda p: Ground.load(p.parent)),
        ("points.npz", lambda p: SparsePoints.load(p.parent)),
        ("capture.json", lambda p: Capture.load(p.parent)),
        ("cameras.json", lambda p: Cameras.load(p.parent)),
        ("world.json", lambda p: World.load(p.parent)),
        ("baked.json", lambda p: BakedField.load(p.parent)),
        ("stamp.json", lambda p: Stamp.verified(p.parent)),
    ]


# ---- verbs

_VALUES = (
    *(
        "",
        " ",
        "-1",
        "0",
        "1",
        "nan",
        "inf",
        "-inf",
        "1e400",
        "abc",
        "9" * 5000,
        "1" + "0" * 400,
        "²",
        "\udcff",
        "a\nb",
    ),
    *(OUTSIDE, "/", "..", ".", "x" * 300, "a:b:c", "straight", "nothing", "\x1b[31m", "--", "None", "1.5", "%s", "{}"),
)


def _options_of(name: str) -> dict[str, Sequence[str]]:
    """A verb's options that take a value, with further values for each; where it writes to is always in the case."""
    return {
        "build": {"--until": ("mesh", "review"), "--force": ("mesh",), "--device": ("cuda", "tpu"), "--set": ()},
        "train": {
            **dict.fromkeys(("--task", "--run", "--lighting", "--steps", "--worlds", "--processes", "--updates"), ()),
            **dict.fromkeys(
                ("--steering", "--entropy", "--colours", "--seed", "--observe", "--preset", "--action"), ()
            ),
        },
        "validate": {
            "--policy": ("ahead", "math:floor", "nothing:f", "ahead/100"),
            "--lightings": ("day", "training", "+randomised", "held-out"),
            **dict.fromkeys(("--task", "--episodes", "--processes"), ()),
        },
        "forecast": {"--real": ("results.csv", "/dev/null", "/dev/zero"), "--seed": ()},
        "align": {"--out": ("OUT",)},
        "relight": {"--name": ("training", "day", "afternoon", "a/b")},
        "export": {"--glb": ("OUT", "OUT/x.glb"), "--ply": ("OUT",), "--lighting": ("day:night:2", "day")},
        "film": {
            **dict.fromkeys(("--task", "--lighting", "--obstacles", "--seed"), ()),
            "--policy": ("ahead", "math:floor"),
            "--out": ("OUT",),
        },
        "new": {"--camera-height": ()},
        "reality": {},
    }[name]


_FLAGS = {
    "train": ("--randomise", "--no-privileged"),
    "validate": ("--worst", "--films", "--trust"),
    "align": ("--level",),
    "film": ("--drift", "--randomise", "--trust"),
}
_POSITIONALS = {"align": 1, "relight": 1, "new": 1}
_REQUIRED = {"train": ("--run", "r"), "validate": ("--policy", "ahead"), "relight": ("--name", "dusk")}
VERBS = ("build", "train", "validate", "forecast", "align", "relight", "export", "film", "new", "reality")


def _scene_of(case: Case) -> str:
    """A scene that no verb can do minutes of work with."""
    rng, root = case.rng, case.folder / "scene"
    what = rng.choice(("unbuilt", "missing", "file", "junk", "damaged"))
    if what == "missing":
        return str(root) if rng.random() < 0.5 else rng.choice(("", "/nothing", "x" * 300, "a\nb", "/dev/null"))
    if what == "file":
        root.write_bytes(b"x")
        return str(root)
    if what == "damaged" and case.stuff is not None:
        root.mkdir()
        _damage_all(rng, root, case.stuff.twin)
        return str(root)
    (root / "input").mkdir(parents=True)
    text = toml_text({**_SCENE, "obstacle": []})
    (root / "scene.toml").write_bytes(text.encode() if what == "unbuilt" else mangled_text(rng, text + "x = 1\n"))
    if rng.random() < 0.5:
        (root / "input" / "day.mp4").write_bytes(rng.choice((b"", b"no film" * 100)))
    for name in ("validation", "forecast", "runs", "lightings"):
        if rng.random() < 0.1:
            (root / name).write_bytes(b"in the way")
    if rng.random() < 0.3 and not (root / "validation").exists():
        (root / "validation").mkdir()
        (root / "validation" / "episodes.csv").write_bytes(_table(rng, EPISODES_CSV))
    return str(root)


def _damage_all(rng: Random, root: Path, good: Path) -> None:
    """A built scene of which every stage misses a byte somewhere, so that none can be opened."""
    for name in ("scene.toml", "runs", "build"):
        source = good / name
        shutil.copytree(source, root / name) if source.is_dir() else shutil.copyfile(source, root / name)
    for stage in _STAGES:
        names = sorted(p for p in (root / "build" / stage).rglob("*") if p.is_file() and p.name != "stamp.json")
        path = rng.choice(names)
        path.write_bytes(path.read_bytes()[:-1])


def command_of(case: Case) -> tuple[str, list[str]]:
    """A verb's module and arguments that it must refuse, or be done with at once."""
    rng = case.rng
    name = rng.choice(VERBS)
    if name == "reality":
        return "twin.reality", _reality(case)
    arguments = [_scene_of(case)]
    if name == "new":
        arguments = [str(case.folder / rng.choice(("made", "made", "a\nb", "x" * 300)))]
    for _ in range(_POSITIONALS.get(name, 0)):
        path = case.folder / rng.choice(("log.csv", "log.npz", "film.mp4", "photo.jpg", "folder", "nothing.png"))
        what = rng.random()
        if path.name == "folder":
            path.mkdir()
        elif what < 0.6:
            path.write_bytes(rng.choice((b"", b"x" * 99, b"\x00" * 99, b"time,x\n1,2\n")))
        elif what < 0.8:
            os.mkfifo(path)
        arguments.append(str(path) if what < 0.9 else rng.choice(("", "/dev/null", "/dev/zero", "x" * 300)))
    if name in _REQUIRED and rng.random() < 0.9:
        arguments += _REQUIRED[name]
    options = _options_of(name)
    for option in rng.sample(sorted(options), min(len(options), rng.choice((0, 1, 1, 2)))):
        own = options[option]
        value = rng.choice(own) if own and rng.random() < 0.6 else rng.choice(_VALUES)
        if option == "--set":
            value = _override(rng)[:100_000].replace("\x00", "")
            value = value.encode("utf-8", "surrogateescape" if "\ud800" not in value else "replace").decode(
                "utf-8", "replace"
            )
        if option in ("--out", "--glb", "--ply"):  # where the user wants it is written to
            value = str(case.folder / value[:250].strip("/").replace("..", "")) if value else ""
        arguments += [option, value] if rng.random() < 0.9 else [f"{option}={value}"]
    arguments += [flag for flag in _FLAGS.get(name, ()) if rng.random() < 0.3]
    if rng.random() < 0.05:
        arguments.append(rng.choice(("--nothing", "--", "-", "-x", "--help=1", *_VALUES)))
    if name != "new":
        arguments.append("--quiet")
    return f"twin.{name}", arguments


def _reality(case: Case) -> list[str]:
    """Arguments that the known-truth world refuses before it builds anything."""
    rng = case.rng
    out = str(case.folder / "out.csv")
    hostile = [value for value in _VALUES if value not in ("1", "1.5")]
    return rng.choice(
        (
            [],
            [rng.choice(_VALUES)],
            ["log", "--out", out, "--duration", rng.choice(("nan", "-inf", "-1", "0", "abc", "", "9.99", "x" * 300))],
            ["log"],
            ["photo", "--out", out, "--lighting", rng.choice(hostile)],
            ["photo", "--lighting", "dawn"],
            ["film", "--out", out, "--lightings", rng.choice(hostile)],
            ["drive", "--policy", rng.choice(hostile), "--task", "nothing", "--out", out],
            ["drive", "--policy", str(case.folder / "no.onnx"), "--task", "straight", "--out", out],
            [
                "drive",
                "--policy",
                "a",
                "--task",
                "straight",
                "--out",
                out,
                "--trials",
                rng.choice(("-1", "0", "a", "1.5")),
            ],
        )
    )


def _verb(case: Case) -> bool:
    module, arguments = command_of(case)
    name = f"{module}.__main__" if module == "twin.reality" else module
    return call_verb(importlib.import_module(name).main, arguments)


TARGETS = (
    Target("scene.toml", 10, _scene),
    Target("robot.toml", 4, _robot),
    Target("overrides", 5, _overrides),
    Target("transforms", 6, _transforms),
    Target("colmap text", 4, _colmap_text),
    Target("colmap binary", 4, _colmap_binary),
    Target("image", 8, _image),
    Target("exif", 4, _exif),
    Target("film", 4, _film),
    Target("results", 4, _results),
    Target("episodes", 4, _episodes),
    Target("training", 3, _training),
    Target("log csv", 4, _log_csv),
    Target("log npz", 5, _log_npz),
    Target("policy folder", 6, _policy_folder),
    Target("onnx", 5, _onnx),
    Target("callable", 3, _callable),
    Target("zip", 2, _zip),
    Target("lighting", 4, _lighting),
    Target("built", 6, _built),
    Target("parts", 4, _parts),
    Target("forecast", 4, _forecast),
    Target("noted", 3, _noted),
    Target("options", 6, _options),
    Target("train config", 4, _train_config),
    Target("actions", 4, _actions),
    Target("path", 8, _path),
    Target("verb", 8, _verb),
)
