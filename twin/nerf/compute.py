"""Where the field is computed, and how its work is split over cores.

Warp runs a CPU launch on one thread but releases the interpreter while it does, and so does torch in a matrix product:
two Python threads keep two cores busy. A *shard* is a fixed part of a batch. How a batch is cut into shards never
depends on the number of cores and shards are summed in order, so that a result does not depend on the machine's cores.
"""

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
import warp as wp

from twin.cores import cores
from twin.errors import InputError

T = TypeVar("T")

wp.config.log_level = wp.LOG_ERROR
wp.init()

_pool: ThreadPoolExecutor | None = None
_lock = threading.Lock()


def device() -> str:
    """`cpu` or `cuda`: what TWIN_DEVICE asks for, else CUDA where both torch and Warp see it.

    Raises:
        InputError: TWIN_DEVICE is neither, or asks for CUDA where there is none.
    """
    wanted = os.environ.get("TWIN_DEVICE", "")
    has_cuda = torch.cuda.is_available() and wp.is_cuda_available()
    if wanted not in ("", "cpu", "cuda"):
        raise InputError(f"device {wanted!r}: expected cpu or cuda")
    if wanted == "cuda" and not has_cuda:
        raise InputError("device cuda: no CUDA device is visible to torch and warp; use --device cpu")
    return wanted or ("cuda" if has_cuda else "cpu")


def parallel(work: Callable[[int], T], items: Iterable[int], where: str) -> list[T]:
    """`work` on every item, side by side on the cores of a CPU, one after the other on CUDA; results in order.

    Torch's own threads are held at one meanwhile: several shards at a time use the cores better than each op in turn.
    """
    global _pool
    items = list(items)
    if where != "cpu" or len(items) < 2 or cores() < 2:
        return [work(item) for item in items]
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(cores(), initializer=torch.set_num_threads, initargs=(1,))
    return list(_pool.map(work, items))


class single_threaded_torch:
    """Within it, torch uses one thread per op; the setting is restored after."""

    def __enter__(self) -> None:
        self._threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def __exit__(self, *_: Any) -> None:
        torch.set_num_threads(self._threads)


def load_kernels(where: str) -> None:
    """Compiles or loads all kernels now: two threads that first need one would each compile it."""
    for module in ("space", "sampler", "hashgrid", "composite"):
        wp.load_module(f"twin.nerf.kernels.{module}", device=where)
    if where == "cuda":  # torch and Warp hand arrays to each other without waiting, so they must share a stream
        wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream()), where)


def view(tensor: torch.Tensor, dtype: Any) -> Any:
    """A Warp array over a tensor's memory."""
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)
