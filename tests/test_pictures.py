"""A robot's pictures: encodings give the same RGB; rectification agrees with OpenCV's maps and with plain averages."""

import cv2
import numpy as np
import pytest
from picture_bag import camera_info, image

from twin.robot import PixelCamera
from twin_policy.pictures import Camera, CompressedPicture, PictureError, RawPicture, Rectifier

SMOOTH = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8), (0, 0), 4.0)
SMOOTH = cv2.normalize(SMOOTH, None, 0, 255, cv2.NORM_MINMAX)


def _mosaic(pattern: str) -> np.ndarray:
    """The Bayer mosaic of SMOOTH; the pattern names the first row's two pixels, then the second's."""
    out = np.zeros(SMOOTH.shape[:2], np.uint8)
    for k, color in enumerate(pattern):
        row, column = divmod(k, 2)
        out[row::2, column::2] = SMOOTH[row::2, column::2, "rgb".index(color)]
    return out


def _raw(encoding: str, picture: np.ndarray, padding: int = 0) -> RawPicture:
    height, width = picture.shape[:2]
    rows = np.pad(picture.reshape(height, -1), ((0, 0), (0, padding)))
    return RawPicture(encoding, width, height, rows.shape[1], rows.tobytes())


@pytest.mark.parametrize("padding", [0, 5])
def test_every_color_encoding_is_the_same_picture(padding):
    forms = {
        "rgb8": SMOOTH,
        "bgr8": SMOOTH[..., ::-1],
        "8UC3": SMOOTH[..., ::-1],
        "rgba8": np.dstack([SMOOTH, np.zeros(SMOOTH.shape[:2], np.uint8)]),
        "bgra8": np.dstack([SMOOTH[..., ::-1], np.zeros(SMOOTH.shape[:2], np.uint8)]),
    }
    for encoding, picture in forms.items():
        np.testing.assert_array_equal(_raw(encoding, picture, padding).decode(), SMOOTH, encoding)
    gray = _raw("mono8", SMOOTH[..., :1], padding).decode()
    np.testing.assert_array_equal(gray, np.repeat(SMOOTH[..., :1], 3, 2))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_mosaics_are_decoded(pattern):
    picture = _raw(f"bayer_{pattern}8", _mosaic(pattern)).decode()
    assert np.abs(picture[4:-4, 4:-4].astype(int) - SMOOTH[4:-4, 4:-4]).mean() < 4.0  # swapped colors differ by 50


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_yuv_pictures_are_decoded(encoding, order):
    yuv = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YUV)
    height, width = yuv.shape[:2]
    limited = np.stack(  # BT.601, limited range: what cameras send
        [
            16 + (yuv[..., 0] * (219 / 255)),
            128 + (yuv[..., 1].astype(float) - 128) * (224 / 255) * (0.564 / 0.492),
            128 + (yuv[..., 2].astype(float) - 128) * (224 / 255) * (0.713 / 0.877),
        ],
        -1,
    )
    pairs = limited.reshape(height, width // 2, 2, 3)
    parts = {"y": pairs[..., 0], "u": pairs[..., 1].mean(2), "v": pairs[..., 2].mean(2)}
    packed = np.zeros((height, width // 2, 4))
    for k, name in enumerate(order):
        packed[..., k] = parts["y"][..., sum(order[i] == "y" for i in range(k))] if name == "y" else parts[name]
    picture = _raw(encoding, np.rint(packed).clip(0, 255).astype(np.uint8).reshape(height, width, 2)).decode()
    assert np.abs(picture.astype(int) - SMOOTH).mean() < 3.0


@pytest.mark.parametrize(("encoding", "order"), [("nv12", (0, 1)), ("nv21", (1, 0))])
def test_pictures_with_brightness_before_colors_are_decoded(encoding, order):
    height, width = SMOOTH.shape[:2]
    planes = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YUV_I420)  # brightness, U, V
    colors = planes[height:].reshape(2, height // 2, width // 2)[list(order)]
    rows = np.vstack([planes[:height], colors.transpose(1, 2, 0).reshape(height // 2, width)])
    padded = np.pad(rows, ((0, 0), (0, 6)))
    picture = RawPicture(encoding, width, height, width + 6, padded.tobytes()).decode()
    assert picture.shape == SMOOTH.shape
    assert np.abs(picture.astype(int) - SMOOTH).mean() < 4.0  # swapped colors differ by 50
    with pytest.raises(
        PictureError, match=rf"{encoding} picture .* expected {width} a row .* {width * height * 3 // 2} in"
    ):
        RawPicture(encoding, width, height, width, rows[:height].tobytes()).decode()


def test_compressed_pictures_are_decoded():
    np.testing.assert_array_equal(CompressedPicture(image(SMOOTH, 0, encoding="png").message.data).decode(), SMOOTH)
    near = CompressedPicture(image(SMOOTH, 0, encoding="jpeg").message.data.tobytes()).decode()
    assert np.abs(near.astype(int) - SMOOTH).mean() < 3.0


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (RawPicture("rgb16", 4, 4, 24, bytes(96)), r"encoding 'rgb16'; expected one of rgb8, bgr8"),
        (
            RawPicture("rgb8", 4, 4, 12, bytes(47)),
            r"rgb8 picture of 4 x 4 px .* has 47 bytes; expected 12 a row .* 48 in",
        ),
        (RawPicture("rgb8", 4, 4, 11, bytes(48)), r"11 bytes a row"),
        (RawPicture("rgb8", 0, 4, 12, bytes(48)), r"rgb8 picture of 0 x 4 px"),
        (RawPicture("bayer_rggb8", 5, 5, 5, bytes(25)), r"expected even sides"),
        (CompressedPicture(b""), r"0 bytes are neither"),
        (CompressedPicture(b"\xff\xd8\xff rubbish"), r"11 bytes are neither"),
    ],
)
def test_bad_pictures_are_refused_in_one_line(picture, message):
    with pytest.raises(PictureError, match=message) as error:
        picture.decode()
    assert "\n" not in str(error.value)


# ---- cameras

LENS = (533.1, 531.4, 641.2, 355.8)
BENT = {
    "plumb_bob": (-0.12, 0.02, 0.0012, -0.0007, -0.002),
    "rational_polynomial": (0.3, -0.02, 0.0004, -0.0003, 0.001, 0.62, 0.01, -0.003),
    "equidistant": (0.05, -0.01, 0.004, -0.001),
}


def opencv_map(model: str, pinhole: Camera) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's own map, for cameras whose pixels count from the first one's center."""
    fx, fy, cx, cy = LENS
    k = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    fx, fy, cx, cy = pinhole.intrinsics
    new = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    make = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    return make(k, np.array(BENT[model]), np.eye(3), new, pinhole.size, cv2.CV_32FC1)


@pytest.mark.parametrize("model", BENT)
def test_distortion_is_opencvs(model):
    camera, pinhole = Camera((1280, 720), LENS, model, BENT[model]), Camera((160, 90), (75.0, 75.0, 80.2, 44.9))
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(90) + 0.5)
    column, row = camera.project((u - 80.2) / 75.0, (v - 44.9) / 75.0)
    theirs = opencv_map(model, pinhole)
    np.testing.assert_allclose(column - 0.5, theirs[0], atol=2e-3)
    np.testing.assert_allclose(row - 0.5, theirs[1], atol=2e-3)


@pytest.mark.parametrize("d", [(), (0.0,) * 4])
def test_a_fisheye_without_coefficients_is_no_pinhole(d):
    camera, x = Camera((1280, 720), LENS, "equidistant", d), np.array([0.0, 0.5, 1.5])
    column, _ = camera.project(x, 0.0 * x)
    np.testing.assert_allclose(column, LENS[0] * np.arctan(x) + LENS[2])  # the radius is the angle from the axis
    assert camera.is_distorted and not Rectifier(camera, camera.without_distortion(), 0.5).is_identity


@pytest.mark.parametrize("model", BENT)
def test_a_distorted_picture_becomes_the_pinhole_cameras(model):
    """A smooth pattern is a function of the rays; photographed through the lens and rectified, it is that function
    again.
    """

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([128 + 100 * np.sin(9 * x + k) * np.cos(7 * y) for k in range(3)], -1)

    camera, pinhole = Camera((1280, 720), LENS, model, BENT[model]), Camera((160, 90), (75.0, 75.0, 80.2, 44.9))
    wanted = np.meshgrid(np.arange(4.0, 1280, 8), np.arange(4.0, 720, 8))  # cells of 8 px, scaled up below
    rays = [np.zeros_like(wanted[0])] * 2
    for _ in range(60):  # inverts the lens: the ray moves by the pixel's error
        off = np.subtract(wanted, camera.project(*rays))
        rays = [np.clip(ray + one / focal, -1.5, 1.5) for ray, one, focal in zip(rays, off, LENS[:2], strict=True)]
    seen = (np.abs(rays[0]) < 1.15) & (np.abs(rays[1]) < 0.65)  # what the pinhole camera sees, and some more
    assert np.abs(off[:, seen]).max() < 1e-3
    rays = cv2.resize(np.dstack(rays), (1280, 720), interpolation=cv2.INTER_CUBIC)
    photo = pattern(rays[..., 0], rays[..., 1]).clip(0, 255)
    rectified = Rectifier(camera, pinhole)(photo.astype(np.uint8))
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(90) + 0.5)
    truth = pattern((u - 80.2) / 75.0, (v - 44.9) / 75.0)
    error = np.abs(rectified - truth)[8:-8, 8:-8]
    assert np.median(error) < 1.0 and np.percentile(error, 99) < 3.0


def test_the_policys_own_picture_passes_unchanged():
    camera = Camera((128, 96), (100.0, 101.0, 63.0, 47.0))
    rectify = Rectifier(camera, camera)
    assert rectify.is_identity and rectify(SMOOTH) is SMOOTH


def test_whole_scales_are_plain_averages():
    """Without distortion, eight by eight pixels become one, their mean, as a larger sensor pixel would measure."""
    native = Camera((1280, 720), (530.0, 530.0, 640.0, 360.0))
    picture = np.random.default_rng(1).integers(0, 256, (720, 1280, 3), np.uint8)
    small = Rectifier(native, native.resized((160, 90)))(picture)
    mean = picture.reshape(90, 8, 160, 8, 3).mean((1, 3))
    np.testing.assert_allclose(small, mean, atol=0.51)


def test_resizing_equals_that_of_twin():
    ours = Camera((640, 480), (500.0, 501.0, 322.0, 239.0)).resized((160, 90))
    theirs = PixelCamera((500.0, 501.0, 322.0, 239.0), (640, 480)).resized((160, 90))
    assert ours.intrinsics == theirs.intrinsics and ours.size == theirs.size


def test_camera_info_of_a_region_at_half_resolution():
    info = camera_info(LENS, (1280, 720), 0).message
    whole = Camera.from_info(info)
    np.testing.assert_allclose(whole.intrinsics, LENS)
    info.binning_x = info.binning_y = 2
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 200, 100, 640, 480
    part = Camera.from_info(info)
    assert part.size == (320, 240)
    x, y = np.array([0.1, -0.2]), np.array([0.05, 0.1])
    full, cut = whole.project(x, y), part.project(x, y)
    np.testing.assert_allclose(cut[0], (full[0] - 200) / 2)
    np.testing.assert_allclose(cut[1], (full[1] - 100) / 2)
    assert Camera.from_info(info, rectified=True).distortion == ()


def test_rays_beyond_the_fold_of_a_distortion_are_not_seen():
    """The polynomial of strong barrel distortion decreases far out, where a ray would get the pixel of one nearer to
    the axis.
    """
    bent = Camera((1280, 720), (400.0, 400.0, 640.0, 360.0), "plumb_bob", (-0.28, 0.0, 0.0, 0.0))
    assert bent.reach() == pytest.approx(np.sqrt(1 / (3 * 0.28)), abs=0.01)
    with pytest.raises(PictureError, match="does not see"):
        Rectifier(bent, Camera((160, 90), (50.0, 50.0, 80.0, 45.0)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera((1280, 720), (0.0, 0.0, 0.0, 0.0)), "is the camera calibrated"),
        (lambda: Camera((1280, 720), (float("nan"), 1.0, 1.0, 1.0)), "expected finite numbers"),
        (lambda: Camera((1280, 720), LENS, "fov", (0.9,)), "distortion model 'fov'; expected none, plumb_bob"),
        (lambda: Camera((1280, 720), LENS, "plumb_bob", (0.1, 0.2)), "2 coefficients of 'plumb_bob'; expected 4 or 5"),
        (
            lambda: Rectifier(Camera((1280, 720), (900.0, 900.0, 640.0, 360.0)), Camera((160, 90), (66, 66, 80, 45))),
            r"does not see \d+% of the policy's picture; expected at most 5%",
        ),
        (
            lambda: Rectifier(Camera((64, 64), (50.0, 50.0, 32.0, 32.0)), Camera((32, 32), (25, 25, 16, 16)))(SMOOTH),
            r"picture \(96, 128, 3\) uint8; expected 64 x 64 px",
        ),
    ],
)
def test_bad_cameras_are_refused_in_one_line(make, message):
    with pytest.raises(PictureError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
