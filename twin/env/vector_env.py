"""Many worlds at once: in this process, in several processes, or on a GPU; the options' device and the CPU cores decide."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin.env.options import CPU, parse_options
from twin.env.suite import EnvFactory
from twin.env.vector_env_local import LocalVectorEnv
from twin.env.vector_env_processes import ProcessVectorEnv
from twin.errors import InputError
from twin.loading import Twin
from twin.runtime import cores

_FEWEST, _MOST = 2, 8  # worlds of a process, and processes unless asked for: each takes its memory


def make_vector_env(
    scene: str | Path | Twin,
    task: str,
    options: dict[str, Any],
    seeds: Sequence[int | None],
    processes: int | None = None,
) -> LocalVectorEnv | ProcessVectorEnv:
    """n worlds on the device that the options say, see `LocalVectorEnv`; on a CPU in several processes where that is faster.

    Args:
        scene: See `twin.load`.
        task: See `twin.load`.
        options: See `twin.env.options.Options`.
        seeds: One per world, of its sequence of episodes; None: unpredictable.
        processes: How many step the worlds on a CPU; None: one per core, at most 8, and no more than half
                as many as worlds.

    Raises:
        InputError: as `Stage.open`, or no process at all.
    """
    if processes is not None and processes < 1:
        raise InputError(f"processes = {processes}; expected at least 1")
    if parse_options(options).device == CPU:
        if processes is None:
            processes = min(cores(), len(seeds) // _FEWEST, _MOST)
        if processes > 1:
            return ProcessVectorEnv(scene, task, options, seeds, min(processes, len(seeds)))
        return LocalVectorEnv(EnvFactory.open(scene, task, options), seeds)
    from twin.env.vector_env_gpu import GpuVectorEnv  # slow to import

    stage = EnvFactory.open(scene, task, options)
    return GpuVectorEnv(stage, seeds, stage.options.device)
