"""Two processes do not write the same tables."""

import os
import subprocess
import sys

import pytest

from twin.errors import InputError
from twin.runtime import exclusive_lock


def test_the_error_names_the_holder_and_a_kill_releases_the_lock(tmp_path):
    path = tmp_path / "new" / ".lock"
    code = (
        "import sys; from pathlib import Path; from twin.runtime import exclusive_lock\n"
        "with exclusive_lock(Path(sys.argv[1]), 'x'): print('held', flush=True); sys.stdin.read()\n"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "held\n"
        held = pytest.raises(InputError, match=f"the table is being written by process {other.pid}; wait for it")
        with held, exclusive_lock(path, "the table is being written"):
            raise AssertionError("two at once")
    finally:
        other.kill()
        other.wait()
    with exclusive_lock(path, "the table is being written"):
        assert path.read_text() == str(os.getpid())
    with exclusive_lock(path, "the table is being written"):
        pass
