"""The review stage on a scene whose field is a few lines of arithmetic: what is filmed, counted and said."""

import dataclasses
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from films import video_info
from tiny_world import tiny_ground

from twin.config import ReviewConfig, SceneConfig, SourceConfig
from twin.files import read_json
from twin.geometry.cameras import (
    FAR,
    Cameras,
    PosedCameras,
    Rendering,
    Viewpoints,
    intrinsics_for_size,
    nearest_frame,
    pixel_grid,
    unproject,
)
from twin.geometry.images import read_image, write_image
from twin.geometry.poses import look_at
from twin.mjcf.scene_xml import Parts
from twin.report import review_video
from twin.report.review_chapters import (
    Studio,
    appearance_of_frame,
    comparison_row,
    error_colors,
    frames_to_compare,
    gray_out,
    lighting_at,
    spread_choice,
)
from twin.report.review_video import overview_pose, prefetched, trust_metrics, write_review_video
from twin.report.video_layout import (
    FrameLayout,
    MapView,
    depth_colors,
    draw_text,
    fit,
    footprints,
    map_rotation,
    scale_bar,
    shorten,
    side_by_side,
    text_width,
    wrap,
)
from twin.report.video_writer import read_frames
from twin.scene import SceneDir


class CheckeredField:
    """A radiance field of a checkered floor at z = 0 under a sky; a lighting is a brightness."""

    def __init__(self, brightness: dict[str, float]):
        self.brightness = brightness
        self.asked: list[str] = []

    @property
    def lightings(self) -> tuple[str, ...]:
        return tuple(self.brightness)

    def render(self, cameras: PosedCameras, lighting: str, size: tuple[int, int] | None = None) -> Rendering:
        self.asked.append(lighting)
        intrinsics, size = intrinsics_for_size(cameras, size)
        a, b, share = lighting.split(":") if ":" in lighting else (lighting, lighting, "0")
        dark, bright = (self.brightness[name.split("/")[0]] for name in (a, b))
        level = (1 - float(share)) * dark + float(share) * bright
        views = [self._view(pose, k, size, level) for pose, k in zip(cameras.camera_to_world, intrinsics, strict=True)]
        return Rendering(*(np.stack(part).astype(np.float32) for part in zip(*views, strict=True)))

    def _view(
        self, pose: np.ndarray, k: np.ndarray, size: tuple[int, int], level: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rays = unproject(pixel_grid(*size), k) @ pose[:3, :3].T
        down = rays[..., 2] < -1e-6
        depth = np.where(down, -pose[2, 3] / np.where(down, rays[..., 2], -1.0), FAR)
        floor = pose[:3, 3] + rays * depth[..., None]
        odd = (np.floor(floor[..., 0]) + np.floor(floor[..., 1])) % 2
        color = np.stack([0.3 + 0.4 * odd, 0.35 + 0.3 * odd, 0.3 + 0.2 * odd], -1)
        rgb = level * np.where(down[..., None], color, [0.5, 0.7, 1.0])
        return rgb, depth, down.astype(float)


def make_cameras(folder: Path, field: CheckeredField, frames: int = 12, size: tuple[int, int] = (96, 54)) -> Cameras:
    """Saved cameras on a straight path under each lighting, with images of the field; a metric stage's result."""
    lightings = [name for name in field.lightings for _ in range(frames)]
    x = np.tile(np.linspace(0.0, 22.0, frames), len(field.lightings))
    poses = np.array([look_at(np.array([v, 0.0, 1.5]), np.array([v + 5.0, 0.0, 1.0])) for v in x])
    k = np.tile([0.5 * size[0], 0.5 * size[0], size[0] / 2, size[1] / 2], (len(x), 1))
    images = folder.parent / "2_cameras" / "images"
    cameras = Cameras(
        names=tuple(f"{name}/{i % frames:06d}" for i, name in enumerate(lightings)),
        camera_to_world=poses,
        intrinsics=k,
        sizes=np.tile(np.array(size), (len(x), 1)),
        lightings=tuple(lightings),
        sources=tuple(lightings),
        times=np.tile(np.arange(frames) * 0.5, len(field.lightings)),
        held_out=np.arange(len(x)) % 4 == 2,
        images=images,
    )
    for i, name in enumerate(lightings):
        write_image(cameras.image_path(i), field.render(Viewpoints.of(poses[i], k[i], size), name).rgb[0])
    folder.mkdir(parents=True, exist_ok=True)
    cameras.save(folder)
    return cameras


def config(**review: float) -> SceneConfig:
    small = {"width": 160, "render_width": 48, "renders": 20, "fps": 5} | review
    return SceneConfig(name="checkers", source=(SourceConfig("a.mp4"),), review=ReviewConfig(**small))  # type: ignore[arg-type]


@pytest.fixture
def scene(tmp_path: Path) -> SceneDir:
    return SceneDir(tmp_path / "scene")


def test_a_scene_without_a_route_is_filmed_and_says_so(scene: SceneDir, tmp_path: Path) -> None:
    field = CheckeredField({"day": 1.0, "night": 0.25})
    make_cameras(scene.stage("metric"), field)
    field.asked.clear()
    out = tmp_path / "out"
    out.mkdir()
    metrics = write_review_video(scene, config(), out, field)
    assert metrics["follower"] is None
    assert "no route" in metrics["not_applicable"]
    about = video_info(out / "review.mp4")
    assert (about["codec"], about["pixel_format"]) == ("h264", "yuv420p")
    assert about["frames"] == metrics["frames"] == len(list(read_frames(out / "review.mp4")))
    assert metrics["duration_s"] == metrics["frames"] / 5
    assert metrics["renders"] == len(field.asked) - 1 <= 20  # the first one only warms up
    assert any(name.startswith("day:night:") for name in field.asked)
    told = read_json(out / "review.json")
    assert "render_seconds_per_frame" in metrics and "render_seconds_per_frame" not in told
    for picture in told["pictures"]:
        assert (out / picture["file"]).stat().st_size > 0
    assert {picture["section"] for picture in told["pictures"]} == {"capture", "field", "poster"}


def test_a_route_switched_off_is_distinguished_from_none_found(scene: SceneDir, tmp_path: Path) -> None:
    field = CheckeredField({"day": 1.0})
    make_cameras(scene.stage("metric"), field)
    out = tmp_path / "out"
    out.mkdir()
    base = config()
    metrics = write_review_video(
        scene, dataclasses.replace(base, mjcf=dataclasses.replace(base.mjcf, route=False)), out, field
    )
    assert "mjcf.route = false" in metrics["not_applicable"]
    assert metrics["renders"] <= 5  # the first chapter's share: one lighting turns into nothing


def test_the_same_scene_makes_the_same_pictures(scene: SceneDir, tmp_path: Path) -> None:
    """On a busy machine, x264 may code the same pictures in other bytes, so films are compared picture by picture."""
    field = CheckeredField({"day": 1.0, "night": 0.25})
    make_cameras(scene.stage("metric"), field)
    contents = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_review_video(scene, config(), tmp_path / name, field)
        files = sorted(p for p in (tmp_path / name).rglob("*") if p.is_file())
        contents.append([(p.relative_to(tmp_path / name), p.read_bytes()) for p in files if p.suffix != ".mp4"])
    assert contents[0] == contents[1]
    films = [read_frames(tmp_path / name / "review.mp4") for name in ("a", "b")]
    assert all(np.array_equal(one, other) for one, other in zip(*films, strict=True))


def test_the_header_has_room_for_a_long_note_beside_a_short_title(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    monkeypatch.setattr("twin.report.video_layout.draw_text", lambda image, text, *_, **__: drawn.append(text))
    note = "2× speed, lighting: training: sun 0.59, night 0.41"
    layout = FrameLayout.for_pictures(480, 9 / 16)
    layout.canvas("straight: first", note)
    layout.canvas("a long title " * 9, note)
    assert drawn[:2] == ["straight: first", note]
    assert drawn[2].endswith("…") and drawn[3].endswith("…")


def test_frames_to_compare_show_both_kinds_in_order(tmp_path: Path) -> None:
    cameras = make_cameras(tmp_path / "build" / "2_metric", CheckeredField({"day": 1.0, "night": 0.3}))
    chosen = frames_to_compare(cameras, "night", 6)
    assert chosen == sorted(chosen) and len(chosen) == len(set(chosen)) == 6
    assert {cameras.lightings[i] for i in chosen} == {"night"}
    assert sum(cameras.held_out[i] for i in chosen) == 3
    assert frames_to_compare(cameras, "dusk", 6) == []


def test_a_held_out_frame_gets_the_light_of_its_neighbors(tmp_path: Path) -> None:
    cameras = make_cameras(tmp_path / "build" / "2_metric", CheckeredField({"day": 1.0, "night": 0.3}))
    assert appearance_of_frame(cameras, 13) == "night/000001"
    assert appearance_of_frame(cameras, 14) == "night/000001:night/000003:0.5"
    last = cameras.select(np.arange(3))  # its last frame is held out
    assert appearance_of_frame(last, 2) == "day/000001"
    assert appearance_of_frame(cameras.select(cameras.held_out), 0) == "day"


def test_the_nearest_frame_is_at_the_same_place(tmp_path: Path) -> None:
    cameras = make_cameras(tmp_path / "build" / "2_metric", CheckeredField({"day": 1.0, "night": 0.3}))
    assert nearest_frame(cameras, 3, "night") == 12 + 3
    assert nearest_frame(cameras, 3, "dusk") is None


@pytest.mark.parametrize(("count", "expected"), [(0, []), (1, [5]), (2, [0, 9]), (3, [0, 4, 9]), (99, list(range(10)))])
def test_a_spread_choice_has_the_middle_or_both_ends(count: int, expected: list[int]) -> None:
    assert spread_choice(range(10), count) == expected


def test_every_lighting_has_its_segment_of_the_drive() -> None:
    lightings = ("day", "dusk", "night")
    assert lighting_at(lightings, 0.0) == ("day", "day")
    assert lighting_at(lightings, 0.5) == ("dusk", "dusk")
    assert lighting_at(lightings, 1.0) == ("night", "night")
    code, words = lighting_at(lightings, 0.3)
    assert code.startswith("day:dusk:0.6") and words == "day → dusk"
    assert lighting_at(("day",), 0.99) == ("day", "day")


def test_panels_do_not_overlap_and_fit_the_canvas() -> None:
    for layout in (
        FrameLayout.for_pictures(480, 9 / 16),
        FrameLayout.for_pictures(161, 3.0),
        FrameLayout.for_pictures(480, 0.2),
    ):
        width, height = layout.size
        assert width % 2 == height % 2 == 0
        covered = np.zeros((height, width), int)
        for x, y, w, h in (layout.left, layout.right, *layout.strip(0.3, 0.42, 0.28)):
            assert x >= 0 and y >= layout.header and x + w <= width and y + h <= height
            covered[y : y + h, x : x + w] += 1
        assert covered.max() == 1


def test_text_is_cut_and_wrapped_to_its_width() -> None:
    long = "a rather long name of a lighting that nobody would choose"
    assert text_width(shorten(long, 120, 14), 14) <= 120
    assert shorten("short", 120, 14) == "short"
    lines = wrap(long, 120, 14)
    assert " ".join(lines) == long
    assert all(text_width(line, 14) <= 120 for line in lines)


def test_text_beyond_the_edge_is_clipped() -> None:
    canvas = np.zeros((20, 40, 3), np.uint8)
    draw_text(canvas, "over the edge", 30, 10, 14)
    draw_text(canvas, "outside", 100, 100, 14)
    assert canvas[:, 30:].any()


def test_fit_keeps_proportions() -> None:
    white = np.full((100, 50, 3), 255, np.uint8)
    out = fit(white, (90, 60))
    assert out.shape == (60, 90, 3)
    assert (out == 255).all(-1).sum() == 60 * 30


def test_depth_colors_are_brighter_when_near_and_empty_without_depth() -> None:
    shades = depth_colors(np.array([[1.0, 5.0, 30.0, FAR]]), np.array([[1.0, 1.0, 1.0, 0.0]]))
    brightness = shades.astype(int).sum(-1)[0]
    assert brightness[0] > brightness[1] > brightness[2]
    assert tuple(shades[0, 3]) == (28, 34, 43)


def test_the_map_runs_from_left_to_right() -> None:
    path = np.stack([np.full(20, 3.0), np.linspace(0, -30, 20)], 1)  # southwards
    plan = MapView.draw((200, 80), path)
    start, end = path[[0, -1]] @ plan.to_pixel[:, :2].T + plan.to_pixel[:, 2]
    assert start[0] < 40 and end[0] > 160
    assert start[1] == pytest.approx(40, abs=1) and end[1] == pytest.approx(40, abs=1)
    assert np.linalg.det(map_rotation(path)) == pytest.approx(1.0)
    # To the right of a southward path lies west, which is below it in the plan.
    west = plan.to_pixel @ [0.0, -15.0, 1.0]
    assert west[1] > 45


def test_footprints_are_outlines_and_flat_or_high_parts_have_none() -> None:
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    wall = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    outlines = footprints(Parts([cube, wall, cube + np.float32([0, 0, 5])], []), tiny_ground())
    assert len(outlines) == 1
    assert sorted(map(tuple, outlines[0])) == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_the_overview_camera_looks_along_the_route() -> None:
    route = np.stack([np.linspace(0, 40, 50), np.zeros(50), np.zeros(50)], 1)
    for s in (0.0, 20.0, 40.0):
        pose = overview_pose(route, s)
        assert pose[0, 2] > 0.5 and pose[2, 2] < 0 and pose[2, 3] > 1.0


def test_what_is_masked_is_gray_and_the_rest_untouched() -> None:
    image = np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8)
    ignored = np.zeros((40, 60), bool)
    ignored[:, :20] = True
    out = gray_out(image, ignored)
    assert (out[:, 20:] == image[:, 20:]).all()
    assert (out[:, :20] == out[:, :20, :1]).all()


def test_a_row_of_pictures_has_one_height() -> None:
    row = side_by_side([np.zeros((50, 100, 3), np.uint8), np.zeros((200, 100, 3), np.uint8)], 40)
    assert row.shape == (40, 80 + 6 + 20, 3)


def test_prefetching_keeps_order_and_passes_errors_on() -> None:
    with prefetched(iter(range(20)), depth=3) as items:
        assert list(items) == list(range(20))

    def fails() -> Iterator[int]:
        yield 1
        raise ValueError("broken")

    with prefetched(fails(), depth=3) as items, pytest.raises(ValueError, match="broken"):
        list(items)


def test_prefetching_stops_when_nobody_reads() -> None:
    made = []

    def endless() -> Iterator[int]:
        while True:
            made.append(len(made))
            yield made[-1]

    with prefetched(endless(), depth=2) as items:
        assert next(items) == 0
    count = len(made)
    assert count <= 5
    assert len(made) == count


@pytest.mark.parametrize("masked", [False, True])
def test_a_comparison_row_shows_the_lighting_as_learned_and_scores_what_is_not_masked(
    tmp_path: Path, masked: bool
) -> None:
    field = CheckeredField({"day": 1.0, "night": 0.25})
    cameras = make_cameras(tmp_path / "build" / "2_metric", field, size=(320, 180))
    if masked:
        cameras = dataclasses.replace(cameras, masks=tmp_path / "masks")
        ignored = np.zeros((180, 320), np.uint8)
        ignored[:, 160:] = 255
        write_image(tmp_path / "masks" / f"{cameras.names[14]}.png", ignored)
        spoilt = read_image(cameras.image_path(14))
        spoilt[:, :150] = 255  # what the mask ignores
        write_image(cameras.image_path(14), spoilt)
    layout = FrameLayout.for_pictures(160, 9 / 16)
    studio = Studio("x", field, cameras, layout, None, tmp_path, 48, cameras.positions[:, :2])  # type: ignore[arg-type]
    field.asked.clear()
    row, score = comparison_row(studio, 14)
    assert field.asked == ["night"]
    assert score > 50.0  # only the rounding to bytes is wrong
    wrong = row[30 : 30 + 180, -6 - 320 : -6]
    dark = error_colors(np.zeros((1, 1)))[0, 0]
    assert (np.abs(wrong[5:-5, 165:-5].astype(int) - dark).max(-1) < 5).all()
    assert (wrong[5:-5, :145] == [150, 160, 174]).all() == masked
    assert (error_colors(np.array([[0.1, 0.3, 0.9]])).astype(int).sum(-1)[0] > int(dark.sum())).all()


def test_labels_of_a_scale_do_not_overlap() -> None:
    ramp = np.zeros((1, 60, 3), np.uint8)
    crowded = scale_bar(80, ramp, [(0.0, "near"), (0.4, "between"), (0.5, "both"), (1.0, "far")])
    assert np.array_equal(crowded, scale_bar(80, ramp, [(0.0, "near"), (1.0, "far")]))


def test_trust_counts_from_the_start_and_in_the_corridor() -> None:
    s, offsets = np.array([0.0, 1.5, 3.0]), np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    trust = np.tile([0.1, 0.9, 0.7], (5, 1))
    trust[0] = 0.0  # beside the corridor
    found = trust_metrics(s, offsets, trust, 1.0)
    assert found == {"mean": pytest.approx(0.8), "lowest": 0.7, "lowest_at_m": 3.0, "low_share": 0.0}
    assert trust_metrics(s, offsets, trust, 0.0)["lowest_at_m"] == 0.0


@pytest.mark.parametrize("length", [3.0, 60.0, 300.0, 5000.0])
def test_the_trust_map_of_a_long_route_is_legible(length: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its picture fits the page without being shrunk, and its labels do not overlap."""
    drawn: list[tuple[int, int]] = []  # left and right end of the labels below the map

    def draw(canvas: np.ndarray, text: str, x: int, y: int, size: int, *_: object, **__: object) -> None:
        if y > canvas.shape[0] // 2 and text[0].isdigit():
            drawn.append((x, x + text_width(text, size)))

    monkeypatch.setattr(review_video, "draw_text", draw)
    s, offsets = np.arange(0.0, length, 1.5), np.linspace(-4.0, 4.0, 9)
    width = review_video.trust_picture(s, offsets, np.ones((9, len(s)))).shape[1]
    assert width <= 1000 and len(drawn) >= 1 and drawn[-1][1] <= width
    assert all(left > right for (_, right), (left, _) in pairwise(drawn))
