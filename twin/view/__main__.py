"""`twin view`: shows a built scene in the browser, and drives the Husky in it; or renders a camera path to a film.

    twin view scenes/demo --policy first --task straight
    twin view scenes/demo --path scenes/demo/paths/path.json --out film.mp4

The page is served to this machine alone unless `--host` names another address; the
printed address then has a token that the browser needs.
"""

import argparse
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from twin import commands, runtime
from twin.errors import InputError
from twin.files import require_output
from twin.loading import Twin, load_scene
from twin.scene import require_stage

if TYPE_CHECKING:
    from twin.env.episode_lighting import EpisodeLighting
    from twin.learn.policy import Policy
    from twin.view.page import Page

_HEAD_START = 6.0  # [s] longest wait for the first picture before the robot is loaded
_MIN_SIDE, _MAX_SIDE, _MAX_FPS = 16, 4096, 120  # limits of a film's sides [px] and frames per second
_PAGE_OPTIONS: tuple[str, ...] = ("task", "policy", "seed", "host", "port")
_FILM_OPTIONS: tuple[str, ...] = ("size", "fps")


def command(given: argparse.Namespace) -> None:
    """Runs `twin view` with the options parsed by `twin.commands`."""
    twin = load_scene(given.scene)
    if (given.path is None) != (given.out is None):
        raise InputError("--path and --out belong together; give both, such as --path path.json --out film.mp4")
    unused, cure = _FILM_OPTIONS, "only a film has it; give --path and --out, too"
    if given.path is not None:
        unused, cure = _PAGE_OPTIONS, "only the page has it, and --path renders a film; leave out one of them"
    for name in unused:
        if (value := getattr(given, name)) != commands.parser_of("view").get_default(name):
            raise InputError(f"--{name} {value}: {cure}")
    if given.path is not None:
        film_path(twin, given.path, given.out, given.size, given.fps, given.quiet, given.lighting)
    else:
        serve(twin, given)


def film_path(
    twin: Twin, path: Path, out: Path, size: str, fps: int, quiet: bool = False, lighting: str | None = None
) -> None:
    """Renders a camera path to an mp4; `lighting` is as for `CameraPath.load`.

    Raises:
        InputError: the scene is not built, or `path`, `size`, `fps`, `out` or `lighting` is not valid.
    """
    width, height = parse_size(size)
    if not 1 <= fps <= _MAX_FPS:
        raise InputError(f"--fps {fps}: expected 1 to {_MAX_FPS}")
    require_output(out, (".mp4",))
    from twin.view.camera_path import CameraPath, path_frames, write_path_film
    from twin.view.scene_picture import ScenePicture

    field = twin.field()
    track = CameraPath.load(path, field, lighting)
    with runtime.bar("film", len(path_frames(track, fps)), "frame") as progress:
        frames = write_path_film(
            out, track, ScenePicture(field), (width, height), fps, lambda done, total: progress.update()
        )
    if not quiet:
        print(f"{out}: {frames} frames, {track.duration:.1f} s")


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [px] of `1280x720`. Raises InputError for another form, odd sides, or sides out of range."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and len(part) < 6 for part in parts):
        raise InputError(f"--size {text!r}: expected WIDTHxHEIGHT, such as 1280x720")
    width, height = map(int, parts)
    if not all(_MIN_SIDE <= side <= _MAX_SIDE and side % 2 == 0 for side in (width, height)):
        raise InputError(f"--size {text!r}: expected even sides from {_MIN_SIDE} to {_MAX_SIDE} px")
    return width, height


def serve(twin: Twin, given: argparse.Namespace) -> None:
    """Serves the page until a signal stops the program; Ctrl+C is its normal end."""
    if not 0 <= given.port <= 65535:
        raise InputError(f"--port {given.port}: expected 0 to 65535")

    policy = _check_driver(twin, given)

    def announce(url: str) -> None:
        if not given.quiet:
            print(f"open {url} (Ctrl+C stops)", flush=True)

    page = open_page(twin, given.host, given.port, given.lighting, announce)
    try:
        page.viewer.loop.has_shown.wait(_HEAD_START)  # rendering the first picture needs all cores
        load_driving(page, given.task, policy, given.seed)
        threading.Event().wait()
    except runtime.Stopped as stop:
        if stop.number != signal.SIGINT:
            raise
    finally:
        page.viewer.close()


def open_page(
    twin: Twin,
    host: str = "127.0.0.1",
    port: int = 8080,
    lighting: str | None = None,
    announce: Callable[[str], None] = lambda url: None,
) -> "Page":
    """Opens the page of a built scene, without the robot.

    `announce` is called with the page's address as soon as a browser can open it, before the field is loaded, but
    after a given lighting was looked up.

    Raises:
        InputError: viser is missing, the scene has no field, or the lighting or the address is not valid.
    """
    try:
        import viser  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(f"{error}: the page needs viser; pip install 'twin[view]'") from None
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # for a page that was just closed
    from twin.view.guarded_server import open_server

    for stage in ("metric", "field"):
        require_stage(twin.scene, stage)
    if lighting:  # a wrong name is told before the address
        twin.field().embedding(lighting)
    server = open_server(host, port, "twin view")
    try:
        gui = server.viser.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(255, 193, 7))
        gui.main_panel.dock_right()
        loading = gui.add_markdown("The scene is being loaded ...")
        announce(server.url)
        # The imports and the loading below take time, during which the browser loads the page.
        from twin.view.camera_path import named_lighting
        from twin.view.page import Page

        field = twin.field()
        shown: EpisodeLighting = named_lighting(field, lighting or field.lightings[0])
        page = Page(twin, field, server, shown)
        # Not removed: a browser that gets text and removal in one batch would still set the text, and report an error.
        loading.visible = False
        return page
    except BaseException:
        server.stop()
        raise


def _check_driver(twin: Twin, given: argparse.Namespace) -> "Policy | None":
    """The policy given by `--policy`, if any. Raises InputError: the policy, task or seed is not valid."""
    if given.seed < 0:
        raise InputError(f"--seed {given.seed}: expected 0 or more")
    if given.task is not None:
        from twin.config_file import load_config
        from twin.env.route_segments import find_task

        find_task(given.task, twin.world(), load_config(twin.scene.config_file).task)
    if given.policy is None:
        return None
    from twin.learn.policy import find_policy, load_policy

    return load_policy(find_policy(twin.scene.root, given.policy), given.trust)


def load_driving(page: "Page", task: str | None = None, policy: "Policy | None" = None, seed: int = 0) -> None:
    """Adds the robot to an open page; if the scene cannot be driven, the page shows why.

    Raises:
        InputError: a policy or task is given, but cannot be driven.
    """
    try:
        from twin.view.driving import Driving

        shown = page.viewer
        held = shown.guarded.keys.held
        follow = page.drove, page.drive_failed
        driving = Driving(shown.twin, shown.field, task or "route", policy, shown.lighting, held, *follow, seed)
    except InputError as error:
        if task is not None or policy is not None:
            raise
        page.no_driving(str(error))
        return
    page.add_driving(driving)


if __name__ == "__main__":
    sys.exit(commands.main("view"))
