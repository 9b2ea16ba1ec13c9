"""Poles: thin upright things are found in the films, supervise the field, and become solid."""

from dataclasses import replace

import numpy as np
import pytest
from analytic import AnalyticField, Box, Post, waves

from twin.assets.solids import Corridor, pole_parts
from twin.geometry.cameras import Cameras, SparsePoints, Viewpoints, pixel_grid, project, unproject
from twin.geometry.images import read_image, write_image
from twin.geometry.poses import look_at
from twin.nerf import poles as poles_module
from twin.nerf.dataset import DepthSupervision, TrainingPixels, join_depths
from twin.nerf.poles import Poles, find_poles, pole_depths

WIDTH, HEIGHT = 320, 180
K = np.array([220.0, 220.0, 160.0, 90.0])
LENS = 1.2  # [m] above the ground
WALLS = (Box(22.0, 0.0, 1.0, 30.0, 6.0), Box(10.0, 9.0, 30.0, 0.5, 5.0))
POST, BOLLARD, COLUMN = (8.0, 2.6, 0.05, 2.2), (6.0, -2.2, 0.07, 0.9), (9.0, -3.5, 0.4, 2.5)
"""x, y, radius and height [m]."""


pytestmark = pytest.mark.usefixtures("quiet")


def pattern(points: np.ndarray) -> np.ndarray:
    """Gray in [0, 1] of places (..., 3)."""
    return 0.55 + waves(points, 16, 0.09)


def film(folder, things=(), n=12, width=WIDTH, moved=lambda i: 0.0) -> TrainingPixels:
    """A drive along x toward a wall, past dark posts; `moved` shifts all of them to the left in frame i [m]."""
    eyes = np.stack([np.linspace(0.0, 5.5, n), np.zeros(n), np.full(n, LENS)], 1)
    pose = np.stack([look_at(eye, eye + np.array([5.0, 0.0, -0.5])) for eye in eyes])
    depth = np.stack(
        [
            AnalyticField(WALLS, tuple(Post(x, y + moved(i), *size) for x, y, *size in things), amplitude=0.0)
            .render(Viewpoints.of(pose[i], K, (WIDTH, HEIGHT)), "day")
            .depth[0]
            for i in range(n)
        ]
    )
    names = tuple(f"day/{i:06d}" for i in range(n))
    (folder / "day").mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        rays = unproject(pixel_grid(WIDTH, HEIGHT), K)
        places = (rays * depth[i][..., None]) @ pose[i, :3, :3].T + pose[i, :3, 3]
        gray = pattern(places)
        for x, y, radius, height in things:
            away = np.linalg.norm(places[..., :2] - (x, y + moved(i)), axis=-1)
            gray[(away < radius + 0.01) & (places[..., 2] > 0.02) & (places[..., 2] < height + 0.01)] = 0.1
        write_image(folder / f"{name}.png", np.repeat((np.clip(gray, 0, 1) * 255).astype(np.uint8)[..., None], 3, -1))
    cameras = Cameras(
        *(names, pose, np.tile(K, (n, 1)), np.tile([WIDTH, HEIGHT], (n, 1)), ("day",) * n, ("day",) * n),
        *(np.arange(n) / 2.0, np.zeros(n, bool), folder),
    )
    return TrainingPixels(cameras, SparsePoints.empty(), width)


def recolor(pixels: TrainingPixels, i: int, change) -> None:
    path = pixels.cameras.image_path(i)
    write_image(path, change(read_image(path)))


def test_a_post_and_a_bollard_are_found_where_they_stand(tmp_path):
    found = find_poles(film(tmp_path, (POST, BOLLARD)), LENS)
    assert len(found) == 2
    for x, y, radius, height in (POST, BOLLARD):
        off = np.linalg.norm(found.foot[:, :2] - (x, y), axis=1)
        k = off.argmin()
        assert off[k] < 0.05
        assert 0.7 * radius < found.radius[k] < 1.5 * radius
        assert abs(found.height[k] - height) < 0.35 and abs(found.foot[k, 2]) < 1e-6


@pytest.mark.parametrize("height", [3.6, 4.4])
def test_a_tall_post_is_followed_to_its_top(tmp_path, height):
    """Far pictures show the part that is above the near ones."""
    found = find_poles(film(tmp_path, ((13.0, 5.5, 0.07, height), BOLLARD), n=24), LENS)
    tall = int(found.height.argmax())
    assert len(found) == 2 and np.linalg.norm(found.foot[tall, :2] - (13.0, 5.5)) < 0.1
    assert abs(found.height[tall] - height) < 0.35 and found.height[1 - tall] < 1.3


def test_a_tall_post_that_no_far_picture_shows_keeps_its_height(tmp_path):
    pixels = film(tmp_path, ((13.0, 5.5, 0.07, 4.4),), n=24)
    poles = Poles(np.array([[5.0, 1.0, 0.0]]), np.array([0.07]), np.array([3.1]))  # within 6 m of every frame
    assert poles_module._extended(pixels, np.arange(24), poles).height.tolist() == [3.1]


def test_a_post_on_the_border_of_two_squares_is_found_once(tmp_path):
    pixels = film(tmp_path, (POST,))
    pixels.cameras.camera_to_world[:, 1, 3] += 20.0 - POST[1]  # the search is divided at multiples of 20 m
    (foot,) = find_poles(pixels, LENS).foot
    assert np.linalg.norm(foot[:2] - (POST[0], 20.0)) < 0.05


def test_pictures_finer_than_those_of_training_are_searched(tmp_path):
    """A post 9 px wide is 2 px wide in these."""
    (foot,) = find_poles(film(tmp_path, (POST,), width=WIDTH // 4), LENS).foot
    assert np.linalg.norm(foot[:2] - POST[:2]) < 0.05


def test_a_post_may_be_brighter_in_another_film(tmp_path):
    """As if from the other side; a bar's color need be the same within a film only."""
    pixels = film(tmp_path, (POST,))
    second = np.arange(12) % 2 == 1
    sources = tuple(np.where(second, "back", "there"))
    for i in np.flatnonzero(second):
        recolor(pixels, i, lambda colors: np.where(colors < 40, 250, colors))
    assert len(find_poles(pixels, LENS)) == 0
    pixels.cameras = replace(pixels.cameras, sources=sources)
    (foot,) = find_poles(pixels, LENS).foot
    assert np.linalg.norm(foot[:2] - POST[:2]) < 0.05


MOVED = {"to and fro": lambda i: 0.03 * (-1) ** i, "sometimes": lambda i: 0.04 * (i % 3 == 0)}


@pytest.mark.parametrize("moved", MOVED)
def test_a_bar_that_is_not_at_one_place_is_no_pole(tmp_path, monkeypatch, moved):
    pixels = film(tmp_path, (POST,), moved=MOVED[moved])
    assert len(find_poles(pixels, LENS)) == 0
    monkeypatch.setattr(poles_module, "_agree", lambda *_: True)
    assert len(find_poles(pixels, LENS)) == 1  # its contrast and color are those of a pole


@pytest.mark.parametrize("films", [2, 4])
def test_a_post_in_several_short_films_of_a_lighting_is_found(tmp_path, films):
    pixels = film(tmp_path, (POST,))
    pixels.cameras = replace(pixels.cameras, sources=tuple(str(i % films) for i in range(12)))
    (foot,) = find_poles(pixels, LENS).foot
    assert np.linalg.norm(foot[:2] - POST[:2]) < 0.12  # along the line of sight


def test_what_passes_before_a_post_and_is_masked_does_not_count(tmp_path):
    pixels = film(tmp_path, (POST,))
    for i in (1, 3, 6):
        pose = pixels.cameras.camera_to_world[i]
        (u, _), z = (value[0] for value in project(np.array([[*POST[:2], 1.0]]), pose, K))
        left, right = (int(np.clip(u + side * 0.3 * 220.0 / z, 0, WIDTH)) for side in (-1, 1))
        stripes = (np.arange(left, right) // 7 % 2 * 200).astype(np.uint8)[:, None]

        def paint(colors, left=left, right=right, stripes=stripes):
            colors = colors.copy()
            colors[:, left:right] = stripes
            return colors

        recolor(pixels, i, paint)
        pixels.unmasked[pixels.start[i] : pixels.start[i + 1]].reshape(HEIGHT, WIDTH)[:, left:right] = False
    (foot,) = find_poles(pixels, LENS).foot
    assert np.linalg.norm(foot[:2] - POST[:2]) < 0.05


def test_a_rejected_bar_does_not_hide_the_post_beside_it(tmp_path, monkeypatch):
    pixels, agree, asked = film(tmp_path, (POST, (8.0, 2.95, 0.05, 2.2))), poles_module._agree, []

    def first_refused(pictures, pole, found):
        asked.append(pole.foot[0])
        return len(asked) > 1 and agree(pictures, pole, found)

    monkeypatch.setattr(poles_module, "_agree", first_refused)
    monkeypatch.setattr(poles_module, "_LAST_STEPS", (0.0,))  # no spot farther away may climb to the post
    (foot,) = find_poles(pixels, LENS).foot
    assert 0.2 < np.linalg.norm(foot[:2] - asked[0][:2]) < 0.5


def test_masked_pixels_show_no_pole(tmp_path):
    """Such as those of a bollard that left: it is masked in the lightings in which it stood."""
    pixels = film(tmp_path, (POST, BOLLARD))
    shown = np.zeros(len(pixels.colors), bool)
    for i, pose in enumerate(pixels.cameras.camera_to_world):
        axis = np.column_stack([np.tile(BOLLARD[:2], (60, 1)), np.linspace(0.0, 1.0, 60)])
        pixel, depth = project(axis, pose, K)
        for (u, v), z in zip(pixel, depth, strict=True):
            half = 220.0 * 0.12 / max(z, 0.1)
            if z > 0.5 and 0 <= v < HEIGHT:
                row = pixels.start[i] + int(v) * WIDTH
                shown[row + int(np.clip(u - half, 0, WIDTH)) : row + int(np.clip(u + half, 0, WIDTH))] = True
    pixels.unmasked = ~shown
    found = find_poles(pixels, LENS)
    assert len(found) == 1 and np.linalg.norm(found.foot[0, :2] - POST[:2]) < 0.05


def test_walls_a_thick_column_and_the_ground_are_no_poles(tmp_path):
    assert len(find_poles(film(tmp_path, (COLUMN,)), LENS)) == 0


def test_a_pole_beyond_the_last_frame_on_the_road_is_not_judged(tmp_path):
    """All frames see it from the same bearing, so its distance is unknown."""
    assert len(find_poles(film(tmp_path, ((8.5, 0.05, 0.05, 2.0),)), LENS)) == 0


def test_supervised_depths_are_those_of_the_front(tmp_path):
    pixels = film(tmp_path, (POST,))
    x, y, radius, height = POST
    poles = Poles(np.array([[x, y, 0.0]]), np.array([radius]), np.array([height]))
    depths = pole_depths(pixels, poles)
    assert len(depths.frame) > 200
    eye = pixels.cameras.positions[depths.frame]
    pose = pixels.cameras.camera_to_world[depths.frame]
    rays = np.einsum("nij,nj->ni", pose[:, :3, :3], unproject(depths.pixel, K))
    points = eye + rays / np.linalg.norm(rays, axis=1, keepdims=True) * depths.distance[:, None]
    away = np.linalg.norm(points[:, :2] - (x, y), axis=1)
    assert np.allclose(away, radius, atol=1e-3) and points[:, 2].max() < height and points[:, 2].min() > 0.05
    gray = pixels.colors[pixels.start[depths.frame] + depths.pixel.astype(int) @ (1, WIDTH)][:, 0]
    assert (gray < 80).mean() > 0.95  # they lie on the pole in the pictures
    hidden = [1, 2, 3]  # frames in which a light wall stands before it
    for i in hidden:
        recolor(pixels, i, lambda colors: colors // 2 + 120)
    assert not np.isin(pole_depths(pixels, poles).frame, hidden).any()
    pixels.cameras = replace(
        pixels.cameras, sources=tuple(str(i) for i in range(12))
    )  # photos: no film tells the usual
    assert not np.isin(pole_depths(pixels, poles).frame, hidden).any()
    for i in range(len(pixels.cameras)):
        recolor(pixels, i, lambda colors: np.full_like(colors, 128))
    assert len(pole_depths(pixels, poles).frame) == 0  # no picture shows it


def test_far_frames_supervise_only_the_part_that_is_above_near_ones(tmp_path):
    x, y, radius, height = post = (15.0, 2.6, 0.09, 4.6)
    pixels = film(tmp_path, (post,))
    depths = pole_depths(pixels, Poles(np.array([[x, y, 0.0]]), np.array([radius]), np.array([height])))
    eye = pixels.cameras.positions[depths.frame]
    rays = np.einsum("nij,nj->ni", pixels.cameras.camera_to_world[depths.frame, :3, :3], unproject(depths.pixel, K))
    z = eye[:, 2] + rays[:, 2] / np.linalg.norm(rays, axis=1) * depths.distance
    far = np.linalg.norm(eye[:, :2] - (x, y), axis=1) > 13.0
    assert far.any() and z[far].min() > 3.05 and z[far].max() < height
    assert (~far).any() and z[~far].min() < 0.5


def test_what_is_no_post_is_not_continued_upward(tmp_path):
    """Single bands have a good quality by chance, here in one of five places."""
    pixels, rng = film(tmp_path, n=24), np.random.default_rng(0)
    for _ in range(40):
        foot = np.array([[rng.uniform(7, 17), rng.uniform(1.5, 7) * rng.choice([-1, 1]), 0.0]])
        poles = Poles(foot, rng.choice([0.028, 0.048, 0.08, 0.1], 1), np.array([3.1]))
        assert poles_module._extended(pixels, np.arange(24), poles).height[0] == 3.1


def test_depths_of_several_poles_are_those_of_their_own_fronts(tmp_path):
    """Also in short films, and with frames that show none of them."""
    pixels = film(tmp_path, (POST, BOLLARD), n=14)
    pixels.cameras.camera_to_world[-1, 0, 3] += 100.0
    pixels.cameras = replace(pixels.cameras, sources=tuple(str(i % 6) for i in range(14)))
    shapes = np.array([POST, BOLLARD])
    feet = np.column_stack([shapes[:, :2], np.zeros(2)])
    depths = pole_depths(pixels, Poles(feet, shapes[:, 2], shapes[:, 3]))
    pose = pixels.cameras.camera_to_world[depths.frame]
    rays = np.einsum("nij,nj->ni", pose[:, :3, :3], unproject(depths.pixel, K))
    points = pose[:, :3, 3] + rays / np.linalg.norm(rays, axis=1, keepdims=True) * depths.distance[:, None]
    away = np.linalg.norm(points[:, None, :2] - shapes[:, :2], axis=-1)
    mine = away.argmin(1)
    assert np.bincount(mine).min() > 100 and 13 not in depths.frame
    assert np.allclose(away.min(1), shapes[mine, 2], atol=1e-3)
    assert (points[:, 2] < shapes[mine, 3]).all()


def test_a_bar_that_one_of_two_films_does_not_show_is_poorer(tmp_path):
    """Its quality is the mean of both films', not that of their pictures together."""
    one = np.full((1, 1, 1), 10.0)
    films = [
        poles_module._Bars(
            "day", one, 10 * contrast * one / 10, np.zeros((1, 1, 1, 3)), np.full((1, 1, 1, 3), 10 * d**2)
        )
        for contrast, d in ((60.0, 10.0), (3.0, 3.0))
    ]
    quality, count = poles_module._quality(films)
    assert count.item() == 20 and quality.item() == pytest.approx((60 / (60 + 15 + 3) + 3 / (3 + 4.5 + 3)) / 2)


def test_joined_depths_are_in_the_order_of_the_frames():
    parts = [
        DepthSupervision(np.array(frames, np.int32), np.full((2, 2), value), np.full(2, value, np.float32))
        for frames, value in (([1, 4], 1.0), ([0, 4], 2.0))
    ]
    joined = join_depths(parts)
    assert joined.frame.tolist() == [0, 1, 4, 4] and joined.distance.tolist() == [2.0, 1.0, 1.0, 2.0]
    assert joined.pixel[:, 0].tolist() == joined.distance.tolist() and joined.of_frame(4) == slice(2, 4)


class FlatGround:
    def at(self, xy):
        return np.full(len(xy), 0.25)


def test_parts_stand_in_the_ground_and_leave_the_corridor_free():
    poles = Poles(
        np.array([[5.0, 2.0, 0.2], [5.0, 0.8, 0.2], [5.0, 1.04, 0.2]]), np.array([0.05, 0.05, 0.05]), np.full(3, 2.0)
    )
    corridor = Corridor((np.column_stack([np.arange(0.0, 10.0, 0.1), np.zeros(100)]),), 1.0)
    (part,) = pole_parts(poles, corridor, FlatGround())
    assert np.isclose(part.vertices[:, 2].min(), 0.1) and np.isclose(part.vertices[:, 2].max(), 2.2)
    assert np.allclose(np.linalg.norm(part.vertices[:, :2] - (5.0, 2.0), axis=1), 0.05)
    assert len(pole_parts(poles, None, FlatGround())) == 3


def test_poles_survive_the_disk_and_older_fields_have_none(tmp_path):
    assert len(Poles.load(tmp_path)) == 0
    poles = Poles(np.array([[5.0, 2.0, 0.2]]), np.array([0.05]), np.array([2.0]))
    poles.save(tmp_path)
    again = Poles.load(tmp_path)
    assert all(np.array_equal(getattr(again, name), value) for name, value in vars(poles).items())
