"""The search in films for parts that are fixed to the camera: it finds these and nothing else."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from filmed_wall import film

from twin.capture.film_check import check_film, static_parts
from twin.config_file import load_config
from twin.geometry.images import read_image
from twin.new import new_scene

W, H = 320, 180


def moving(count: int = 24, step: int = 23, seed: int = 0) -> list[np.ndarray]:
    """A textured wall that the camera passes, with noise."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(H + 8, W + step * count, 3)).astype(np.float32)
    wall = sum(k * cv2.GaussianBlur(noise, (0, 0), k) for k in (2.0, 4.0, 10.0))
    wall = 128 + 60 * wall / wall.std()
    views = [wall[i % 8 : i % 8 + H, i * step : i * step + W] + rng.normal(0, 2, (H, W, 3)) for i in range(count)]
    return [np.clip(view, 0, 255).astype(np.uint8) for view in views]


def spoilt(frames: list[np.ndarray], kind: str) -> tuple[list[np.ndarray], np.ndarray]:
    """The frames with an object that is fixed to the camera, and where it is."""
    where = np.zeros((H, W), np.uint8)
    color: tuple[int, ...] = (30, 28, 25)
    if kind == "dirt":
        cv2.ellipse(where, (90, 70), (16, 11), 20, 0, 360, 1, -1)
    elif kind == "hood":
        cv2.ellipse(where, (W // 2, int(1.15 * H)), (140, 63), 0, 0, 360, 1, -1)
        color = (150, 20, 20)
    else:
        cv2.putText(where, "2024-05-01", (8, H - 8), 0, 0.5, 1, 2)
        color = (255, 255, 255)
    soft = cv2.GaussianBlur(where.astype(np.float32), (0, 0), 1.0)[..., None]
    return [(one * (1 - soft) + soft * np.array(color)).astype(np.uint8) for one in frames], where > 0


@pytest.mark.parametrize("kind", ["dirt", "hood", "stamp"])
def test_what_is_fixed_to_the_camera_is_found(kind: str) -> None:
    frames, truth = spoilt(moving(), kind)
    found = static_parts(frames)
    assert found.mask is not None and "stays the same in all frames" in found.note
    assert found.mask[truth].mean() >= 0.9
    beside = found.mask & ~np.asarray(cv2.dilate(truth.astype(np.uint8), np.ones((21, 21), np.uint8)), bool)
    assert beside.mean() < 0.005


def test_nothing_is_found_where_nothing_is_fixed() -> None:
    assert static_parts(moving()).mask is None
    sky = moving(seed=1)
    for one in sky:
        one[:70] = np.linspace(200, 240, 70)[:, None, None]
    assert static_parts(sky).mask is None
    assert static_parts([one // 16 for one in moving(seed=2)]).mask is None  # night
    assert static_parts([np.zeros((H, W, 3), np.uint8)] * 20).mask is None


def test_no_answer_from_a_still_camera_or_few_frames() -> None:
    rng = np.random.default_rng(0)
    still = [np.clip(moving(1)[0] + rng.normal(0, 2, (H, W, 3)), 0, 255).astype(np.uint8) for _ in range(20)]
    assert static_parts(still).mask is None
    assert static_parts(spoilt(still, "hood")[0]).mask is None
    assert static_parts(spoilt(moving(11), "hood")[0]).mask is None
    assert static_parts([*spoilt(moving(12), "hood")[0], np.zeros((W, H, 3), np.uint8)]).mask is None


def test_too_large_a_mask_is_refused_with_a_reason() -> None:
    frames = moving()
    tiles = np.kron(np.indices((9, 32)).sum(0) % 2, np.ones((10, 10)))[..., None] * 200
    for one in frames:
        one[90:] = tiles
    found = static_parts(frames)
    assert found.mask is None and "give a mask in scene.toml" in found.note


def test_new_writes_the_mask_and_never_over_a_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    frames, truth = spoilt(moving(), "hood")
    day = film(tmp_path / "day.mp4", [np.asarray(cv2.resize(one, (640, 360))) for one in frames])
    config = load_config(new_scene(tmp_path / "a", [day], 1.2))
    assert config.source[0].mask == "input/day_mask.png"
    assert "of the picture stays the same" in capsys.readouterr().err
    mask = read_image(tmp_path / "a/input/day_mask.png")[..., 0]
    assert mask.shape == (360, 640) and (mask[::2, ::2][truth] == 0).mean() >= 0.9 and (mask[:200] == 255).all()
    other = tmp_path / "b/input/day_mask.png"
    other.parent.mkdir(parents=True)
    other.write_bytes(b"mine")
    assert load_config(new_scene(tmp_path / "b", [day], 1.2)).source[0].mask == ""
    assert other.read_bytes() == b"mine" and "exists and is kept" in capsys.readouterr().err


def no_mask(path: Path) -> bool:
    return check_film(path).mask is None


@pytest.mark.parametrize("name", ["night", "overcast", "sun"])
def test_the_demo_has_no_mask(name: str) -> None:
    assert no_mask(Path(__file__).parents[1] / f"scenes/demo/input/{name}.mp4")


@pytest.mark.slow
@pytest.mark.realdata
def test_real_films_without_dirt_have_no_mask(real_data: Path) -> None:
    """The robot in sim2real_day sways before the camera, so nothing is found."""
    assert all(no_mask(path) for path in sorted((real_data / "driveenv_paper_road").glob("*.mp4")))
    for place in ("kitti_straight", "lund_street"):
        files = sorted(f for f in (real_data / place).rglob("*") if f.suffix.lower() in (".png", ".jpg"))
        views = [cv2.imread(str(f)) for f in files]
        small = [
            np.asarray(cv2.resize(v, (W, W * v.shape[0] // v.shape[1]), interpolation=cv2.INTER_AREA)) for v in views
        ]
        small = [one for one in small if one.shape == small[0].shape]
        assert len(small) > 20
        for part in (small, small[: len(small) // 2], small[len(small) // 2 :]):
            assert static_parts(part).mask is None
