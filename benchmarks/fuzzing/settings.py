"""Fuzz targets of settings: scene.toml, robot.toml, overrides, keyword options, training configs, actions."""

import dataclasses
from random import Random
from typing import Any

import numpy as np

from fuzzing.cases import MAX_MESSAGE, Case, Violation
from fuzzing.samples import SCENE_TABLE, defaults_of, scene_table
from fuzzing.values import DEEP_NESTING, hostile_literal, hostile_text, hostile_value, mutated, mutated_text, toml_text
from twin.errors import InputError


def scene(case: Case) -> None:
    from twin.config_file import load_config

    path = case.folder / "scene.toml"
    path.write_bytes(mutated_text(case.rng, toml_text(mutated(case.rng, scene_table(case.rng), True))))
    if case.rng.random() < 0.1:
        (case.folder / "robot.toml").write_bytes(mutated_text(case.rng, "friction = 0.5\n"))
    load_config(path)


def robot(case: Case) -> None:
    from twin.config_file import read_robot
    from twin.robot import HuskyParams

    path = case.folder / "robot.toml"
    path.write_bytes(mutated_text(case.rng, toml_text(mutated(case.rng, defaults_of(HuskyParams), True))))
    read_robot(path)


def overrides(case: Case) -> None:
    from twin.config_file import load_config

    path = case.folder / "scene.toml"
    path.write_text(toml_text(SCENE_TABLE))
    load_config(path, tuple(override(case.rng) for _ in range(case.rng.choice((1, 1, 2)))))


def override(rng: Random) -> str:
    """A value for `--set`: a key of the scene's config, or a hostile one, with a hostile value."""
    from twin.config import SceneConfig

    table = defaults_of(SceneConfig)
    section = rng.choice(list(table))
    key = f"{section}.{rng.choice(list(table[section]))}" if isinstance(table[section], dict) else section
    what = rng.random()
    if what < 0.15:
        keys = ("", ".", "a", "a.b", f"{key}.x", f".{key}", f"{key}.", "name.x", "source.0.path", hostile_text(rng))
        key = rng.choice(keys)
    elif what < 0.17:
        key = "a." * DEEP_NESTING + "a"
    values = (f"{key}={hostile_literal(rng, True)}", f"{key}={hostile_text(rng)}", key, f"{key}==", f"{key}=1\nb = 2")
    return rng.choice(values)


def options(case: Case) -> None:
    from twin.env.domain_randomization import Ranges
    from twin.env.options import Options, Rewards, parse_options

    given = _keywords(case.rng, Options)
    what = case.rng.random()
    if what < 0.1:
        given["rewards"] = _keywords(case.rng, Rewards)
    elif what < 0.2:
        given["randomise"] = Ranges(**_known(_keywords(case.rng, Ranges), Ranges))
    parse_options(given)


def train_config(case: Case) -> None:
    from twin.learn.train_config import TrainConfig

    TrainConfig(**_known(_keywords(case.rng, TrainConfig), TrainConfig))


def _keywords(rng: Random, kind: type) -> dict[str, Any]:
    """Hostile values for one or two fields of a dataclass; in 5 % of calls also for an unknown field."""
    names = [one.name for one in dataclasses.fields(kind)]
    out = {rng.choice(names): hostile_value(rng) for _ in range(rng.choice((1, 1, 2)))}
    if rng.random() < 0.05:
        out[hostile_text(rng)] = hostile_value(rng)
    return out


def _known(keywords: dict[str, Any], kind: type) -> dict[str, Any]:
    names = {one.name for one in dataclasses.fields(kind)}
    return {name: value for name, value in keywords.items() if name in names}


def actions(case: Case) -> bool:
    """A hostile action: the environment must step or raise ValueError, and its next observation must be finite."""
    rng, environment = case.rng, case.samples.environment
    environment.reset()
    good = np.array([0.5, 0.1])
    what = rng.random()
    if what < 0.5:
        action: Any = hostile_value(rng)
    elif what < 0.8:
        action = [rng.choice((0.5, float("nan"), float("inf"), 1e308, -1e308, -1, None, "a", 10**400)) for _ in "ab"]
    else:
        arrays = (np.zeros(3), np.zeros((1, 2)), np.full(2, np.nan), np.array(["a", "b"]), np.zeros(2, complex), good)
        action = rng.choice([*arrays, np.array([None, None]), np.zeros(2, bool), np.zeros((2, 0)), good.astype("f4")])
    accepted = True
    try:
        environment.step(action)
    except ValueError as error:
        if "\n" in str(error) or len(str(error)) > MAX_MESSAGE:
            raise Violation(f"refused in a long message: {str(error)[:200]!r}") from None
        accepted = False
    after = environment.step(good)
    for name, value in after.observation.items():
        if not np.isfinite(np.asarray(value, float)).all():
            raise Violation(f"{name} is not finite after {str(action)[:100]}")
    if not accepted:
        raise InputError("refused")
    return True
