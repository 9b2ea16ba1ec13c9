"""Sun of an added lighting: shadow map, gain, fit to a photo, position from time and place, and pictures in it."""

import base64
import json
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from textured import filmed_corridor
from tiny_twin import tiny_twin
from tiny_world import BOX_FACES, box

import twin
from twin import runtime
from twin.assets.ground import Ground
from twin.assets.views import Views
from twin.capture.capture_data import Capture
from twin.env.domain_randomization import RandomizationSample, Ranges
from twin.env.env_factory import EnvFactory
from twin.env.irradiance import IrradianceEstimator
from twin.env.picture_effects import Weather
from twin.errors import InputError
from twin.files import load_arrays
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.geometry.mesh_rays import Surface
from twin.geometry.poses import look_at
from twin.geometry.shadow_map import OrthographicShadowMap, ShadowCasters, angles, direction
from twin.nerf.lightings import AddedLighting, Fog
from twin.nerf.sun import (
    TERMS,
    SeenSurfaces,
    Sun,
    heading_from_gps,
    main_sun,
    mixed_sunlight,
    parse_time,
    relit,
    sun_angles,
    sun_direction,
)
from twin.nerf.sun_fit import SunProblem, fit_direction, search_directions
from twin.pack import pack
from twin.relight import find_sun, rough_triangles, shadow_casters
from twin.scene import SceneDir, stage_result, write_stamp
from twin.view.camera_path import mixed_lighting, named_lighting
from twin.view.scene_picture import FreeCamera, ScenePicture

SIZE, K = (96, 54), np.array([60.0, 60.0, 48.0, 27.0])
RAYS = unproject(pixel_grid(*SIZE), K)
BOXES = (((4.0, 2.0, 1.5), (1.0, 1.0, 3.0)), ((7.0, -1.5, 1.0), (1.5, 0.6, 2.0)), ((10.0, 3.0, 2.0), (2.0, 2.0, 4.0)))
POSE = look_at(np.array([-2.0, 0.5, 1.6]), np.array([6.0, 0.3, 0.4]))


def _mesh(ground: bool = False):
    vertices = [box(*one) for one in BOXES]
    if ground:
        vertices.append(box((5.0, 0.0, -0.5), (60.0, 60.0, 1.0)))
    faces = np.concatenate([BOX_FACES + 8 * k for k in range(len(vertices))])
    return np.concatenate(vertices), faces


def _depth(pose: np.ndarray) -> np.ndarray:
    """z-depth of ground and boxes from a pose; 200 m in the sky."""
    rays = (RAYS @ pose[:3, :3].T).reshape(-1, 3)
    hit = Surface(*_mesh(ground=True)).cast(np.tile(pose[:3, 3], (len(rays), 1)), rays)
    return np.where(hit > 0.0, hit, 200.0).reshape(SIZE[::-1]).astype(np.float32)


@pytest.mark.parametrize(("azimuth", "elevation"), [(30.0, 40.0), (200.0, 15.0), (0.0, 90.0)])
def test_shadow_map_equals_ray_casting(azimuth, elevation):
    toward = direction(azimuth, elevation)
    assert angles(toward)[1] == pytest.approx(elevation)
    vertices, faces = _mesh()
    shadows = ShadowCasters(vertices, faces).seen_from(toward, texel=0.05)
    rng = np.random.default_rng(0)
    points = rng.uniform([2.0, -6.0, 0.0], [13.0, 8.0, 2.5], (4000, 3))
    surface = Surface(vertices, faces)
    points = points[surface.distance(points) > 0.6]  # the bias lights what is just behind a surface
    # Edges are soft: only points are compared whose neighbors are lit alike.
    around = points[:, None] + 0.15 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    rays = np.broadcast_to(toward, (around.size // 3, 3))
    lit = (surface.cast(around.reshape(-1, 3), rays) < 0.0).reshape(around.shape[:2])
    same = (lit == lit[:, :1]).all(1)
    assert same.mean() > 0.8 and 0.002 < (~lit[same, 0]).mean() < 0.9
    np.testing.assert_allclose(shadows.visibility(points[same]), lit[same, 0], atol=1e-5)


@pytest.mark.parametrize("elevation", [6.0, 40.0])
def test_slopes_throw_no_shadows_on_themselves(elevation):
    vertices = np.array([[-20, -20, -2], [20, -20, 2], [20, 20, 2], [-20, 20, -2]], float)  # rises by a tenth along x
    shadows = ShadowCasters(vertices, np.array([[0, 1, 2], [0, 2, 3]])).seen_from(direction(200.0, elevation))
    x, y = np.random.default_rng(0).uniform(-15.0, 15.0, (2, 500))
    points, normals = np.column_stack([x, y, 0.1 * x]), np.tile([-0.1, 0.0, 1.0] / np.sqrt(1.01), (500, 1))
    np.testing.assert_allclose(shadows.visibility(points, normals), 1.0, atol=1e-5)


def test_rough_triangles_are_surfaces_above_the_mesh():
    """A wall 10 m away, half of which stands in front of another at 20 m; the mesh ends 3 m above the ground."""
    flat = Ground(
        np.zeros((80, 80)), np.array([-20.0, -20.0]), 0.5, np.ones((80, 80), bool), np.zeros((80, 80, 3), np.uint8)
    )
    pose = look_at(np.array([0.0, 0.0, 1.5]), np.array([1.0, 0.0, 1.5]))
    depth = np.where(np.arange(SIZE[0]) < 48, 10.0, 20.0) * np.ones((1, SIZE[1], 1))
    one = np.ones(depth.shape, np.float32)
    views = Views(pose[None], K[None], np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32), one, one)
    mesh = np.array([[-15.0, -15.0, 0.0], [15.0, 15.0, 3.0]])
    vertices, faces = rough_triangles(views, flat, mesh)
    corners = vertices[faces]
    near, far = (np.abs(corners[..., 0] - x).max(1) < 1e-3 for x in (10.0, 20.0))
    assert near.any() and far.any() and (near | far).all()  # nothing spans the gap
    assert corners[near].mean(1)[:, 2].min() > 2.5 and corners[far].mean(1)[:, 2].min() > 1.0


def test_memory_of_a_shadow_map_is_bounded(monkeypatch):
    """A map computed in batches equals the map computed at once."""
    casters, toward = ShadowCasters(*_mesh(), *_mesh()), direction(30.0, 40.0)
    tracemalloc.start()
    try:
        made = casters.seen_from(toward, texel=0.01)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert made.height.size > 400_000 and peak < 20 << 20
    monkeypatch.setattr("twin.geometry.shadow_map._BATCH", 1 << 30)
    np.testing.assert_array_equal(casters.seen_from(toward, texel=0.01).height, made.height)


def test_surfaces_far_from_each_other_are_seen():
    """Two plates 3 km apart under a low sun, and rays over 5 km."""
    plate = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [50.0, 50.0, 0.0], [0.0, 50.0, 0.0]])
    vertices, faces = np.concatenate([plate, plate + np.array([3000.0, 0.0, 0.0])]), np.array([[0, 1, 2], [0, 2, 3]])
    shadows = ShadowCasters(vertices, np.concatenate([faces, faces + 4])).seen_from(direction(0.0, 20.0), texel=1.0)
    for x in (25.0, 3025.0):
        points = np.array([[x, 25.0, -2.0], [x, 25.0, 0.0]])
        np.testing.assert_allclose(shadows.visibility(points, np.eye(3)[[2, 2]]), [0.0, 1.0], atol=1e-3)
    surface = Surface(plate, faces)
    above = np.array([[20.0, 20.0, 5000.0]])
    assert surface.cast(above, np.array([[0.0, 0.0, -2.0]])) == pytest.approx(2500.0)
    assert surface.distance(above) == pytest.approx(5000.0)


def test_shadow_map_survives_its_file():
    shadows = ShadowCasters(*_mesh()).seen_from(direction(30.0, 40.0))
    back = OrthographicShadowMap.from_json(json.loads(json.dumps(shadows.to_json())))
    points = np.random.default_rng(0).uniform(0.0, 10.0, (500, 3))
    np.testing.assert_allclose(back.visibility(points), shadows.visibility(points), atol=1e-3)
    nothing = ShadowCasters(np.zeros((0, 3)), np.zeros((0, 3), int)).seen_from(direction(0.0, 10.0))
    assert (nothing.visibility(points) == 1.0).all()
    assert (OrthographicShadowMap.from_json(nothing.to_json()).visibility(points) == 1.0).all()


# The header of a PNG of 100,000 x 100,000 pixels, and no pixel.
HUGE = base64.b64encode(
    b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBBI", 13, b"IHDR", 100_000, 100_000, 16, 0, 0, 0, 0, 0xFEC2B29A)
).decode()


@pytest.mark.parametrize(
    "change",
    [
        *({"toward": [0.0, 0.0, 2.0]}, {"toward": [1.0, 0.0, 0.0]}, {"texel_m": 0.0}),
        *({"png": "AAAA"}, {"png": ""}, {"png": "?"}, {"png": HUGE}),
    ],
)
def test_damaged_shadow_maps_are_refused(change):
    table = ShadowCasters(*_mesh()).seen_from(direction(30.0, 40.0)).to_json()
    with pytest.raises(ValueError):
        OrthographicShadowMap.from_json(table | change)


def _sun(toward: np.ndarray) -> Sun:
    rows = [[0.5, 0.55, 0.7], [1.3, 1.2, 0.9], [0.9, 1.0, 1.2], [0.4, 0.3, 0.1], [0.0, 0.1, 0.3], [1.0, 0.8, 0.5]]
    return Sun(ShadowCasters(*_mesh()).seen_from(toward), np.array(rows, np.float32))


def test_gain_is_that_of_its_definition():
    toward = direction(120.0, 35.0)
    sun, depth = _sun(toward), _depth(POSE)
    gray = np.full((*depth.shape, 3), 0.25, np.float32)
    out = relit(gray, depth, RAYS, POSE, ((sun, 1.0),)) / gray
    points = (RAYS * np.minimum(depth, 60.0)[..., None]) @ POSE[:3, :3].T + POSE[:3, 3]
    surface = Surface(*_mesh())
    level = (np.abs(points[..., 2]) < 1e-3) & (depth < 12.0)
    rows = np.argwhere(
        level & np.roll(level, 3, 1) & np.roll(level, -3, 1) & np.roll(level, 3, 0) & np.roll(level, -3, 0)
    )
    some = points[tuple(rows.T)]
    around = some[:, None] + 0.4 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    rays = np.broadcast_to(toward, (around.size // 3, 3))
    lit = (surface.cast(around.reshape(-1, 3) + np.array([0.0, 0.0, 1e-3]), rays) < 0.0).reshape(around.shape[:2])
    sure = (lit == lit[:, :1]).all(1)
    expected = sun.coefficients[0] + sun.coefficients[5] * (lit[sure, :1] * toward[2])
    assert lit[sure, 0].any() and not lit[sure, 0].all()
    np.testing.assert_allclose(out[tuple(rows[sure].T)], expected, atol=0.02)
    sky = depth > 100.0
    rays = (RAYS @ POSE[:3, :3].T)[sky]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    glow, up = (0.5 + 0.5 * rays @ toward)[:, None] ** 4, np.maximum(rays[:, 2:], 0.0)
    expected = sun.coefficients[2] + glow * sun.coefficients[3] + up * sun.coefficients[4]
    np.testing.assert_allclose(out[sky], expected, rtol=1e-4)


def test_mixtures_of_suns_are_those_of_their_gains():
    one, other = _sun(direction(120.0, 35.0)), _sun(direction(10.0, 20.0))
    depth = _depth(POSE)
    rgb = np.random.default_rng(0).uniform(0.1, 0.3, (*depth.shape, 3)).astype(np.float32)

    def shown(sunlight):
        return relit(rgb, depth, RAYS, POSE, sunlight)

    assert shown(()) is rgb
    a, b = ((one, 1.0),), ((other, 1.0),)
    np.testing.assert_allclose(shown(mixed_sunlight(a, b, 0.25)), 0.75 * shown(a) + 0.25 * shown(b), atol=1e-5)
    np.testing.assert_allclose(shown(mixed_sunlight(a, (), 0.25)), 0.75 * shown(a) + 0.25 * rgb, atol=1e-5)
    assert mixed_sunlight(a, a, 0.3) == ((one, pytest.approx(1.0)),) and mixed_sunlight(a, b, 1.0) == b
    assert main_sun(mixed_sunlight(a, b, 0.25)) is one and main_sun(()) is None and main_sun(((one, 0.4),)) is None


def _problem(sun: Sun, fog: Fog) -> SunProblem:
    """A photo made by the model: random albedo on ground and boxes under a sun, in fog and noise."""
    rng, depth = np.random.default_rng(1), _depth(POSE)
    base = rng.uniform(0.15, 0.35, (*depth.shape, 3)).astype(np.float32)
    distance = depth * np.linalg.norm(RAYS, axis=-1).astype(np.float32)
    photo = fog.apply(relit(base, depth, RAYS, POSE, ((sun, 1.0),)), distance)
    photo = (photo + rng.normal(0.0, 0.01, photo.shape)).astype(np.float32)
    bases = np.stack([np.full_like(base, 0.25), base]).reshape(2, -1, 3)
    return SunProblem(photo.reshape(-1, 3), SeenSurfaces.of(depth, RAYS, POSE), distance.ravel(), bases)


@pytest.mark.parametrize("fog", [Fog(), Fog(0.01, (0.6, 0.6, 0.7))])
def test_a_photo_made_by_the_model_is_recovered(fog):
    toward = direction(120.0, 35.0)
    sun = _sun(toward)
    problem = _problem(sun, fog)
    plain, exact = fit_direction(problem, sun.shadows, fog)
    assert exact.error < 2e-4 < plain.error
    np.testing.assert_allclose(exact.coefficients[[0, 1, 5]], sun.coefficients[[0, 1, 5]], atol=0.1)
    found = search_directions(problem, ShadowCasters(*_mesh()), fog)[1]
    assert np.rad2deg(np.arccos(found.toward @ toward)) < 6.0
    assert found.error < 2.0 * exact.error


def test_sun_survives_its_file_and_damaged_ones_are_refused():
    sun = _sun(direction(120.0, 35.0))
    table = json.loads(json.dumps(sun.to_json()))
    back = Sun.from_json(table)
    np.testing.assert_allclose(back.coefficients, sun.coefficients, atol=1e-6)
    assert tuple(table["coefficients"]) == TERMS
    table["coefficients"]["direct"] = [1.0, 2.0]
    with pytest.raises(ValueError):
        Sun.from_json(table)


@pytest.mark.parametrize(
    ("time", "place", "compass", "elevation"),
    [
        # The example of Reda and Andreas, Solar position algorithm for solar radiation applications, NREL 2008.
        ("2003-10-17T12:30:30-07:00", (39.742476, -105.1786), 194.34, 39.89),
        # Equinox at the equator: at noon the sun stands overhead; an hour before six it has not risen.
        ("2026-03-20T12:07:30+00:00", (0.0, 0.0), None, 89.8),
    ],
)
def test_sun_stands_where_published_values_say(time, place, compass, elevation):
    found = sun_angles(parse_time(time), *place)
    assert found[1] == pytest.approx(elevation, abs=0.3 if compass is None else 0.05)
    assert compass is None or found[0] == pytest.approx(compass, abs=0.05)


def test_azimuth_in_the_scene_follows_from_its_heading():
    moment = parse_time("2003-10-17T12:30:30-07:00")
    for heading, expected in ((90.0, -104.34), (0.0, 165.66), (194.34, 0.0)):  # x axis to the east, north, the sun
        azimuth, elevation = angles(sun_direction(moment, 39.742476, -105.1786, heading))
        assert (azimuth - expected + 180.0) % 360.0 == pytest.approx(180.0, abs=0.1)
        assert elevation == pytest.approx(39.89, abs=0.05)


def test_heading_is_found_from_positions():
    rng = np.random.default_rng(0)
    xy = np.cumsum(rng.normal([1.0, 0.2], 0.5, (40, 2)), 0)
    for heading in (90.0, 0.0, 215.0):
        angle = np.deg2rad(90.0 - heading)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        noisy = xy @ turn.T + [300.0, -40.0] + rng.normal(0.0, 0.3, xy.shape)
        noisy[3] = np.nan
        assert (heading_from_gps(xy, noisy) - heading + 180.0) % 360.0 == pytest.approx(180.0, abs=2.0)
    assert heading_from_gps(xy, 3.0 * xy) is None and heading_from_gps(xy, np.full(xy.shape, np.nan)) is None
    assert heading_from_gps(xy, rng.normal(0.0, 5.0, xy.shape)) is None and heading_from_gps(0 * xy, xy) is None


@pytest.mark.parametrize("text", ["noon", "2026-06-01T17:30", "1850-06-01T17:30+02:00"])
def test_unusable_times_are_refused(text):
    with pytest.raises(InputError, match="--time"):
        parse_time(text)


def test_below_the_horizon_there_is_no_sun():
    with pytest.raises(InputError, match=r"below the horizon.*leave --time out"):
        sun_direction(parse_time("2026-06-01T01:00+02:00"), 48.14, 11.58, 0.0)
    with pytest.raises(InputError, match="--location"):
        sun_direction(parse_time("2026-06-01T01:00+02:00"), 99.0, 11.58, 0.0)


# ---- in a scene


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A built scene with a sunny lighting, and one with the same embedding and no sun."""
    runtime.set_quiet(True)
    scene = SceneDir(tiny_twin(tmp_path_factory.mktemp("sunny")))
    casters = shadow_casters(scene, twin.load_scene(scene.root).field())
    day = [float(x) for x in twin.load_scene(scene.root).field().embedding("day")]
    rows = np.array([[0.4] * 3, [0.9] * 3, [0.9] * 3, [0.2] * 3, [0.1] * 3, [0.8, 0.7, 0.5]], np.float32)
    sun = Sun(casters.seen_from(direction(150.0, 30.0)), rows)
    result = stage_result(scene, "field")
    AddedLighting("sunny", day, Fog(), result, "photo.png", {}, sun).save(scene)
    AddedLighting("plain", day, Fog(), result, "photo.png", {}).save(scene)
    return twin.load_scene(scene.root)


def test_a_damaged_mesh_is_an_input_error(tmp_path):
    scene = SceneDir(tiny_twin(tmp_path))
    path = scene.stage("mesh") / "visual.npz"
    arrays = load_arrays(path)
    np.savez(path, **arrays | {"faces": arrays["faces"] + 10**6})
    with pytest.raises(InputError, match=r"visual\.npz"):
        shadow_casters(scene, twin.load_scene(scene.root).field())


SMALL = {"size": (48, 27), "stack": 1}


def _first(built, lighting: str, **options):
    environment = twin.load(built, "ahead", 3, lighting=lighting, **SMALL, **options)
    return environment.reset().observation["pixels"][-1].astype(float), environment


def test_lightings_without_a_sun_keep_their_file(built):
    plain, sunny = (json.loads((built.scene.lightings / f"{name}.json").read_text()) for name in ("plain", "sunny"))
    assert plain["format"] == 2 and "sun" not in plain
    assert sunny["format"] == 3 and tuple(sunny["sun"]["coefficients"]) == TERMS
    field = built.field()
    assert field.sunlight("plain") == field.sunlight("day") == field.sunlight("day:plain:0.5") == ()
    (sun, weight), *_ = field.sunlight("day:sunny:0.25")
    assert weight == 0.25 and angles(sun.toward) == pytest.approx((150.0, 30.0))
    assert field.lightings_by_name.filmed().suns == {}


def test_environments_show_the_sun(built):
    plain, environment = _first(built, "plain")
    np.testing.assert_array_equal(plain, _first(built, "day")[0])
    sunny, _ = _first(built, "sunny")
    observer = environment.pixels._renderer
    pose, field = environment.physics.camera_to_world, built.field()
    seen = field.render(Viewpoints.of(pose[None], observer.intrinsics, SMALL["size"]), "day")
    rays = unproject(pixel_grid(*SMALL["size"]), observer.intrinsics)
    expected = relit(seen.rgb[0], seen.depth[0], rays, pose, field.sunlight("sunny"))
    np.testing.assert_allclose(sunny, 255.0 * np.clip(expected, 0.0, 1.0), atol=1.0)
    assert np.abs(sunny - plain).mean() > 5.0
    half, _ = _first(built, "day:sunny:0.5")
    np.testing.assert_allclose(half, 0.5 * (plain + sunny), atol=3.0)
    factory = EnvFactory.open(built, "ahead", {"lighting": "sunny", **SMALL})
    assert not factory._field_only and EnvFactory.open(built, "ahead", {"lighting": "plain", **SMALL})._field_only


def test_a_free_camera_shows_the_sun(built):
    field = built.field()
    camera = FreeCamera.of_fov(POSE, 1.0, (64, 36))
    plain, sunny = (ScenePicture(field).render(camera, named_lighting(field, name)) for name in ("plain", "sunny"))
    rays = unproject(pixel_grid(64, 36), camera.intrinsics)
    expected = relit(plain.rgb[0], plain.depth[0], rays, POSE, field.sunlight("sunny"))
    np.testing.assert_allclose(sunny.rgb[0], expected, atol=1e-6)
    between = mixed_lighting(named_lighting(field, "plain"), named_lighting(field, "sunny"), 0.5)
    assert between.sunlight[0][1] == pytest.approx(0.5)


def test_a_pack_keeps_the_sun(built, tmp_path):
    path, _ = pack(built.scene.root, tmp_path / "sunny.twin")
    back = twin.load_scene(path).field()
    points = np.random.default_rng(0).uniform([-2, -5, 0], [9, 3, 1], (300, 3))
    (mine, _), (its, _) = built.field().sunlight("sunny")[0], back.sunlight("sunny")[0]
    np.testing.assert_array_equal(mine.shadows.visibility(points), its.shadows.visibility(points))
    np.testing.assert_array_equal(mine.coefficients, its.coefficients)


def test_shadows_of_unfilmed_things_follow_the_known_sun(built):
    sample, toward = RandomizationSample(sunlight=0.7, shade=0.5), direction(150.0, 30.0)
    known, free = (Weather(sample, np.random.default_rng(5), None, sun) for sun in (toward, None))
    assert known._relighting and free._relighting and known._shadows and free._shadows
    np.testing.assert_allclose(known._relighting._sun, toward, atol=1e-6)
    np.testing.assert_allclose(known._shadows._slant, toward[:2] / toward[2])
    assert np.abs(free._relighting._sun - toward).max() > 0.05
    np.testing.assert_array_equal(known._relighting._gain, free._relighting._gain)  # other values are as without a sun
    Weather(sample, np.random.default_rng(5), None, np.array([0.0, 0.0, 1.0]))  # a sun overhead has shadows, too
    environment = _first(built, "sunny", randomise=Ranges(sunlight=(0.7, 0.7)))[1]
    np.testing.assert_allclose(environment.pixels._weather[0]._relighting._sun, toward, atol=1e-6)
    field, world = built.field(), built.world()
    estimator = IrradianceEstimator(field, world.route)
    embedding = field.embedding("sunny")
    lit, plain = (estimator.estimate(embedding, suns) for suns in (field.sunlight("sunny"), ()))
    share, found = lit.sun(world.route[4, :2])
    np.testing.assert_allclose(found, toward, atol=1e-6)
    assert 0.2 < share < 0.8 and plain.known_sun is None
    gain = np.array([0.4, 0.4, 0.4]) + np.sin(np.deg2rad(30.0)) * np.array([0.8, 0.7, 0.5])
    ratios = lit.up / np.maximum(plain.up, 1e-9)
    np.testing.assert_allclose(np.quantile(ratios, 0.9, axis=0), gain, rtol=0.05)  # most of the ground is in the sun


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("120", None, None, None), "--sun 120: expected azimuth and elevation"),
        (("120,95", None, None, None), "elevation above 0, up to 90"),
        (("120,35", "2026-06-01T17:30+02:00", None, None), "expected one of them"),
        ((None, None, "48,11", None), "need a time"),
        ((None, None, None, 90.0), "need a time"),
        ((None, "2026-06-01T17:30+02:00", "48", 90.0), "--location 48: expected latitude and longitude"),
        ((None, "2026-06-01T17:30+02:00", None, 90.0), "--time needs --location"),
        ((None, "2026-06-01T17:30+02:00", "48,11", None), "--time needs --heading"),
    ],
)
def test_unusable_options_are_one_line(tmp_path, options, words):
    scene = filmed_corridor(tmp_path / "corridor")
    for stage in ("capture", "metric"):
        write_stamp(scene.stage(stage), stage)
    with pytest.raises(InputError, match=words) as error:
        find_sun(scene, *options)
    assert "\n" not in str(error.value)


def test_options_give_the_sun(tmp_path):
    scene = filmed_corridor(tmp_path / "corridor")
    for stage in ("capture", "metric"):
        write_stamp(scene.stage(stage), stage)
    assert find_sun(scene, None, None, None, None) is None
    searched = find_sun(scene, "search", None, None, None)
    assert searched is not None and searched.toward is None
    given = find_sun(scene, "120,35", None, None, None)
    assert given is not None and given.toward is not None and angles(given.toward) == pytest.approx((120.0, 35.0))
    timed = find_sun(scene, None, "2003-10-17T12:30:30-07:00", "39.742476,-105.1786", 90.0)
    assert timed is not None and timed.toward is not None
    assert angles(timed.toward) == pytest.approx((255.66, 39.89), abs=0.1)


def test_the_place_is_found_on_both_sides_of_180_degrees(tmp_path):
    scene = filmed_corridor(tmp_path / "corridor")
    capture = Capture.load(scene.stage("capture"))
    longitude = np.where(np.arange(len(capture.names)) % 2, 179.9999, -179.9999)
    gps = np.column_stack([np.full(len(longitude), -16.8), longitude, np.zeros(len(longitude))])
    assert len(gps) % 2 == 0  # else the median is one of them
    replace(capture, gps=gps).save(scene.stage("capture"))
    for stage in ("capture", "metric"):
        write_stamp(scene.stage(stage), stage)
    noon = "2026-06-01T12:00+12:00"
    sun = find_sun(scene, None, noon, None, 90.0)
    assert sun is not None and sun.toward is not None
    np.testing.assert_allclose(sun.toward, sun_direction(parse_time(noon), -16.8, 180.0, 90.0), atol=1e-5)
