"""Without dm_control everything but driving works, and driving names the cure."""

import subprocess
import sys

_WITHOUT = "import sys; sys.modules['dm_control'] = None; sys.modules['dm_control.rl'] = None; "


def _run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", _WITHOUT + code], capture_output=True, text=True)


def test_scenes_are_built_without_dm_control():
    done = _run("import twin, twin.build, twin.report.review_video, twin.mjcf.scene_xml, twin.forecast, twin.export")
    assert done.returncode == 0, done.stderr


def test_driving_without_dm_control_names_the_cure():
    done = _run("import twin\ntry: twin.load('x')\nexcept twin.InputError as e: print(e)")
    assert "needs dm_control, which installs on Python 3.11 and 3.12" in done.stdout, done.stderr
