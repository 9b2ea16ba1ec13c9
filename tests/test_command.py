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
