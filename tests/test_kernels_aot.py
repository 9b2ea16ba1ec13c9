"""Every kernel compiles for a GPU ahead of time, on a machine without one."""

import pkgutil
from importlib import import_module

import pytest
import warp as wp

from twin.nerf import buffers, kernels
from twin.nerf.kernels import color_head, march

_ARCH = 90  # sm_90: Hopper
_SLOW = {"patch_match"}
"""Kernels with unrolled windows, compiled to PTX, which takes half the time of machine code."""
_MADE = {
    "steps of a GPU vector env": lambda: import_module("twin.env.vector_env_gpu"),
    "images of a GPU vector env": lambda: import_module("twin.env.observation"),
    "march of one lane": lambda: march.march_kernel(march.LANES["cuda"]).module,
    "color head of two lanes": lambda: color_head.color_head_kernel(color_head.LANES["cuda"], 64, 32)[0].module,
}
"""Kernels outside this package, and those built for a number of lanes, each in its own module."""
_NO_KERNEL = {"color_head"}


@pytest.mark.parametrize(
    "name", [*(m.name for m in pkgutil.iter_modules(kernels.__path__) if m.name not in _NO_KERNEL), *_MADE]
)
def test_kernels_compile_for_sm_90(name, tmp_path):
    assert buffers.wp is wp  # importing it initializes Warp quietly
    module = _MADE[name]() if name in _MADE else import_module(f"{kernels.__name__}.{name}")
    made = wp.compile_aot_module(module, arch=_ARCH, module_dir=tmp_path, use_ptx=name in _SLOW)
    suffix = f".sm{_ARCH}.ptx" if name in _SLOW else f".sm{_ARCH}.cubin"
    assert [path.name.endswith(suffix) for path in made] == [True]
    content = made[0].read_bytes()
    assert f"sm_{_ARCH}".encode() in content if name in _SLOW else content.startswith(b"\x7fELF")
