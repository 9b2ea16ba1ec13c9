"""A stopped verb prints one line, exits with 128 + n, leaves no partial file, and no process outlives it.

A verb runs in a process of its own. It is stopped as soon as it has started processes, which is when it has most to
lose.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
from test_damaged_input import _film, _noise
from textured import filmed_corridor, picture, pose_at
from tiny_runs import tiny_runs
from tiny_twin import tiny_twin

from twin import command_line, runtime
from twin.errors import InputError, print_error, shortened
from twin.geometry.images import write_image
from twin.nerf.buffers import Layout
from twin.nerf.field import untrained_field
from twin.scene import write_stamp

_PATIENCE = 120.0  # [s] until a verb has started what it starts
_WOULD_TAKE = {"validate": 900, "train": 100_000}  # episodes and steps; far more than a test waits for


@pytest.fixture(autouse=True)
def signals_as_in_a_terminal(monkeypatch):
    """Background jobs and nohup ignore some, and so would the verbs."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)}
    for number, handler in before.items():
        if handler is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@dataclass(frozen=True)
class Case:
    """A verb that starts processes."""

    arguments: tuple[str, ...]
    child: str
    """A word of its child's command line."""
    children: int = 1


def _corridor(root: Path) -> Path:
    """A place in which a photo can be registered, with a field of two lightings."""
    scene = filmed_corridor(root)
    frames = tuple(f"day/{i:06d}" for i in range(4))
    layout = Layout((0.0, 0.0, 0.0), (8.0, 8.0, 4.0), 0.1, 4, 2.0, 10, 32, 8)
    for stage in ("field", "mesh"):
        scene.stage(stage).mkdir()
    field = untrained_field([layout], ("day", "night"), frames, np.zeros(4, np.int64), 0, "cpu")
    field.save(scene.stage("field"))
    for stage in ("capture", "cameras", "metric", "field", "mesh"):
        write_stamp(scene.stage(stage), stage)
    return root


@pytest.fixture(scope="module")
def cases(tmp_path_factory) -> dict[str, Case]:
    """The verbs that start processes, each with its own scene."""
    folder = tmp_path_factory.mktemp("stopping")
    filmed = folder / "filmed"
    (filmed / "input").mkdir(parents=True)
    _film(filmed / "input" / "a.mp4", [_noise(i, (360, 640)) for i in range(60)])
    (filmed / "scene.toml").write_text(
        '[[source]]\npath = "input/a.mp4"\n[capture]\nfps = 10.0\nmin_motion = 0.0\n[metric]\ncamera_height = 1.2\n'
    )
    driven = tiny_twin(folder / "driven")
    tiny_runs(driven)
    corridor = _corridor(folder / "corridor")
    write_image(corridor / "photo.png", picture(pose_at(2.4, 0.2), tint=(0.9, 0.6, 0.4)))
    many, steps = str(_WOULD_TAKE["validate"]), str(_WOULD_TAKE["train"])
    validate = ("--policy", "ahead", "--task", "ahead", "--lightings", "day", "--episodes", many, "--processes", "2")
    short = ("--teacher-steps", "8", "--processes", "2")
    train = ("--task", "ahead", "--lighting", "day", "--run", "new", "--steps", steps, *short)
    return {
        "build": Case((str(filmed), "--until", "metric"), "twin.capture.worker"),
        "train": Case((str(driven), *train), "twin.env.vector_env import serve", 2),
        "validate": Case((str(driven), *validate), "multiprocessing.spawn", 2),
        "relight": Case((str(corridor), str(corridor / "photo.png"), "--name", "new"), "twin.capture.worker"),
    }


def _started(name: str, case: Case) -> tuple[subprocess.Popen, list[psutil.Process]]:
    """Waits until the verb has started its processes; returns the verb and all of these."""
    process = subprocess.Popen(
        [sys.executable, "-m", f"twin.{name}", *case.arguments, "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
    )
    until = time.monotonic() + _PATIENCE
    while time.monotonic() < until and process.poll() is None:
        children = psutil.Process(process.pid).children(recursive=True)
        named = [one for one in children if case.child in " ".join(_command(one))]
        if len(named) >= case.children:
            return process, children
        time.sleep(0.01)
    process.kill()
    raise AssertionError((process.returncode, *process.communicate()))


def _command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def _left(children: list[psutil.Process]) -> list[psutil.Process]:
    return psutil.wait_procs(children, timeout=5.0)[1]


# Signals are handled alike by all verbs, so that each gets two. A killed verb leaves its lock: these are last.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("build", signal.SIGTERM),
        ("train", signal.SIGINT),
        ("validate", signal.SIGHUP),
        ("relight", signal.SIGINT),
        ("relight", signal.SIGTERM),
        ("build", signal.SIGKILL),
        ("train", signal.SIGKILL),
        ("validate", signal.SIGKILL),
    ],
)
def test_nothing_outlives_a_verb(cases, name, number):
    process, children = _started(name, cases[name])
    # GLFW asks for its version in a process of its own, which dm_control starts when it is imported.
    alone = time.monotonic()
    while time.monotonic() < alone + 1.5:
        if any("glfwGetVersion" in " ".join(_command(one)) for one in psutil.Process(process.pid).children(True)):
            alone = time.monotonic()
        time.sleep(0.05)
    children += psutil.Process(process.pid).children(recursive=True)  # a teacher's processes have ended meanwhile
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert not _left(children)
    if number == signal.SIGKILL:
        return
    lines = [line for line in said.splitlines(keepends=True) if not line.startswith("Warp CUDA warning")]
    more = "" if name == "relight" else "; to continue, run the same command again"
    assert (process.returncode, lines) == (128 + number, [f"stopped{more}\n"])
    scene = Path(cases[name].arguments[0])
    assert not [path for path in scene.rglob("*") if ".partial" in path.name or path.name.endswith(".lock")]


def test_children_of_a_killed_decomposition_end(tmp_path):
    """Threads of the mesh stage start CoACD's processes."""
    script = f"""
import trimesh, numpy as np
from pathlib import Path
from twin.assets import convex
ball = trimesh.creation.icosphere(4)
def piece(k):
    bumps = 1.0 + 0.3 * np.sin(9.0 * ball.vertices + k).prod(1)
    return convex.SolidPiece.from_mesh(ball.vertices * bumps[:, None], ball.faces, lambda points: points[:, 0] > -9.0)
convex._run_coacd([piece(k) for k in range(40)], 0.01, Path({str(tmp_path)!r}), 0)
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    children: list[psutil.Process] = []
    until = time.monotonic() + _PATIENCE
    while len(children) < 2 and process.poll() is None and time.monotonic() < until:
        children = [c for c in psutil.Process(process.pid).children() if "twin.assets.convex" in _command(c)]
        time.sleep(0.02)
    assert len(children) == 2, process.communicate()
    time.sleep(0.5)
    process.kill()
    process.wait()
    assert not _left(children)


def _runs(work, *arguments: str, resumes=False) -> int:
    parser = command_line.Parser(prog="python -m twin.some")
    parser.set_defaults(resumes=resumes)
    return command_line.run(parser, lambda options: work(), list(arguments))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_is_one_line_and_handlers_are_restored(capfd, number):
    before = signal.getsignal(number)
    assert _runs(lambda: signal.raise_signal(number)) == 128 + number
    assert capfd.readouterr().err == "stopped\n"
    assert _runs(lambda: signal.raise_signal(number), resumes=True) == 128 + number
    assert capfd.readouterr().err == "stopped; to continue, run the same command again\n"
    assert signal.getsignal(number) is before


class _Thing:
    pass


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_a_callback_whose_errors_python_drops_is_not_lost(capfd, number):
    """Exceptions in callbacks of weak references, in __del__ and in those of the garbage collector are ignored."""
    hook, ended = sys.unraisablehook, []

    def work():
        thing = _Thing()
        reference = weakref.ref(thing, lambda _: signal.raise_signal(number))
        del thing
        assert reference() is None
        try:
            time.sleep(30)
        finally:
            ended.append(True)

    assert _runs(work) == 128 + number and ended == [True]
    assert capfd.readouterr().err == "stopped\n" and sys.unraisablehook is hook


def test_a_second_signal_before_the_first_is_sent_again_loses_no_cleanup(capfd):
    ended = []

    def work():
        thing = _Thing()
        reference = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGTERM))
        del thing
        assert reference() is None
        signal.raise_signal(signal.SIGHUP)
        try:
            time.sleep(30)
        finally:
            time.sleep(0.2)
            ended.append(True)

    assert _runs(work) == 128 + signal.SIGTERM and ended == [True]


def test_a_signal_during_an_import_is_one_line(capfd):
    """A module written in C that is interrupted while it is imported raises ImportError instead."""

    def work():
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    def broken():
        raise ImportError("no such library")

    assert _runs(work) == 128 + signal.SIGTERM and capfd.readouterr().err == "stopped\n"
    with pytest.raises(ImportError, match="no such library"):
        _runs(broken)


def test_threads_leave_the_hook_alone():
    hook, seen = sys.unraisablehook, []

    def work():
        with runtime.stoppable():
            seen.append(sys.unraisablehook)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [hook] and sys.unraisablehook is hook


def test_other_errors_that_python_drops_are_reported(monkeypatch):
    seen = []
    monkeypatch.setattr(sys, "unraisablehook", lambda what: seen.append(what.exc_type))

    def work():
        thing = _Thing()
        reference = weakref.ref(thing, lambda _: 1 / 0)
        del thing
        assert reference() is None

    assert _runs(work) == 0 and seen == [ZeroDivisionError]


def test_ignored_signals_stay_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert _runs(lambda: signal.raise_signal(signal.SIGHUP)) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_killed_child_with_a_bar_leaks_nothing(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import multiprocessing, os, signal\n"
        "from twin import runtime\n"
        "def work():\n"
        "    with runtime.bar('work', 2):\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "if __name__ == '__main__':\n"
        "    child = multiprocessing.get_context('spawn').Process(target=work)\n"
        "    child.start(), child.join()\n"
        "    raise SystemExit(child.exitcode + 9)\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert done.returncode == 0 and "leaked" not in done.stderr, done.stderr


def test_colmap_keeps_our_signal_handlers(tmp_path):
    script = (
        "import os, signal, twin.capture.formats, twin.capture.matching;"
        "from twin.command_line import *;"
        "raise SystemExit(run(Parser(), lambda o: os.kill(os.getpid(), signal.SIGTERM), []))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (
        128 + signal.SIGTERM,
        "stopped\n",
    )


def test_a_broken_pipe_ends_a_verb_quietly(tmp_path):
    script = "import sys; from twin.command_line import *; sys.exit(run(Parser(), lambda o: print('x' * 10**6), []))"
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout and process.stderr
    process.stdout.close()
    assert process.wait() == 128 + signal.SIGPIPE and process.stderr.read() == b""


def test_wrong_arguments_are_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        _runs(lambda: None, "--nonsense", "x" * 1000)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: unrecognized arguments: --nonsense") and said.count("\n") == 1 and len(said) < 500


@pytest.mark.parametrize(
    "value", ["x" * 10**6, "1" * 10**4, list(range(10**5)), "a'b" * 1000, "\x1b[31m\n" * 10**4, "ab " * 10**4]
)
def test_errors_cut_values_at_eighty_characters(capsys, value):
    print_error(InputError(f"scene.toml: key = {value!r}; expected a number"))
    said = capsys.readouterr().err
    assert said.startswith("error: scene.toml: key = ") and said.endswith("; expected a number\n")
    assert said.count("\n") == 1 and "\x1b" not in said and len(said) < 1600
    if isinstance(value, str) and "'" not in value:
        assert len(said) < 150


def test_ordinary_messages_are_not_cut():
    said = "the photos' focal lengths differ by more than one lens that is not zoomed shows, as the robot's do"
    assert shortened(said) == said
