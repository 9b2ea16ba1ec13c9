"""The command `twin`."""

import subprocess
import sys

import pytest

from twin.__main__ import main
from twin.commands import VERBS, parser_of


def test_help_lists_every_verb(capsys):
    for arguments in ([], ["--help"]):
        assert main(arguments) == 0
        shown = capsys.readouterr().out
        assert all(f"\n  {name} " in shown and verb.summary in shown for name, verb in VERBS.items())


def test_an_unknown_verb_is_one_line(capsys):
    for given, said in (("biuld", "did you mean 'build'?"), ("xyz", "expected one of new, build")):
        assert main([given]) == 2
        told = capsys.readouterr()
        assert told.out == "" and told.err.startswith(f"error: no verb {given!r}; {said}")
        assert told.err.count("\n") == 1


def test_a_value_may_begin_with_a_minus():
    options = parser_of("relight").parse_args(
        ["scene", "photo.jpg", "--name", "x", "--sun", "-30,20", "--location", "-33.9,18.4", "--heading", "-5"]
    )
    assert (options.sun, options.location, options.heading) == ("-30,20", "-33.9,18.4", -5.0)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb, capsys):
    with pytest.raises(SystemExit) as end:
        main([verb, "--help"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert f"usage: twin {verb}" in shown and "(default: )" not in " ".join(shown.split())


def test_help_imports_nothing_heavy():
    heavy = ("torch", "warp", "mujoco", "scipy", "dm_control", "matplotlib", "cv2", "pycolmap", "trimesh")
    code = (
        "import sys, twin.__main__\n"
        f"for arguments in [], *([verb, '--help'] for verb in {list(VERBS)}):\n"
        "    try: twin.__main__.main(arguments)\n"
        "    except SystemExit: pass\n"
        f"    print(arguments, sorted(set(sys.modules) & set({heavy})), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines() == [f"{arguments} []" for arguments in ([], *([verb, "--help"] for verb in VERBS))]


def _help(capsys, *arguments):
    with pytest.raises(SystemExit):
        main([*arguments, "--help"])
    return " ".join(capsys.readouterr().out.split())


def test_help_of_train_states_its_defaults(capsys):
    from twin.learn.train_config import PRESETS, TrainConfig, steps_for

    shown, plain = _help(capsys, "train"), TrainConfig()
    for name in ("task", "observe", "preset"):
        assert f"(default: {getattr(plain, name, 'cpu')})" in shown
    assert f"(default: {plain.worlds}; gpu: {PRESETS['gpu']['worlds']})" in shown
    assert f"(default: {plain.steps}, more from 50 m on; gpu: {PRESETS['gpu']['steps']})" in shown
    assert steps_for(49.9) == plain.steps < steps_for(50.1)
    for name in ("updates", "steering", "entropy", "colours", "seed"):
        option = shown[shown.index(f"--{name} {name.upper()} ") :]
        assert option[option.index("(default: ") :].startswith(f"(default: {getattr(plain, name)})"), name
        assert PRESETS["gpu"].get(name, getattr(plain, name)) == getattr(plain, name)
    assert f"default: {plain.action}" in shown and f"default: {plain.lighting}," in shown
    assert plain.randomise


def test_help_agrees_with_what_the_verbs_take(capsys):
    from twin.align import PUBLISHED_ROBOT, RESULT_FOLDER
    from twin.evaluation.statistics import MIN_TRIALS
    from twin.evaluation.trials import RESULT_COLUMNS

    assert ",".join(RESULT_COLUMNS) in _help(capsys, "forecast")
    assert f"`{PUBLISHED_ROBOT}`" in _help(capsys, "align") and RESULT_FOLDER in _help(capsys, "align")
    drive = _help(capsys, "reality", "drive")
    assert "{straight,right_turn}" in drive and f"default: {MIN_TRIALS}" in drive


def test_an_unknown_lighting_of_reality_is_one_line(tmp_path, capsys):
    for given in (["film", "--lightings", "noon"], ["photo", "--lighting", "noon"]):
        assert main(["reality", *given, "--out", str(tmp_path / "out")]) == 2
        told = capsys.readouterr().err
        assert told.startswith("error: no lighting 'noon'") and told.count("\n") == 1


def test_a_lighting_given_twice_is_filmed_once(tmp_path, monkeypatch):
    plans = []
    monkeypatch.setattr("twin.reality.__main__.film", lambda plan, *given, **more: plans.append(plan))
    assert main(["reality", "film", "--lightings", "sun", "night", "sun", "--out", str(tmp_path / "out")]) == 0
    assert [plan.lightings for plan in plans] == [("sun", "night")]


def test_training_in_a_scene_that_is_not_built_leaves_no_files(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text('name = "bare"\n[[source]]\npath = "a.mp4"\n')
    assert main(["train", str(tmp_path), "--run", "first"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and "run twin build" in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]
