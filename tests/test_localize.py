"""A photo's pose against the frames and points of a known corridor."""

import numpy as np
import pytest
from textured import SIZE, K, filmed_corridor, picture, pose_at

from twin import runtime
from twin.capture import localize
from twin.capture.localize import MIN_INLIERS, candidate_lenses, register_photo
from twin.capture.photos import PhotoExif
from twin.errors import InputError
from twin.geometry.poses import rotation_angle

NOTHING = PhotoExif(None, (np.nan, np.nan, np.nan), None, 1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return filmed_corridor(tmp_path_factory.mktemp("corridor") / "scene")


def error(found, pose: np.ndarray) -> tuple[float, float]:
    """Error of position [m] and rotation [°]."""
    turned = rotation_angle(found.camera_to_world[:3, :3].T @ pose[:3, :3])
    return float(np.linalg.norm(found.camera_to_world[:3, 3] - pose[:3, 3])), float(np.degrees(turned))


def test_a_new_view_in_other_light_is_found_with_the_scenes_camera(scene):
    pose = pose_at(2.6, -0.3, 0.4)
    found = register_photo(picture(pose, tint=(0.6, 0.5, 0.4)), NOTHING, scene)
    metres, degrees = error(found, pose)
    assert metres < 0.03
    assert degrees < 0.3
    assert found.lens_from == "the calibration of 'day'"
    assert found.lens.params == pytest.approx(tuple(K))
    assert MIN_INLIERS <= found.inliers <= found.matches
    assert found.error < 1.5


def test_another_camera_is_found_with_its_focal_length(scene):
    """A larger picture of another shape and focal length, unknown or roughly given by its header."""
    size, intrinsics, pose = (480, 480), np.array([520.0, 520.0, 240.0, 240.0]), pose_at(2.1, 0.1, -0.3)
    photo = picture(pose, size, intrinsics)
    for exif, origin in ((NOTHING, "estimated"), (PhotoExif(1.05, NOTHING.gps, None, 1), "EXIF")):
        found = register_photo(photo, exif, scene)
        assert found.lens_from == origin
        assert found.lens.intrinsics[0] == pytest.approx(520.0, rel=0.03)
        metres, degrees = error(found, pose)
        assert metres < 0.15
        assert degrees < 0.5


def test_features_of_few_frames_are_kept(scene, monkeypatch):
    monkeypatch.setattr(localize, "_MAX_FRAMES", 2)
    known = localize.LocalizationMap(scene.stage("metric"))
    descriptors = known.features(known.cameras.image_path(0))[1]
    first = known.matches(descriptors, 0)
    for i in (1, 0, 2):
        known.matches(descriptors, i)
    assert list(known._features) == [0, 2]
    np.testing.assert_array_equal(known.matches(descriptors, 0), first)


def test_a_photo_of_something_else_is_refused(scene):
    noise = np.kron(np.random.default_rng(0).integers(0, 255, (60, 80, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    with pytest.raises(InputError, match=rf"only \d+ of the photo.s \d+ features agree .*\(need {MIN_INLIERS}\)"):
        register_photo(noise, NOTHING, scene)
    with pytest.raises(InputError, match="only 0 of the photo"):
        register_photo(np.full((240, 320, 3), 90, np.uint8), NOTHING, scene)


def test_the_photos_own_header_comes_before_the_scenes_cameras(scene):
    origins = [origin for _, _, origin in candidate_lenses(SIZE, PhotoExif(0.8, NOTHING.gps, None, 1), scene)]
    assert origins == ["EXIF", "the calibration of 'day'", "the camera of 'day'", "estimated"]
    halved, held, _ = candidate_lenses((160, 120), NOTHING, scene)[0]
    assert held
    assert halved.params == pytest.approx(tuple(K / 2))
    assert [origin for _, _, origin in candidate_lenses((300, 300), NOTHING, scene)] == ["estimated"]
