"""The cross-lighting control on fields whose colors are known to depend, or not, on the lighting."""

from pathlib import Path

import numpy as np
import pytest
from test_review import CheckeredField, make_cameras

from twin.geometry.cameras import PosedCameras, Rendering
from twin.nerf.evaluate import cross_lighting, mean_color

pytestmark = pytest.mark.usefixtures("quiet")


class Stubborn(CheckeredField):
    """A field that always shows its first lighting, and is farther away under the second one."""

    def render(self, cameras: PosedCameras, lighting: str, size: tuple[int, int] | None = None) -> Rendering:
        seen = super().render(cameras, self.lightings[0], size)
        return Rendering(seen.rgb, seen.depth + 0.25 * (lighting != self.lightings[0]), seen.opacity)


def test_color_follows_the_lighting_where_only_brightness_differs(tmp_path: Path) -> None:
    field = CheckeredField({"day": 1.0, "night": 0.3})
    found = cross_lighting(field, make_cameras(tmp_path / "build" / "2_metric", field), max_poses=10)
    assert found is not None and found["poses"] == 10
    assert found["colour_follows"] == {"day": 1.0, "night": 1.0}
    assert found["follows_by_pair"] == {"day": {"night": 1.0}, "night": {"day": 1.0}}
    assert found["depth_moves_m"] == 0.0
    assert np.allclose(
        np.array(found["mean_colour"]["day"]["night"]) / found["mean_colour"]["day"]["day"], 0.3, rtol=0.01
    )
    assert found["to_filmed_rms"]["night"] > 5.0 * found["to_shown_rms"]["night"]


def test_equal_lightings_are_a_draw(tmp_path: Path) -> None:
    field = CheckeredField({"day": 0.8, "again": 0.8})
    found = cross_lighting(field, make_cameras(tmp_path / "build" / "2_metric", field))
    assert found is not None and found["colour_follows"] == {"day": 0.5, "again": 0.5}


def test_a_field_that_ignores_the_lighting_is_detected(tmp_path: Path) -> None:
    brightness = {"day": 1.0, "night": 0.3}
    cameras = make_cameras(tmp_path / "build" / "2_metric", CheckeredField(brightness))
    found = cross_lighting(Stubborn(brightness), cameras)
    assert found is not None
    assert found["colour_follows"]["night"] == 0.0  # places filmed by day stay as they were
    assert found["depth_moves_m"] == pytest.approx(0.25, abs=1e-3)


def test_one_lighting_gives_no_result(tmp_path: Path) -> None:
    field = CheckeredField({"day": 1.0})
    assert cross_lighting(field, make_cameras(tmp_path / "build" / "2_metric", field)) is None


def test_masked_pixels_have_no_color() -> None:
    image = np.zeros((2, 2, 3))
    image[0, 0] = 1.0
    assert np.array_equal(mean_color(image, image[..., 0] == 0), np.zeros(3))
