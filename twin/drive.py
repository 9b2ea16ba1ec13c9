"""`twin drive`: shows the Husky driving in a scene or a pack, as a film or in the browser.

By default, the first policy in a pack, or the policy of a scene's only run, drives the task of its training; without
such a policy, the scripted driver drives. `twin.film` has more options.
"""

import argparse
import sys

from twin import commands
from twin.config_file import load_config
from twin.env.route_segments import scene_tasks
from twin.errors import InputError, name_hint
from twin.files import require_output
from twin.film import film, film_options, summary
from twin.learn.policy import JSON, find_policy, load_policy
from twin.loading import Twin, load_scene
from twin.unpack import SUFFIX, find_pack, packed_policies, place_names


def chosen_policy(twin: Twin, name: str | None) -> str | None:
    """The policy that drives: the one named, else the first in the pack, else the only run; None: scripted driver."""
    root = twin.scene.root
    if name is None:
        runs = sorted(path.parent.name for path in root.glob(f"runs/*/{JSON}"))
        name = next(iter(packed_policies(root)), runs[0] if len(runs) == 1 else None)
    return str(root / name) if name is not None and (root / name).exists() else name


def chosen_task(twin: Twin, name: str | None, policy: str | None, trust: bool) -> str:
    """The task: the one named, else that of the policy's training if the scene has it, else the scene's first task."""
    tasks = scene_tasks(twin.world(), load_config(twin.scene.config_file).task)
    if name is None and policy is not None:
        name = load_policy(find_policy(twin.scene.root, policy), trust).trained.get("task")
        name = name if name in tasks else None
    return name or next(iter(tasks))


def command(given: argparse.Namespace) -> None:
    """Runs `twin drive` with the options parsed by `twin.commands`."""
    if len(given.scene.parts) == 1 and not given.scene.exists() and find_pack(given.scene) is None:
        named = f"{given.scene.name.removesuffix(SUFFIX)}{SUFFIX}"
        more = "; download scenes/demo.twin from twin's repository" if named == f"demo{SUFFIX}" else ""
        missing = f"{given.scene}: no folder, and no {named} here or in scenes/"
        raise InputError(missing + (more or f"; {name_hint(given.scene.name, place_names(), 'give a path')}"))
    if given.view and given.out:
        raise InputError("--out names a film, but --view records no film; leave out one of them")
    if not given.view and given.port != commands.parser_of("drive").get_default("port"):
        raise InputError(f"--port {given.port}: only the page has it; give --view, too")
    if given.out:
        require_output(given.out, (".mp4",), make=True)
    twin = load_scene(given.scene)
    policy = chosen_policy(twin, given.policy)
    task = chosen_task(twin, given.task, policy, given.trust)
    if given.view:
        from twin.view.__main__ import serve

        view = {"task": task, "policy": policy, "host": "127.0.0.1", "port": given.port}
        serve(twin, argparse.Namespace(**{**vars(given), **view}))
        return
    path, episode = film(given.scene, task, policy, given.seed, given.out, given.trust, **film_options(given.lighting))
    if not given.quiet:
        print(summary(path, episode))


if __name__ == "__main__":
    sys.exit(commands.main("drive"))
