"""Campaigns larger than one machine, on a Ray cluster.

Its nodes need `twin`, and see the scene and the policies under the same paths, as on a shared disk.
"""

import logging
import os
import socket
from collections.abc import Iterator, Sequence

from twin.errors import InputError
from twin.learn.judging import Chunk, Driven, drive
from twin.verb import signals_kept

_CORES = 2  # that driving a chunk keeps busy
_PATIENCE = 5.0  # [s]


def campaign_on_ray(chunks: Sequence[Chunk], address: str) -> Iterator[list[Driven]]:
    """As `judging.campaign`, on the cluster at an address (`auto`: the one that runs on this machine).

    Raises:
        InputError: Ray is not installed, there is no such cluster, or what `drive` raises.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray warns that it will leave GPUs alone
    try:
        import ray
    except ImportError:
        raise InputError("--ray needs more: pip install .[ray]") from None
    try:
        if address != "auto":  # Ray itself would try for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), _PATIENCE).close()
        with signals_kept():  # Ray takes SIGTERM for itself
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"--ray {address}: no cluster there ({first}); start one with `ray start --head`") from None
    try:
        # No more than the largest node has, or the tasks would wait for ever.
        cores = max((node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
        if cores < 1:
            raise InputError(f"--ray {address}: no node of the cluster has a core to give; start one with `ray start`")
        # Spread: by default Ray fills one node before it uses the next.
        remote = ray.remote(num_cpus=int(min(_CORES, cores)), scheduling_strategy="SPREAD")(drive)
        for driven in [remote.remote(chunk) for chunk in chunks]:
            yield ray.get(driven)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from None
        raise
    finally:
        ray.shutdown()
