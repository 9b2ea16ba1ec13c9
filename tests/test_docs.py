"""The code blocks of README and docs run.

Python blocks run in order, page by page, and a few short commands, on a small scene that stands in for the demo. Every
other `twin` command is parsed; the walk of an hour, `python benchmarks/walk.py`, runs those of the README.
"""

import re
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest
from test_policy import some_weights
from tiny_twin import filmed_tiny_twin, tiny_twin

from twin.commands import VERBS, parser_of
from twin.config_file import load_config
from twin.evaluation.trials import Cell, read_results
from twin.learn.policy import Control, save_policy
from twin.learn.policy_network import Architecture
from twin.learn.train_config import TrainConfig

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "docs" / "benchmarks.md"
PAGES = sorted({ROOT / "README.md", *(ROOT / "docs").glob("*.md")} - {BENCHMARKS})
_IN_THE_SCENE = {
    "--episodes 20": "--episodes 2",
    '"right_turn"': '"bend"',
    '"straight"': '"ahead"',
    "--task right_turn --lighting held-out": "--task ahead --lighting held-out",
    "--task right_turn --lerobot": "--task ahead --lerobot",
    "--task right_turn": "--task bend",
    '"night"': '"day"',
    "--lighting night": "--lighting day",
    "obstacles=3": "obstacles=1",
    "count=5": "count=1",
    "--obstacles 4": "--obstacles 1",
}
"""Replacements of what only the demo has by what the small scene has: tasks, lightings, room for obstacles."""


def _blocks(page: Path, kind: str) -> list[str]:
    """Fenced code blocks of a kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.S | re.M)


def _commands(page: Path) -> list[list[str]]:
    """The commands of a page's shell blocks, as a shell splits and expands them."""
    out = []
    for block in _blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for one in filter(None, line.split("&&")):
                if not one.strip():
                    continue
                words = subprocess.run(
                    ["bash", "-c", f"printf '%s\\n' {one}"], capture_output=True, text=True, check=True
                )
                out.append(words.stdout.splitlines())
    return out


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    """A folder with `scenes/demo` and `my_module.py` in it."""
    folder = tmp_path_factory.mktemp("checkout")
    scene = tiny_twin(folder / "scenes" / "demo")
    full = Architecture(convolutions=((4, 8, 8),), features=8, hidden=(8,))
    save_policy(scene / "runs" / "first", full, Control(), some_weights(full), {})
    (folder / "my_module.py").write_text("def act(pixels):\n    return [0.5, 0.0]\n")
    return folder


def _adapted(block: str) -> str:
    for theirs, ours in _IN_THE_SCENE.items():
        block = block.replace(theirs, ours)
    return block


@pytest.mark.parametrize("page", [page for page in PAGES if _blocks(page, "python")], ids=lambda page: page.name)
def test_python_blocks_run(page, demo, monkeypatch):
    monkeypatch.chdir(demo)
    if page.name == "export.md":  # its block reads what a command of the page writes
        pytest.importorskip("pxr", reason="usd-core is not installed")
        from twin.__main__ import main

        filmed_tiny_twin(demo / "scenes" / "filmed")
        assert main(["export", "scenes/filmed", "--usd", "road.usdz", "--quiet"]) == 0
    for block in _blocks(page, "python"):
        names = {"rng": np.random.default_rng(0)}
        exec(compile(_adapted(block), str(page), "exec"), names)
        for name in ("env", "envs", "alone", "many"):
            if name in names:
                names[name].close()


def test_short_commands_run(demo, monkeypatch):
    monkeypatch.chdir(demo)
    ran = []
    for page in PAGES:
        for words in _commands(page):
            if words[:2] == ["twin", "film"]:
                given = _adapted(" ".join(words[1:])).split()
                if "--policy" in given:
                    given += ["--task", "ahead"]
                from twin.__main__ import main

                assert main([*given, "--quiet"]) == 0, words
                ran.append(words)
    assert len(ran) >= 2 and len(list((demo / "scenes" / "demo" / "films").glob("*.mp4"))) >= 2


@pytest.mark.parametrize("page", [*PAGES, BENCHMARKS], ids=lambda page: page.name)
def test_commands_are_understood(page):
    for words in _commands(page):
        if words[0] == "twin":
            parser_of(words[1]).parse_args(words[2:])
        elif words[0] == "python" and words[1].startswith("benchmarks"):
            script = ROOT / words[1]
            sources = [ROOT / "benchmarks" / "record.py", *([script] if script.is_file() else script.glob("*.py"))]
            code = "".join(source.read_text(encoding="utf-8") for source in sources)
            assert script.exists() and all(f'"{word}"' in code for word in words[2:] if word.startswith("--")), words


@pytest.mark.parametrize("page", [page for page in PAGES if _blocks(page, "toml")], ids=lambda page: page.name)
def test_scene_files_are_accepted(page, tmp_path):
    for block in _blocks(page, "toml"):
        tomllib.loads(block)
        least = "" if "[[source]]" in block else '[[source]]\npath = "a.mp4"\n'
        least += "" if "[metric]" in block else "[metric]\ncamera_height = 1.2\n"
        (tmp_path / "scene.toml").write_text(least + block)
        load_config(tmp_path / "scene.toml")


def test_the_checkpoints_in_the_readme_exist_however_early_a_training_ends():
    config = TrainConfig()
    every = config.steps // config.checkpoints
    saved = {config.test_every, *range(every, config.test_every + config.settle + 1, every)}
    named = re.findall(r"\d*\{[\d,]+\}\d*", (ROOT / "README.md").read_text())
    assert len(named) == 2 and named[0] == named[1]
    before, middle, after = re.split(r"[{}]", named[0])
    assert {int(before + part + after) for part in middle.split(",")} <= saved


def test_the_table_of_real_trials_is_accepted(tmp_path):
    (block,) = _blocks(ROOT / "docs" / "forecast.md", "csv")
    (tmp_path / "real.csv").write_text(block)
    twin = [Cell(name, "straight", "held-out+randomised", 20, 15) for name in ("first", "first/000003600")]
    assert [cell.successes for cell in read_results([tmp_path / "real.csv"], twin)] == [8, 3]


def test_the_readme_is_read_in_five_minutes():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1300
    assert all(f"`twin {verb}`" in text for verb in VERBS)


def test_links_lead_somewhere():
    for page in [*PAGES, ROOT / "docs" / "benchmarks.md"]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), (page.name, target)
