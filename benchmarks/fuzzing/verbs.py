"""Fuzz target of verbs (subcommands of `twin`): command lines that a verb must refuse or finish quickly."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from random import Random

from fuzzing.artifacts import STAGES
from fuzzing.cases import Case, call_verb
from fuzzing.samples import EPISODES_CSV, SCENE_TABLE
from fuzzing.settings import override
from fuzzing.tables import mutated_csv
from fuzzing.values import OUTSIDE_PATH, mutated_text, toml_text
from twin.__main__ import main

VERBS = ("build", "train", "validate", "forecast", "align", "relight", "export", "film", "new", "pack", "reality")
_VALUES = (
    *("", " ", "-1", "0", "1", "nan", "inf", "-inf", "1e400", "abc", "9" * 5000, "1" + "0" * 400, "²", "\udcff"),
    *("a\nb", OUTSIDE_PATH, "/", "..", ".", "x" * 300, "a:b:c", "straight", "nothing", "\x1b[31m", "--", "None"),
    *("1.5", "%s", "{}"),
)
_OPTIONS: dict[str, dict[str, Sequence[str]]] = {
    "build": {"--until": ("mesh", "review"), "--force": ("mesh",), "--device": ("cuda", "tpu"), "--set": ()},
    "train": {
        **dict.fromkeys(
            ("--task", "--run", "--lighting", "--steps", "--teacher-steps", "--worlds", "--processes", "--updates"), ()
        ),
        **dict.fromkeys(("--steering", "--entropy", "--colours", "--seed", "--observe", "--preset", "--action"), ()),
        "--device": ("cuda", "tpu"),
    },
    "validate": {
        "--policy": ("ahead", "math:floor", "nothing:f", "ahead/100"),
        "--lightings": ("day", "training", "+randomised", "held-out"),
        **dict.fromkeys(("--task", "--episodes", "--processes"), ()),
    },
    "forecast": {"--real": ("results.csv", "/dev/null", "/dev/zero"), "--seed": ()},
    "align": {"--out": ("OUT",)},
    "relight": {"--name": ("training", "day", "afternoon", "a/b")},
    "export": {
        **dict.fromkeys(("--ply", "--nerfstudio", "--colmap"), ("OUT",)),
        "--usd": ("OUT/x.usdz", "OUT"),
        "--glb": ("OUT", "OUT/x.glb"),
        "--lighting": ("day:night:2", "day"),
    },
    "pack": {"--out": ("OUT", "OUT/x.twin"), "--levels": ("6", "17"), "--policy": ("nothing",)},
    "film": {
        **dict.fromkeys(("--task", "--lighting", "--obstacles", "--seed"), ()),
        "--policy": ("ahead", "math:floor"),
        "--out": ("OUT",),
    },
    "new": {"--camera-height": ()},
}
"""Options of a verb that take a value, each with further values besides `_VALUES`."""
_OUTPUTS = ("--out", "--glb", "--ply", "--usd", "--nerfstudio", "--colmap")
_FLAGS = {
    "train": ("--randomise", "--no-randomise"),
    "validate": ("--worst", "--films", "--trust"),
    "align": ("--level",),
    "film": ("--drift", "--randomise", "--trust"),
}
_POSITIONALS = {"align": 1, "relight": 1, "new": 1}
"""Number of paths after the scene."""
_REQUIRED = {"train": ("--run", "r"), "validate": ("--policy", "ahead"), "relight": ("--name", "dusk")}


def verb(case: Case) -> bool:
    return call_verb(main, command_of(case))


def command_of(case: Case) -> list[str]:
    """Arguments of `twin`: a verb and the verb's arguments."""
    rng = case.rng
    name = rng.choice(VERBS)
    if name == "reality":
        return ["reality", *_reality(case)]
    arguments = [_scene(case)]
    if name == "new":
        arguments = [str(case.folder / rng.choice(("made", "made", "a\nb", "x" * 300)))]
    arguments += [_positional(case) for _ in range(_POSITIONALS.get(name, 0))]
    if name in _REQUIRED and rng.random() < 0.9:
        arguments += _REQUIRED[name]
    options = _OPTIONS[name]
    for option in rng.sample(sorted(options), min(len(options), rng.choice((0, 1, 1, 2)))):
        value = _value(case, option, options[option])
        arguments += [option, value] if rng.random() < 0.9 else [f"{option}={value}"]
    arguments += [flag for flag in _FLAGS.get(name, ()) if rng.random() < 0.3]
    if rng.random() < 0.05:
        arguments.append(rng.choice(("--nothing", "--", "-", "-x", "--help=1", *_VALUES)))
    if name != "new":
        arguments.append("--quiet")
    return [name, *arguments]


def _positional(case: Case) -> str:
    """A log, film, photo, folder or missing file; in some cases a pipe or a hostile path."""
    rng = case.rng
    path = case.folder / rng.choice(("log.csv", "log.npz", "film.mp4", "photo.jpg", "folder", "nothing.png"))
    what = rng.random()
    if path.name == "folder":
        path.mkdir()
    elif what < 0.6:
        path.write_bytes(rng.choice((b"", b"x" * 99, b"\x00" * 99, b"time,x\n1,2\n")))
    elif what < 0.8:
        os.mkfifo(path)
    return str(path) if what < 0.9 else rng.choice(("", "/dev/null", "/dev/zero", "x" * 300))


def _value(case: Case, option: str, valid: Sequence[str]) -> str:
    rng = case.rng
    value = rng.choice(valid) if valid and rng.random() < 0.6 else rng.choice(_VALUES)
    if option == "--set":
        value = override(rng)[:100_000].replace("\x00", "")
        errors = "surrogateescape" if "\ud800" not in value else "replace"
        value = value.encode("utf-8", errors).decode("utf-8", "replace")
    if option in _OUTPUTS:  # a verb writes where the user asks; this keeps outputs in the case's folder
        value = str(case.folder / value[:250].strip("/").replace("..", "")) if value else ""
    return value


def _scene(case: Case) -> str:
    """A scene on which every verb ends soon: missing, a file, not built, invalid, or with truncated stages."""
    rng, root = case.rng, case.folder / "scene"
    what = rng.choice(("unbuilt", "missing", "file", "junk", "damaged"))
    if what == "missing":
        return str(root) if rng.random() < 0.5 else rng.choice(("", "/nothing", "x" * 300, "a\nb", "/dev/null"))
    if what == "file":
        root.write_bytes(b"x")
        return str(root)
    if what == "damaged" and case.samples is not None:
        root.mkdir()
        _copy_with_truncated_stages(rng, root, case.samples.twin)
        return str(root)
    (root / "input").mkdir(parents=True)
    text = toml_text({**SCENE_TABLE, "obstacle": []})
    (root / "scene.toml").write_bytes(text.encode() if what == "unbuilt" else mutated_text(rng, text + "x = 1\n"))
    if rng.random() < 0.5:
        (root / "input" / "day.mp4").write_bytes(rng.choice((b"", b"no film" * 100)))
    for name in ("validation", "forecast", "runs", "lightings"):
        if rng.random() < 0.1:
            (root / name).write_bytes(b"in the way")
    if rng.random() < 0.3 and not (root / "validation").exists():
        (root / "validation").mkdir()
        (root / "validation" / "episodes.csv").write_bytes(mutated_csv(rng, EPISODES_CSV))
    return str(root)


def _copy_with_truncated_stages(rng: Random, root: Path, good: Path) -> None:
    """Copies a built scene and cuts the last byte of one file of every stage, so that no stage can be opened."""
    for name in ("scene.toml", "runs", "build"):
        source = good / name
        shutil.copytree(source, root / name) if source.is_dir() else shutil.copyfile(source, root / name)
    for stage in STAGES:
        names = sorted(p for p in (root / "build" / stage).rglob("*") if p.is_file() and p.name != "stamp.json")
        path = rng.choice(names)
        path.write_bytes(path.read_bytes()[:-1])


def _reality(case: Case) -> list[str]:
    """Arguments that `twin.reality` refuses before it builds anything."""
    rng = case.rng
    out = ["--out", str(case.folder / "out.csv")]
    hostile = [value for value in _VALUES if value not in ("1", "1.5")]
    durations = ("nan", "-inf", "-1", "0", "abc", "", "9.99", "x" * 300)
    onnx = str(case.folder / "no.onnx")
    return rng.choice(
        (
            [],
            [rng.choice(_VALUES)],
            ["log", *out, "--duration", rng.choice(durations)],
            ["log"],
            ["photo", *out, "--lighting", rng.choice(hostile)],
            ["photo", "--lighting", "dawn"],
            ["film", *out, "--lightings", rng.choice(hostile)],
            ["drive", "--policy", rng.choice(hostile), "--task", "nothing", *out],
            ["drive", "--policy", onnx, "--task", "straight", *out],
            ["drive", "--policy", "a", "--task", "straight", *out, "--trials", rng.choice(("-1", "0", "a", "1.5"))],
        )
    )
