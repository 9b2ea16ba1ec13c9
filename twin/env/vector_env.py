"""Vector environments: `make_vector_env` steps them in one process, in several processes, or on a GPU."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin.env.options import CPU, parse_options
from twin.env.suite import EnvFactory
from twin.env.vector_env_local import LocalVectorEnv
from twin.env.vector_env_processes import ProcessVectorEnv
from twin.errors import InputError
from twin.loading import Twin
from twin.runtime import available_cores

_MIN_ENVS, _MAX_PROCESSES = 2, 8  # defaults: environments per process, and processes, as each needs its own memory


def make_vector_env(
    scene: str | Path | Twin,
    task: str,
    options: dict[str, Any],
    seeds: Sequence[int | None],
    processes: int | None = None,
) -> LocalVectorEnv | ProcessVectorEnv:
    """Returns n environments on the device of the options; see `LocalVectorEnv` for their interface.

    Args:
        scene: See `twin.load`.
        task: See `twin.load`.
        options: See `twin.env.options.Options`.
        seeds: Seed of each environment's sequence of episodes; None: unpredictable.
        processes: Number of processes on a CPU; None: one per core, at most 8, with at least two environments in each.

    Raises:
        InputError: see `EnvFactory.open`; or `processes` is below 1.
    """
    if processes is not None and processes < 1:
        raise InputError(f"processes = {processes}; expected at least 1")
    if parse_options(options).device == CPU:
        if processes is None:
            processes = min(available_cores(), len(seeds) // _MIN_ENVS, _MAX_PROCESSES)
        if processes > 1:
            return ProcessVectorEnv(scene, task, options, seeds, min(processes, len(seeds)))
        return LocalVectorEnv(EnvFactory.open(scene, task, options), seeds)
    from twin.env.vector_env_gpu import GpuVectorEnv  # slow to import

    factory = EnvFactory.open(scene, task, options)
    return GpuVectorEnv(factory, seeds, factory.options.device)
