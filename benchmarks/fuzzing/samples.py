"""Valid files and tables that fuzz cases start from, and the payload that must never run."""

import dataclasses
import io
import json
import pickle
import zipfile
from functools import cached_property
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

TRAINING_CSV = "step,wall_s,seed,lighting,success,cause,progress_m,steps,reward,start_m\n" + "".join(
    f"{10 * k},{k}.0,{k},day,{k % 2},goal,4.0,40,3.0,0.0\n" for k in range(1, 13)
)
EPISODES_CSV = "policy,task,lighting,seed,success,cause,progress_m,steps,trust\n" + "".join(
    f"{p},ahead,day,{k},{k % 2},{'goal' if k % 2 else 'collision'},3.5,40,0.9000\n" for p in "ab" for k in range(5)
)
RESULTS_CSV = "policy,lighting,trials,successes,task,twin_lighting\nahead,day,10,4,ahead,day\nleft,day,10,6,bend,\n"
SCENE_TABLE: dict[str, Any] = {
    "name": "tiny",
    "seed": 0,
    "source": [{"path": "input/day.mp4", "lighting": "day", "camera": {"model": "PINHOLE", "params": [9, 9, 5, 5]}}],
    "metric": {"camera_height": 1.2},
    "task": [{"name": "ahead", "start": 0.5, "length": 4.0}],
    "obstacle": [{"kind": "cone", "station": 2.0, "to": [3.0, 1.0], "color": [1, 0, 0]}],
}


def defaults_of(kind: type) -> dict[str, Any]:
    """Defaults of a config class as a TOML table."""
    values = dataclasses.asdict(kind()).items()
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values if value is not None}


def scene_table(rng: Random) -> dict[str, Any]:
    """`SCENE_TABLE` with the defaults of three more sections."""
    from twin.config import SceneConfig

    table = {**SCENE_TABLE}
    whole = defaults_of(SceneConfig)
    for name in rng.sample([n for n, v in whole.items() if isinstance(v, dict) and n != "metric"], 3):
        table[name] = {k: v for k, v in whole[name].items() if v is not None}
    return table


class Payload:
    """Writes the marker file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("import os, pathlib; pathlib.Path(os.environ['TWIN_FUZZ_MARKER']).write_text('ran')",)


class Samples:
    """Valid inputs, made once per process in `work/stuff` and read-only from then on."""

    def __init__(self, work: Path) -> None:
        self.folder = work / "stuff"
        self.folder.mkdir()
        _ = self.twin, self.film, self.bags  # made now, so that they do not appear as changes by a case

    @cached_property
    def twin(self) -> Path:
        """A small built scene with two policies, the table of a training and validated episodes."""
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
        """An mp4 film of ten frames."""
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
    def bags(self) -> dict[str, bytes]:
        """By suffix: ROS 2 bags with pictures, calibration, poses, fixes, transforms; a ROS 1 bag; metadata.yaml."""
        from bag_of_film import camera_info, drive, pictures, seat, write, write_ros1

        from twin.capture.camera_models import Lens

        frames = [np.full((24, 32, 3), 30 * k, np.uint8) for k in range(6)]
        times = np.arange(6) / 10.0
        lens = Lens("OPENCV", (30.0, 30.0, 16.0, 12.0, 0.1, 0.0, 0.0, 0.0), 32, 24)
        messages = [camera_info(lens), *seat(0.7, 0.3, 0.1), *drive(np.tile(np.eye(4), (6, 1, 1)), times)]
        messages += [*pictures(frames[:4], times[:4]), *pictures(frames, times, "png")]
        mcap = write(self.folder / "mcap", messages)
        sqlite = write(self.folder / "sqlite", messages, mcap=False)
        return {
            ".mcap": next(mcap.glob("*.mcap")).read_bytes(),
            ".db3": next(sqlite.glob("*.db3")).read_bytes(),
            ".bag": write_ros1(self.folder / "ros1.bag", frames, times).read_bytes(),
            "metadata.yaml": (mcap / "metadata.yaml").read_bytes(),
        }

    @cached_property
    def images(self) -> dict[str, bytes]:
        """A 32×24 image in every format, by suffix."""
        from PIL import Image

        pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        formats = {".png": "PNG", ".jpg": "JPEG", ".tif": "TIFF", ".webp": "WEBP", ".bmp": "BMP"}
        out = {}
        for suffix, name in formats.items():
            Image.fromarray(pixels).save(buffer := io.BytesIO(), name)
            out[suffix] = buffer.getvalue()
        return out

    @cached_property
    def log(self) -> dict[str, np.ndarray]:
        """A drive log of six seconds, columns by name."""
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
        """Validated cells of two policies on two tasks."""
        from twin.evaluation.trials import Cell

        return [Cell(p, t, "day", 10, 5) for p in ("ahead", "left") for t in ("ahead", "bend")]

    @cached_property
    def environment(self) -> Any:
        """An environment without pixels, after a reset."""
        import twin

        environment = twin.load(self.twin, "ahead", 0, pixels=False)
        environment.reset()
        return environment

    @cached_property
    def forecast(self) -> Any:
        """Parsed `forecast.json` of three policies."""
        from twin.evaluation.forecasting import make_forecast
        from twin.evaluation.trials import Cell

        twin = [Cell(p, "ahead", "day", 10, k) for p, k in (("a", 3), ("b", 6), ("c", 9))]
        real = [dataclasses.replace(c, trials=5, successes=c.successes // 2, twin_lighting="day") for c in twin]
        (folder := self.folder / "forecast").mkdir()
        make_forecast("tiny", twin, real).save(folder)
        return json.loads((folder / "forecast.json").read_text())

    @cached_property
    def zips(self) -> dict[str, bytes]:
        """Zips in the layout of stable-baselines3 with a pickled payload, by the member that holds it."""
        payload = pickle.dumps(Payload())
        members = {"data": b"{}", "policy.pth": payload, "pytorch_variables.pth": payload, "a.npy": payload}
        out = {}
        for name, content in members.items():
            buffer = io.BytesIO()
            with zipfile.ZipFile(buffer, "w") as archive:
                archive.writestr("data", b'{"policy_class": {":type:": "x", ":serialized:": "gASVAAAA"}}')
                archive.writestr(name, content)
            out[name] = buffer.getvalue()
        return out
