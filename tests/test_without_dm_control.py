"""Without dm_control everything but driving works, and driving names the cure."""

import subprocess
import sys

import pytest

_LOAD = "import twin\ntry: twin.load('x')\nexcept twin.InputError as e: print(e)"
_PYTHON_3_13 = """
import collections, sys, twin
sys.version_info = collections.namedtuple("V", "major minor micro releaselevel serial")(3, 13, 0, "final", 0)
"""


def _run(code: str, missing: str = "dm_control") -> subprocess.CompletedProcess:
    without = f"import sys; sys.modules[{missing!r}] = None; "
    return subprocess.run([sys.executable, "-c", without + code], capture_output=True, text=True)


def test_scenes_are_built_without_dm_control():
    done = _run("import twin, twin.build, twin.report.review_video, twin.mjcf.scene_xml, twin.forecast, twin.export")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("missing", ["dm_control", "absl"])
def test_driving_names_the_missing_module_and_the_cure(missing):
    done = _run(_LOAD, missing)
    assert f"driving in a scene needs {missing}; install twin again" in done.stdout, done.stderr
    assert "Python" not in done.stdout


def test_driving_on_python_3_13_names_the_versions():
    done = _run(_PYTHON_3_13 + _LOAD)
    assert "needs dm_control, which installs on Python 3.11 and 3.12; this is Python 3.13" in done.stdout, done.stderr
