"""The command `twin`."""

import subprocess
import sys

import pytest

from twin.__main__ import VERBS, main


def test_the_map_has_every_verb(capsys):
    for arguments in ([], ["--help"]):
        assert main(arguments) == 0
        shown = capsys.readouterr().out
        assert all(f"\n  {name} " in shown and what in shown for name, what in VERBS.items())


def test_an_unknown_verb_is_one_line(capsys):
    assert main(["biuld"]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.startswith("error: no verb 'biuld'; expected one of new, build")
    assert told.err.count("\n") == 1


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_reached(verb, capsys):
    with pytest.raises(SystemExit) as end:
        main([verb, "--help"])
    assert end.value.code == 0
    assert f"python -m twin.{verb}" in capsys.readouterr().out


def test_the_map_imports_nothing_heavy():
    code = "import sys, twin.__main__; twin.__main__.main([]); print(sorted(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not [name for name in ("torch", "warp", "mujoco", "scipy", "dm_control") if f"'{name}'" in done.stderr]


def test_a_training_in_a_scene_that_is_not_built_leaves_nothing(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text('name = "bare"\n[[source]]\npath = "a.mp4"\n')
    assert main(["train", str(tmp_path), "--run", "first"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and "run python -m twin.build" in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]
