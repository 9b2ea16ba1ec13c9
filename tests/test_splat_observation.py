"""`observe="splats"`: a file of splats as the place, with obstacles before and behind it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_twin import tiny_twin

import twin
from twin.assets.gaussians import Gaussians
from twin.config import ObstacleConfig
from twin.env.env_factory import EnvFactory
from twin.errors import InputError

RED = (0.9, 0.1, 0.1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene, with a red wall of splats across the road at x = 4 m, from y = −3 m to the route, as `wall.ply`."""
    root = tiny_twin(tmp_path_factory.mktemp("splats") / "scene")
    y, z = np.meshgrid(np.arange(-3.0, 0.0, 0.05), np.arange(0.0, 3.0, 0.05))
    positions = np.stack([np.full(y.size, 4.0), y.ravel(), z.ravel()], 1).astype(np.float32)
    turn = Rotation.from_euler("y", 90, degrees=True).as_quat()[[3, 0, 1, 2]].astype(np.float32)
    wall = Gaussians(
        positions,
        np.tile(turn, (len(positions), 1)),
        np.tile(np.float32([0.05, 0.05, 0.005]), (len(positions), 1)),
        np.tile(np.float32(RED), (len(positions), 1)),
        np.full(len(positions), 0.97, np.float32),
    )
    (root / "wall.ply").write_bytes(wall.to_ply())
    return root


def _picture(scene, *obstacles) -> np.ndarray:
    env = twin.load(
        scene,
        task="ahead",
        seed=0,
        observe="splats",
        splats=str(scene / "wall.ply"),
        start_offset=0.0,
        start_heading=0.0,
        obstacles=obstacles,
    )
    return env.reset().observation["pixels"][-1].astype(float)


def _box(station: float) -> ObstacleConfig:
    return ObstacleConfig(name="one", kind="box", station=station, lateral=-0.9, size=(0.5, 0.5, 0.8))


def test_splats_hide_what_is_behind_them_and_are_hidden(scene) -> None:
    plain = _picture(scene)
    red = np.abs(plain - 255 * np.array(RED)).max(-1) < 12
    right = np.zeros(red.shape, bool)
    right[:, red.shape[1] // 2 :] = True
    assert red[20:60, 90:150].all() and not red[~right].mean() > 0.05  # the wall is to the right of the route
    before, behind = _picture(scene, _box(2.6)), _picture(scene, _box(4.8))
    assert (np.abs(before - plain).max(-1) > 40).sum() > 100
    assert np.abs(behind - plain)[red].max() <= 3


def test_speed_is_told(scene, capsys) -> None:
    _picture(scene)
    assert "splats on the CPU" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"observe": "splats"}, "expected both"),
        ({"splats": "wall.ply"}, "expected both"),
        ({"observe": "splats", "splats": 3}, "expected a path"),
        ({"observe": "splats", "splats": "absent.ply"}, "absent.ply"),
    ],
)
def test_bad_options_are_refused(scene, options, words) -> None:
    with pytest.raises(InputError) as raised:
        factory = EnvFactory.open(scene, "ahead", options)
        factory.make_observer([factory.make_env(0)])
    assert words in str(raised.value)
