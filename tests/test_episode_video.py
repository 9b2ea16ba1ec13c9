"""The film's last chapter and the numbers of a drive, on drives that are known by construction."""

import io
from pathlib import Path

import numpy as np
import pytest
from test_review import CheckeredField, make_cameras
from tqdm import tqdm

from twin.env.drivers import RecordedDrive
from twin.geometry.poses import look_at
from twin.mjcf.world import World
from twin.report.review_chapters import Studio, frame_timing, smoothed_speed, write_drive_chapter
from twin.report.review_video import drive_metrics, drive_trace
from twin.report.video_layout import FrameLayout, MapView
from twin.report.video_writer import VideoWriter, frame_indices, read_frames
from twin.robot import PixelCamera


def drive_along(
    x: np.ndarray, y: np.ndarray, yaw: np.ndarray, outcome: str = "goal", touched: tuple = ()
) -> RecordedDrive:
    """A drive through given places, one per 0.1 s, its camera half a meter up."""
    base = np.tile(np.eye(4), (len(x), 1, 1))
    base[:, 0, 0], base[:, 0, 1], base[:, 1, 0], base[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    base[:, 0, 3], base[:, 1, 3] = x, y
    eyes = [look_at(p[:3, 3] + [0, 0, 0.5], p[:3, 3] + p[:3, 0] * 5) for p in base]
    return RecordedDrive(
        times=0.1 * np.arange(len(x)),
        base_to_world=base,
        camera_to_world=np.array(eyes),
        qpos=np.zeros((len(x), 7)),
        commands=np.zeros((len(x), 2)),
        cross_track=y.copy(),
        progress=x.copy(),
        touched=touched,
        outcome=outcome,
    )


def straight(k: int = 101) -> RecordedDrive:
    x = np.linspace(0.0, 0.1 * (k - 1), k)
    return drive_along(x, 0.2 * np.sin(x), np.zeros(k))


def test_metrics_of_a_quarter_circle_to_the_right_are_exact() -> None:
    angle = np.linspace(0.0, np.pi / 2, 401)
    metrics = drive_metrics(drive_along(10 * np.sin(angle), -10 * (1 - np.cos(angle)), -angle))
    assert metrics["turn_deg"] == pytest.approx(-90.0)
    assert metrics["distance_m"] == pytest.approx(5 * np.pi, rel=1e-4)
    assert metrics["seconds"] == pytest.approx(40.0)
    assert metrics["reached_goal"] is True and metrics["touched"] == []


def test_a_turn_beyond_half_a_circle_is_counted_in_full() -> None:
    angle = np.linspace(0.0, 1.5 * np.pi, 301)
    assert drive_metrics(drive_along(np.sin(angle), 1 - np.cos(angle), angle))["turn_deg"] == pytest.approx(270.0)


def test_speed_is_that_of_the_base() -> None:
    drive = straight()
    drive.cross_track[:] = 0
    steady = drive_along(drive.progress, np.zeros(101), np.zeros(101))
    assert smoothed_speed(steady).shape == (101,)
    assert smoothed_speed(steady)[5:] == pytest.approx(1.0)


def test_a_trace_keeps_both_ends_and_is_short() -> None:
    thin = drive_trace(straight(1001))
    assert {len(v) for v in thin.values()} == {200}
    assert thin["progress_m"][0] == 0.0 and thin["progress_m"][-1] == pytest.approx(100.0)


@pytest.mark.parametrize(("instants", "fps"), [(101, 10), (601, 10), (3001, 10), (601, 30), (101, 30)])
def test_a_long_drive_is_shown_faster(instants: int, fps: int) -> None:
    every, hold = frame_timing(straight(instants), fps)
    seconds = len(frame_indices(instants, every)) * hold / fps
    assert 5.0 < seconds < 17.0
    assert every >= 1 and hold >= 1


@pytest.mark.parametrize(
    ("outcome", "instants"), [("goal", 101), ("touched", 101), ("off_corridor", 101), ("timeout", 101), ("touched", 1)]
)
def test_the_drive_is_filmed_within_its_budget(tmp_path: Path, outcome: str, instants: int) -> None:
    field = CheckeredField({"day": 1.0, "night": 0.25})
    cameras = make_cameras(tmp_path / "build" / "2_metric", field)
    field.asked.clear()
    drive = drive_along(np.linspace(0, 10, instants), np.zeros(instants), np.zeros(instants), outcome, ("tree",))
    world = World(
        np.column_stack([np.linspace(0, 10, 50), np.zeros((50, 2))]),
        1.0,
        (0.0, 0.0, 0.0, 0.0),
        tmp_path,
        PixelCamera((80.0, 80.0, 80.0, 45.0), (160, 90)),
    )
    layout = FrameLayout.for_pictures(160, 9 / 16)
    route = world.route[:, :2]
    with VideoWriter(tmp_path / "film.mp4", layout.size, 5) as writer, tqdm(file=io.StringIO()) as progress:
        studio = Studio("place", field, cameras, layout, writer, tmp_path, 48, route)
        indices = frame_indices(instants, frame_timing(drive, 5)[0])
        chase = [np.full((layout.panel[1], layout.panel[0], 3), i % 256, np.uint8) for i in indices]
        write_drive_chapter(studio, MapView.draw((200, 60), route), world, drive, chase, 12, progress)
    assert 0 < studio.renders <= 12
    assert field.asked[0] == "day" and field.asked[-1] == ("night" if instants > 1 else "day")
    assert len(list(read_frames(tmp_path / "film.mp4"))) == writer.frames > len(indices)
    assert {picture["section"] for picture in studio.pictures} == {"poster", "review"}
