"""Weather and distractor objects of randomized episodes."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.config import Condition
from twin.env.domain_randomization import (
    EVALUATION_RANGES,
    KNOWN_WEATHER_FRACTION,
    RandomizationSample,
    Ranges,
    condition_options,
)
from twin.env.env_factory import EnvFactory, fingerprint
from twin.env.episode_lighting import LightingSets, sample_lighting
from twin.env.picture_effects import CastShadows, DirectionalRelighting, FogSample, Weather, _solid_shadows
from twin.env.task import WEATHER, DriveTask
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.nerf.lightings import AddedLighting, Fog
from twin.scene import SceneDir, stage_result
from twin.view.camera_path import named_lighting

SMALL = {"size": (32, 18)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


def test_fog_increases_with_distance():
    distance = np.array([[1500.0, 1500.0], [30.0, 3.0]], np.float32)
    rgb = np.array([[[0.8] * 3, [0.6] * 3], [[0.1] * 3, [0.1] * 3]], np.float32)
    np.testing.assert_array_equal(FogSample(0.0).apply(rgb, distance), rgb)
    hazy = FogSample(0.05).apply(rgb, distance)
    np.testing.assert_allclose(hazy[0], 0.7, atol=1e-3)  # the horizon, whose mean is the airlight
    for column, metres in ((0, 30.0), (1, 3.0)):
        kept = np.exp(-0.05 * metres)
        np.testing.assert_allclose(hazy[1, column], kept * 0.1 + (1 - kept) * 0.7, rtol=1e-5)
    np.testing.assert_allclose(FogSample(0.05, 0.5).apply(rgb, distance)[0], 0.35, atol=4e-3)
    air = FogSample(0.05)
    air.apply(rgb, distance)
    np.testing.assert_allclose(air.apply(0.0 * rgb, distance)[0], 0.7, atol=6e-3)  # that of the first picture
    near = np.ones_like(distance)
    np.testing.assert_allclose(FogSample(1e3).apply(rgb, near)[1], rgb[:1].mean(), rtol=1e-5)  # nothing is far


def _pose(x: float, turned: float) -> np.ndarray:
    """camera_to_world of a camera 2 m above z = 0 that looks straight down, turned about the vertical [rad]."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turned), np.sin(turned), 0], [np.sin(turned), -np.cos(turned), 0], [0, 0, -1]]
    pose[:3, 3] = x, 0.0, 2.0
    return pose


def test_cast_shadows_are_fixed_in_the_world():
    rays = unproject(pixel_grid(32, 32), np.array([20.0, 20.0, 16.0, 16.0]))
    rgb, depth = np.ones((32, 32, 3), np.float32), np.full((32, 32), 2.0, np.float32)
    covers = []
    for seed in range(30):
        weather = Weather(RandomizationSample(shade=0.5), np.random.default_rng(seed))
        light = weather.apply(rgb, depth, rays, _pose(0.0, 0.0))
        assert light.min() >= 0.5 and light.max() <= 1.0
        moved = weather.apply(rgb, depth, rays, _pose(0.5, 0.0))  # five pixels further
        np.testing.assert_allclose(moved[:, :-5], light[:, 5:], atol=1e-4)
        turned = weather.apply(rgb, depth, rays, _pose(0.0, np.pi / 2))
        np.testing.assert_allclose(np.rot90(turned), light, atol=1e-4)
        covers.append(float((light[..., 0] < 0.75).mean()))
        np.testing.assert_array_equal(weather.apply(rgb, 500.0 * depth, rays, np.eye(4)), rgb)  # the sky
    assert 0.1 < np.mean(covers) < 0.6 and np.std(covers) > 0.1


def test_randomized_episodes_have_weather_and_distractors(scene):
    still = dict.fromkeys(("friction", "wheel_radius", "airlight"), (1.0, 1.0))
    robot = ("payload", "latency", "wheel_difference", "camera_shift", "camera_turn")
    still |= dict.fromkeys((*robot, "sunlight", "shade", "bystanders"), (0.0, 0.0))

    def first(seed: int = 3, **ranges) -> tuple[np.ndarray, DriveTask]:
        environment = twin.load(scene, "ahead", seed, lighting="day", **SMALL, randomise=Ranges(**(still | ranges)))
        step = environment.reset()
        return step.observation["pixels"][-1].astype(float), environment.task

    clear, task = first(extinction=(0.0, 0.0))
    plain = twin.load(scene, "ahead", 3, lighting="day", **SMALL).reset().observation["pixels"][-1]
    np.testing.assert_array_equal(clear, plain)
    assert task.obstacles == ()
    hazy, task = first(extinction=(0.2, 0.2))
    assert hazy.std() < 0.9 * clear.std() and task.sample.record()["extinction"] == pytest.approx(0.2)
    wide = twin.load(scene, "ahead", 0, pixels=False, half_width=3.0, randomise=Ranges(bystanders=(4, 4)))
    wide.reset()
    assert len(wide.task.obstacles) == 4 and all(abs(one.lateral) > 3.6 for one in wide.task.obstacles)
    assert not np.array_equal(first(extinction=(0.0, 0.0), sunlight=(0.7, 0.7))[0], clear)
    shaded, _ = first(extinction=(0.0, 0.0), shade=(0.6, 0.6))
    assert (shaded <= clear).all() and (shaded < clear).any()
    differ = []
    for seed in range(4):  # not all of them are in view of the first picture
        crowded, task = first(seed, extinction=(0.0, 0.0), bystanders=(4, 4))
        assert len(task.obstacles) == 4 and all(one.name.startswith("beside_") and one.color for one in task.obstacles)
        differ.append(not np.array_equal(crowded, first(seed, extinction=(0.0, 0.0))[0]))
    assert any(differ)
    rng = np.random.default_rng(0)
    assert {Ranges(bystanders=(0, 3)).sample(rng).bystanders for _ in range(60)} == {0, 1, 2, 3}


FOG = Fog(0.1, (0.9, 0.8, 0.7))


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A built scene with two added lightings that have the embedding of the first filmed one: one clear, one in fog."""
    runtime.set_quiet(True)
    scene = SceneDir(tiny_twin(tmp_path_factory.mktemp("photos")))
    day = [float(x) for x in twin.load_scene(scene.root).field().embedding("day")]
    for name, air in (("clear", Fog()), ("foggy", FOG)):
        AddedLighting(name, day, air, stage_result(scene, "field"), "photo.png", {}).save(scene)
    return twin.load_scene(scene.root)


def test_fog_of_a_photo_is_applied(photos):
    built = photos

    def first(lighting: str, **options):
        environment = twin.load(built, "ahead", 3, lighting=lighting, **SMALL, **options)
        return environment.reset().observation["pixels"][-1].astype(float), environment

    plain, environment = first("day")
    np.testing.assert_array_equal(first("clear")[0], plain)
    view = Viewpoints.of(
        environment.physics.camera_to_world[None], environment.pixels._renderer.intrinsics, SMALL["size"]
    )
    seen = built.field().render(view, "day")
    rays = unproject(pixel_grid(*SMALL["size"]), environment.pixels._renderer.intrinsics)
    kept = np.exp(-0.1 * np.minimum(seen.depth[0] * np.linalg.norm(rays, axis=-1), 100.0))[..., None]
    expected = kept * np.clip(seen.rgb[0], 0.0, 1.0) + (1.0 - kept) * [0.9, 0.8, 0.7]
    np.testing.assert_allclose(first("foggy")[0], 255.0 * expected, atol=2.0)
    half = first("day:foggy:0.5")[0]
    assert np.abs(half - plain).mean() < np.abs(first("foggy")[0] - plain).mean()
    bare = [
        EnvFactory.open(built, "ahead", {"lighting": name, **SMALL})._field_only for name in ("day", "clear", "foggy")
    ]
    assert bare == [True, True, False]  # pictures that stay on a device have no fog
    assert not EnvFactory.open(built, "ahead", {"lighting": ("day", "foggy"), **SMALL})._field_only


def test_fog_is_applied_after_relighting_and_shadows(photos):
    strong = {"sunlight": (0.7, 0.7), "shade": (0.75, 0.75), "extinction": (0.3, 0.3), "bystanders": (0, 0)}
    still = dict.fromkeys(("friction", "wheel_radius", "airlight"), (1.0, 1.0))
    still |= dict.fromkeys(("payload", "latency", "wheel_difference", "camera_shift", "camera_turn"), (0.0, 0.0))
    ranges = Ranges(**(still | strong), hold_known=True)
    environment = twin.load(photos, "ahead", 3, lighting="foggy", **SMALL, randomise=ranges)
    shown = environment.reset().observation["pixels"][-1].astype(float)
    intrinsics, task = environment.pixels._renderer.intrinsics, environment.task
    pose, rays = environment.physics.camera_to_world, unproject(pixel_grid(*SMALL["size"]), intrinsics)
    seen = photos.field().render(Viewpoints.of(pose[None], intrinsics, SMALL["size"]), "day")
    left = RandomizationSample(sunlight=0.7 * KNOWN_WEATHER_FRACTION, shade=0.75 * KNOWN_WEATHER_FRACTION)
    lit = Weather(left, task.rng(WEATHER)).apply(seen.rgb[0], seen.depth[0], rays, pose)
    distance = seen.depth[0] * np.linalg.norm(rays, axis=-1)
    expected = FOG.apply(lit, distance.astype(np.float32))
    np.testing.assert_allclose(shown, 255.0 * np.clip(expected, 0.0, 1.0), atol=1.0)
    assert np.abs(255.0 * expected - 255.0 * FOG.apply(seen.rgb[0], distance)).max() > 10.0  # the fog is visible


def test_fog_drifts_with_the_lighting(photos):
    sets = LightingSets(photos.field())

    def light(wanted, seed: int = 0):
        return sample_lighting(wanted, True, 10.0, sets, np.random.default_rng(seed))

    ends = {light("foggy", seed).name for seed in range(20)}
    assert ends == {"foggy → day", "foggy → night"}  # both are filmed lightings
    away = light("foggy")
    for time, share in ((0.0, 1.0), (2.5, 0.75), (5.0, 0.5), (10.0, 0.0), (99.0, 0.0)):
        air = away.fog_at(time)
        assert air.extinction == pytest.approx(share * FOG.extinction)
        assert not share or air.airlight == pytest.approx(FOG.airlight)
    extinctions = {
        air if air is None else round(air.extinction, 6)
        for air in (light(("day", "foggy"), seed).fog_at(99.0) for seed in range(20))
    }
    assert extinctions == {None, 0.0, FOG.extinction}
    environment = twin.load(photos, "ahead", 3, lighting="foggy", **SMALL, lighting_drift=True)
    environment.reset()
    environment.pixels.lightings[0] = replace(environment.pixels.lightings[0], duration=0.1)
    cleared = environment.step(np.zeros(2)).observation["pixels"][-1].astype(float)
    environment.pixels.lightings[0] = replace(environment.pixels.lightings[0], end_fog=FOG)
    assert np.abs(environment.step(np.zeros(2)).observation["pixels"][-1] - cleared).mean() > 5.0


@pytest.mark.parametrize("lighting", ["foggy", "clear"])
def test_known_weather_weakens_the_randomization(photos, lighting):
    def draw(lighting: str, ranges: Ranges) -> RandomizationSample:
        environment = twin.load(photos, "ahead", 5, lighting=lighting, **SMALL, randomise=ranges)
        environment.reset()
        told = environment.task.sample
        assert environment.task.info(environment.physics)["randomisation"] == told.record()
        return told

    unknown, known = draw("day", EVALUATION_RANGES), draw(lighting, EVALUATION_RANGES)
    assert unknown.extinction > 0.0
    weaker = {"sunlight": KNOWN_WEATHER_FRACTION * unknown.sunlight, "shade": KNOWN_WEATHER_FRACTION * unknown.shade}
    assert known == replace(unknown, extinction=0.0, airlight=1.0, **weaker)
    assert draw(lighting, replace(EVALUATION_RANGES, hold_known=False)) == unknown  # as in training
    environment = twin.load(photos, "ahead", 5, lighting=lighting, **SMALL, randomise=EVALUATION_RANGES)
    environment.reset()
    for shown, expected in ((lighting, known), ("day", unknown), (lighting, known)):
        environment.pixels.set_lighting(0, named_lighting(photos.field(), shown), fill=False)
        assert environment.task.sample == expected


def test_fingerprint_covers_the_known_weather_fraction(photos, monkeypatch):
    names = ("foggy", "foggy+randomised", "day+randomised")
    before = [fingerprint(photos, "ahead", Condition.parse(name)) for name in names]
    monkeypatch.setattr("twin.env.env_factory.KNOWN_WEATHER_FRACTION", 0.5)
    after = [fingerprint(photos, "ahead", Condition.parse(name)) for name in names]
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True]


def test_solid_shadows_have_straight_edges_and_no_seam():
    patterns = np.stack([_solid_shadows(np.random.default_rng(seed)) for seed in range(40)])
    assert patterns.min() == 0.0 and patterns.max() == 1.0
    covers = patterns.mean((1, 2))
    assert covers.min() > 0.02 and covers.max() < 0.9 and covers.std() > 0.05
    assert ((patterns > 0.0) & (patterns < 1.0)).mean() < 0.05  # sharp
    for axis in (1, 2):
        steps = np.abs(np.diff(patterns, axis=axis)).mean()
        seam = np.abs(np.take(patterns, 0, axis) - np.take(patterns, -1, axis)).mean()
        assert 0.3 * steps < seam < 3.0 * steps
    # Shadows of posts lie along the sun's direction, which is that of the pattern's rows.
    along, across = (np.abs(np.diff(patterns, axis=axis)).mean() for axis in (2, 1))
    assert across > 1.1 * along


RAYS = unproject(pixel_grid(96, 54), np.array([50.0, 50.0, 48.0, 27.0]))
LOW = np.deg2rad(15.0)
LEFT = np.array([0.0, np.cos(LOW), np.sin(LOW)])
"""A sun to the left of a camera that looks along x: the right side of a street faces it."""


def street(ground: float) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Depth, points and masks of the surfaces that a camera sees at the end of a street along x, looking along x.

    `ground` is the height of the camera above the ground [m]; walls end 6 m above the camera.
    """
    left, up = -RAYS[..., 0], -RAYS[..., 1]
    with np.errstate(divide="ignore"):
        floor, sides = np.where(up < 0.0, -ground / up, np.inf), 4.0 / np.abs(left)
    sides = np.where(sides * up < 6.0, sides, np.inf)
    depth = np.minimum(np.minimum(floor, sides), 1e3)
    points = np.stack([RAYS[..., 2], left, up], -1) * np.minimum(depth, 40.0)[..., None]
    near, wall = depth < 25.0, sides < 0.9 * floor
    masks = {"ground": near & (floor < 0.9 * sides), "sky": depth > 999.0}
    masks |= {"left": near & wall & (left > 0), "right": near & wall & (left < 0)}
    masks |= {name: masks[name] & (points[..., 2] > 0.2) for name in ("left", "right")}
    return depth.astype(np.float32), points.astype(np.float32), masks


def test_evaluation_weather_is_never_mild():
    """A real road never has the film's sun: every sample of an evaluation has another sun, and shadows that were not
    filmed. Samples of training may have neither.
    """
    ranges, rng = condition_options(Condition("day", True))["randomise"], np.random.default_rng(0)
    tried, trained = ([one.sample(rng) for _ in range(300)] for one in (ranges, Ranges()))
    for strength in ("sunlight", "shade"):
        least, first = (min(getattr(one, strength) for one in many) for many in (tried, trained))
        assert first < 0.02 and least > 0.3
    depth, points, masks = street(1.0)
    rgb = np.full((*depth.shape, 3), 0.5, np.float32)
    mildest = min(tried, key=lambda one: one.sunlight)
    lit = DirectionalRelighting(mildest.sunlight, LEFT, rng).apply(rgb, depth, points)[..., 1]
    assert np.median(lit[masks["right"]]) > 1.4 * np.median(lit[masks["left"]])


def test_a_shadow_lies_on_the_side_away_from_the_sun():
    """A dark point above the ground darkens the ground where the sun's ray through the point ends, and nowhere else."""
    rng, differ = np.random.default_rng(0), []
    one = np.ones((200, 200, 3), np.float32)
    for turned in rng.uniform(0.0, 2.0 * np.pi, 8):
        sun = np.array([np.cos(LOW) * np.cos(turned), np.cos(LOW) * np.sin(turned), np.sin(LOW)])
        shadows = CastShadows(0.7, sun, rng)
        above = np.append(rng.uniform(-10.0, 10.0, (200, 200, 2)), rng.uniform(0.5, 3.0, (200, 200, 1)), -1)
        ray = above[..., 2:] / sun[2] * sun  # from the ground to the point
        light, away, towards = (
            shadows.apply(one, one[..., 0], points)[..., 1]
            for points in (above, above - ray, above + ray * [1.0, 1.0, -1.0])
        )
        np.testing.assert_allclose(away, light, atol=1e-3)
        differ.append(np.abs(towards - light).mean())
    assert np.mean(differ) > 0.05


@pytest.mark.parametrize("ground", [1.0, 0.15])  # the latter is high enough to be lit
def test_relighting_brightens_surfaces_that_face_the_sun(ground):
    depth, points, masks = street(ground)
    rgb = np.full((*depth.shape, 3), 0.5, np.float32)
    lit = DirectionalRelighting(0.7, LEFT, np.random.default_rng(0)).apply(rgb, depth, points)
    light = {name: np.median(lit[mask][:, 1]) / 0.5 for name, mask in masks.items()}
    assert light["ground"] == pytest.approx(1.0, abs=0.01)
    assert light["right"] == pytest.approx(np.exp(0.7 * (np.cos(LOW) - np.sin(LOW))), rel=0.01)
    assert light["left"] == pytest.approx(np.exp(0.7 * (-np.cos(LOW) - np.sin(LOW))), rel=0.01)
    warm = np.median(lit[masks["right"]], 0)
    assert warm[0] > warm[1] > warm[2]
    towards, away = (lit[masks["sky"] & side][:, 1].mean() for side in (RAYS[..., 0] < 0.0, RAYS[..., 0] > 0.0))
    assert towards > 1.05 * away
    np.testing.assert_array_equal(
        DirectionalRelighting(0.0, LEFT, np.random.default_rng(0)).apply(rgb, depth, points), rgb
    )


def test_relighting_blends_near_and_far():
    ahead = np.tile(np.linspace(20.0, 45.0, 251, dtype=np.float32), (3, 1))
    points = np.stack([np.minimum(ahead, 40.0), 0.0 * ahead, 0.0 * ahead - 1.0], -1)  # the ground, 1 m below
    rgb = np.full((*ahead.shape, 3), 0.5, np.float32)
    lit = np.log(DirectionalRelighting(0.7, LEFT, np.random.default_rng(3)).apply(rgb, ahead, points)[0, :, 1] / 0.5)
    assert abs(lit[0]) < 1e-3 and np.ptp(lit[-40:]) < 1e-3 and abs(lit[-1]) > 0.05
    steps = np.diff(lit)
    assert np.abs(steps).max() < 0.02 * abs(lit[-1]) and (np.sign(lit[-1]) * steps > -1e-3).all()


def test_relighting_keeps_low_surfaces_and_varies_the_sky():
    depth, points, masks = street(1.0)
    rgb = np.full((*depth.shape, 3), 0.5, np.float32)
    lit = DirectionalRelighting(0.7, LEFT, np.random.default_rng(0)).apply(rgb, depth, points)[..., 1] / 0.5
    high, right = points[..., 2], points[..., 1] < -3.9
    middle = np.median(lit[right & (abs(high + 0.2) < 0.05) & (depth < 15.0)])
    assert np.log(middle) == pytest.approx(0.5 * 0.7 * (np.cos(LOW) - np.sin(LOW)), rel=0.15)
    assert np.median(lit[right & (high < -0.5) & (high > -0.9) & (depth < 15.0)]) == pytest.approx(1.0, abs=0.01)
    skies = [
        np.median(DirectionalRelighting(0.7, LEFT, np.random.default_rng(k)).apply(rgb, depth, points)[masks["sky"]])
        for k in range(20)
    ]
    assert np.std(np.log(skies)) > 0.2


def test_sun_is_fixed_in_the_world_and_casts_the_shadows():
    """A wall's brightness does not depend on the view, and shadows follow the same sun's rays."""
    rgb = np.full((54, 96, 3), 0.5, np.float32)
    up = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera axes to x ahead, y left, z up
    ratios = []
    for seed in range(12):
        weather = Weather(RandomizationSample(sunlight=0.7), np.random.default_rng(seed))
        seen = []
        for turned in (-0.15, 0.15):
            pose = np.eye(4)
            c, s = np.cos(turned), np.sin(turned)
            pose[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ up
            pose[:3, 3] = -100.0, -50.0, 0.5
            ahead = (RAYS @ pose[:3, :3].T)[..., 0]
            depth = (10.0 / ahead).astype(np.float32)  # a wall across x, 10 m ahead
            lit = weather.apply(rgb, depth, RAYS, pose)
            seen.append(np.median(lit[:20, 20:-20, 1]) / 0.5)
        sun = weather._relighting._sun
        assert seen == pytest.approx([np.exp(0.7 * (-sun[0] - sun[2]))] * 2, rel=0.01)  # the wall faces the camera
        ratios.append(seen[0])
    assert max(ratios) > 1.3 and min(ratios) < 0.6
    sides = weather._relighting
    both = Weather(RandomizationSample(sunlight=0.7, shade=0.5), np.random.default_rng(11))
    np.testing.assert_allclose(both._relighting._sun, sides._sun)
    np.testing.assert_allclose(both._shadows._slant, sides._sun[:2] / sides._sun[2], rtol=1e-5)
