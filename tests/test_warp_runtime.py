"""Warp starts without its warning; other output passes."""

import os
import subprocess
import sys

import pytest

from twin import warp_runtime


def test_no_cuda_warning():
    code = "from twin.warp_runtime import wp; wp.zeros(3, device='cpu')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_other_lines_are_passed_on(capfd):
    with warp_runtime._without_the_warning():
        os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. No GPU.\nsomething else\n")
        os.write(2, b"Warp CUDA error 100: no CUDA-capable device is detected (in function init_cuda_driver)\n")
    assert capfd.readouterr().err == "something else\n"


def test_it_works_without_standard_error():
    code = "import os; os.close(2); from twin.warp_runtime import wp; print(wp.zeros(3, device='cpu').shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "(3,)\n")


def test_errors_propagate():
    with pytest.raises(ZeroDivisionError), warp_runtime._without_the_warning():
        raise ZeroDivisionError
