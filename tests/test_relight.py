"""Lighting of a photo: the fit, the file, its field, and the errors of `twin.relight`."""

import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest
import torch
from textured import SIZE, K, filmed_corridor, picture, pose_at

import twin
from twin import commands, runtime
from twin.config import RESERVED_LIGHTINGS
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.geometry.images import psnr, read_image, write_image
from twin.nerf.buffers import Layout
from twin.nerf.field import RadianceField, untrained_field
from twin.nerf.lightings import AddedLighting, Fog, Lightings, added_lightings, check_new_name, mixed_fog
from twin.relight import PhotoFit, comparison, fit_photo, summary
from twin.report import video_layout
from twin.report.video_layout import draw_label
from twin.scene import SceneDir, stage_result, write_stamp


def small_field(seed: int = 0) -> RadianceField:
    """An untrained field: its background varies with direction and embedding, which is all that a fit needs."""
    frames = tuple(f"day/{i:06d}" for i in range(4))
    layout = Layout((0.0, 0.0, 0.0), (8.0, 8.0, 4.0), 0.1, 4, 2.0, 10, 32, 8)
    return untrained_field([layout], ("day", "night"), frames, np.zeros(4, np.int64), seed, "cpu")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SceneDir:
    runtime.set_quiet(True)
    scene = filmed_corridor(tmp_path_factory.mktemp("relight") / "scene")
    scene.stage("field").mkdir()
    small_field().save(scene.stage("field"))
    for stage in ("capture", "cameras", "metric", "field"):
        write_stamp(scene.stage(stage), stage)
    write_image(scene.root / "photo.png", picture(pose_at(2.4, 0.2), tint=(0.9, 0.6, 0.4)))
    return scene


def test_fit_finds_the_lighting_of_a_photo(capsys):
    field, pose = small_field(), pose_at(0.0)
    hidden = field.embedding("night") + np.random.default_rng(1).normal(0.0, 0.8, 8).astype(np.float32)
    small = (64, 48)
    photo = field.render(Viewpoints.of(pose[None], K / 5, small), hidden).rgb[0]
    relit = fit_photo(field, photo, pose, K / 5)
    assert "5/5" in capsys.readouterr().err  # the progress bar
    assert relit.psnr_nearest == pytest.approx(max(psnr(p, photo) for p in _filmed(field, pose, small)), abs=1e-3)
    assert relit.psnr_fitted > relit.psnr_nearest + 10.0
    assert relit.psnr_nearest < relit.psnr_other_half <= relit.psnr_fitted + 0.5
    again = field.render(Viewpoints.of(pose[None], K / 5, small), relit.embedding).rgb[0]
    assert psnr(again, photo) == pytest.approx(relit.psnr_fitted, abs=1e-3)
    elsewhere = pose_at(1.0, 0.0, 2.0)[None]
    there = [field.render(Viewpoints.of(elsewhere, K / 5, small), one).rgb[0] for one in (hidden, relit.embedding)]
    assert psnr(there[1], there[0]) > 25.0


def test_the_fit_separates_fog_from_lighting(monkeypatch):
    rng, field = np.random.default_rng(2), small_field()
    pose, size, wide = pose_at(0.0), (64, 48), K / [20, 20, 5, 5]  # corners are thrice as far as their depth
    seen = field.render(Viewpoints.of(pose[None], wide, size), field.embedding("night"))
    depth = rng.uniform(2.0, 120.0, (6, 8)).astype(np.float32).repeat(8, 0).repeat(8, 1)
    trace = field.trace

    def traced(*rays):
        features, harmonics, _, opacity = trace(*rays)
        return features, harmonics, torch.as_tensor(depth.ravel()), opacity

    monkeypatch.setattr(field, "trace", traced)  # an untrained field is as near everywhere
    distance = depth * np.linalg.norm(unproject(pixel_grid(*size), wide), axis=-1)
    noise = rng.normal(0.0, 0.01, seen.rgb[0].shape).astype(np.float32)
    hidden = Fog(0.02, (0.8, 0.7, 0.6))
    hazy = fit_photo(field, hidden.apply(seen.rgb[0], distance.astype(np.float32)) + noise, pose, wide)
    assert hazy.fog.extinction == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(hazy.fog.airlight, hidden.airlight, atol=0.03)
    assert psnr(hazy.images[1], hidden.apply(seen.rgb[0], distance.astype(np.float32))) > 40.0
    assert hazy.psnr_other_half > hazy.psnr_clear_other_half + 0.2
    clear = fit_photo(field, seen.rgb[0] + noise, pose, wide)
    assert clear.fog == Fog() and clear.psnr_other_half == clear.psnr_clear_other_half


def test_halves_are_scored_by_the_fit_to_the_other_half():
    field, pose = small_field(), pose_at(0.0)
    day, night = _filmed(field, pose, (64, 48))
    torn = fit_photo(field, np.hstack([day[:, :32], night[:, 32:]]), pose, K / 5)
    assert torn.psnr_clear_other_half == pytest.approx(psnr(day, night), abs=3.0)  # each half fits one of them


def test_fog_equals_its_closed_form_and_mixes():
    rgb, distance = np.full((1, 2, 3), 0.5, np.float32), np.array([[0.0, 1e6]], np.float32)
    np.testing.assert_array_equal(Fog().apply(rgb, distance), rgb)
    near, far = Fog(0.03, (1.0, 0.0, 0.5)).apply(rgb, distance)[0]
    kept = np.exp(-3.0)  # air reaches 100 m
    np.testing.assert_allclose(near, 0.5)
    np.testing.assert_allclose(far, kept * 0.5 + (1 - kept) * np.array([1.0, 0.0, 0.5]), rtol=1e-5)
    names, vectors = ("filmed", "a", "b"), np.eye(3, dtype=np.float32)
    airs = {"a": Fog(0.02, (1.0, 1.0, 1.0)), "b": Fog(0.06, (0.0, 0.0, 0.0))}
    mine = Lightings(names[:1], vectors[:1], ("filmed/0",), vectors[:1])
    mine = mine.added(dict(zip(names[1:], vectors[1:], strict=True)), fogs=airs)
    assert mine.fog("filmed") is None and mine.fog("filmed/0") is None and mine.fog("any") is None
    assert mine.fog("a") == airs["a"] and mine.filmed().fogs == {}
    assert mine.fog("filmed:a:0.5") == Fog(0.01, (1.0, 1.0, 1.0))
    between = mine.fog("a:b:0.25")
    assert between and between.extinction == pytest.approx(0.03) and between.airlight == pytest.approx((0.5,) * 3)
    assert mixed_fog(Fog(), None, 0.5) == Fog() and mixed_fog(None, None, 0.5) is None
    for share in ("x", "3"):
        with pytest.raises(InputError, match="a:b:"):
            mine.fog(f"a:b:{share}")


def _filmed(field, pose, size):
    return [field.render(Viewpoints.of(pose[None], K / 5, size), name).rgb[0] for name in field.lightings]


def test_relight_adds_a_lighting_to_the_scene(scene, capsys):
    assert commands.main("relight", [str(scene.root), str(scene.root / "photo.png"), "--name", "dusk"]) == 0
    said = capsys.readouterr().out
    assert "inliers of" in said and "dB fitted" in said
    field = twin.load_scene(scene.root).radiance_field()
    assert field.lightings == ("day", "night", "dusk")
    stored = json.loads((scene.lightings / "dusk.json").read_text())
    assert np.allclose(field.embedding("dusk"), stored["embedding"])
    assert stored["figures"]["psnr_fitted"] > stored["figures"]["psnr_nearest"] + 1.0
    middle = 0.5 * field.embedding("day") + 0.5 * field.embedding("dusk")
    assert np.allclose(field.embedding("day:dusk:0.5"), middle, atol=1e-6)
    photo, fitted, _ = np.split(_without_gaps(read_image(scene.lightings / "dusk.png")) / 255.0, 3, axis=1)
    below = np.arange(SIZE[1]) >= 40  # the labels
    unlabelled = np.broadcast_to(below[:, None], photo.shape[:2])
    assert psnr(fitted, photo, unlabelled) == pytest.approx(stored["figures"]["psnr_fitted"], abs=0.5)


def test_comparison_labels_its_panels(monkeypatch):
    """Labels lie in the corner of each panel; the other pixels are those of the images."""
    rng = np.random.default_rng(0)
    images = tuple(rng.uniform(0.0, 1.0, (150, 270, 3)).astype(np.float32) for _ in range(3))
    relit = PhotoFit("sun", np.zeros(4, np.float32), Fog(), images, 16.3, 25.34, 24.0, 24.0)
    drawn = []

    def noted(canvas, text, box, **style):
        drawn.append((text, box))
        draw_label(canvas, text, box, **style)

    monkeypatch.setattr(video_layout, "draw_label", noted)
    out = comparison("dusk", relit)
    assert drawn == [
        ("photo", (0, 0, 270, 150)),
        ("fitted: dusk, 25.3 dB", (274, 0, 270, 150)),
        ("nearest filmed: sun, 16.3 dB", (548, 0, 270, 150)),
    ]
    for k, image in enumerate(images):
        plain, panel = (image * 255.0 + 0.5).astype(np.uint8), out[:, k * 274 : k * 274 + 270]
        assert out.shape == (150, 818, 3) and np.array_equal(panel[40:], plain[40:])
        assert not np.array_equal(panel[:40], plain[:40])


def _without_gaps(picture: np.ndarray) -> np.ndarray:
    width = SIZE[0]
    return np.hstack([picture[:, k * (width + 4) : k * (width + 4) + width] for k in range(3)])


def test_rebuilt_field_refuses_stale_lightings(scene):
    AddedLighting("old", [0.0] * 8, Fog(), stage_result(scene, "field"), "photo.png", {}).save(scene)
    assert "old" in added_lightings(scene, 8)[0]
    another = scene.stage("field") / "another"
    another.touch()
    write_stamp(scene.stage("field"), "field")
    try:
        field = twin.load_scene(scene.root).radiance_field()
        assert "old" not in field.lightings
        for asked in ("old", "day:old:0.5"):
            with pytest.raises(
                InputError, match=r"'old': fitted to another build.*twin relight SCENE PHOTO --name old"
            ):
                field.embedding(asked)
    finally:
        another.unlink()
        write_stamp(scene.stage("field"), "field")
    assert "old" in twin.load_scene(scene.root).radiance_field().lightings


def test_unusable_input_ends_with_one_line_and_status_2(scene, tmp_path, capsys):
    noise = np.kron(np.random.default_rng(0).integers(0, 255, (60, 80, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    write_image(tmp_path / "noise.png", noise)
    photo = str(scene.root / "photo.png")
    for arguments, words in (
        ([str(scene.root), str(tmp_path / "noise.png"), "--name", "x"], "agree with one camera pose (need 25)"),
        ([str(scene.root), str(tmp_path / "absent.png"), "--name", "x"], "absent.png: No such file"),
        ([str(scene.root), photo, "--name", "day"], "filmed under a lighting of this name"),
        ([str(scene.root), photo, "--name", "a:b"], "expected a name of letters"),
        ([str(scene.root), photo, "--name", "../x"], "expected a name of letters"),
        ([str(tmp_path), photo, "--name", "x"], "no scene.toml"),
        ([str(scene.root), photo, "--name", "x", "--sun", "high"], "--sun high: expected azimuth and elevation"),
        ([str(scene.root), photo, "--name", "x", "--time", "noon"], "--time 'noon': expected date, time and offset"),
        ([str(scene.root), photo, "--name", "x", "--sun", "120,35"], "has no 4_mesh yet; run twin build"),
    ):
        assert commands.main("relight", [*arguments, "--quiet"]) == 2
        error = capsys.readouterr().err.strip()
        assert error.startswith("error: ") and words in error and "\n" not in error
    assert not (scene.lightings / "x.json").exists()


def test_a_field_of_another_scale_is_refused(scene, monkeypatch, capsys):
    """`metric` was built again, `field` was not."""
    monkeypatch.setattr("twin.capture.localize.register_photo", lambda *_: pytest.fail("the photo was registered"))
    folder = scene.stage("field")
    before = (folder / "stamp.json").read_bytes()
    try:
        write_stamp(folder, "field", {"upstream": {"metric": "0" * 64}})
        arguments = [str(scene.root), str(scene.root / "photo.png"), "--name", "x", "--quiet"]
        assert commands.main("relight", arguments) == 2
        assert "3_field was built from an earlier 2_metric" in capsys.readouterr().err
    finally:
        (folder / "stamp.json").write_bytes(before)


def test_a_damaged_build_is_found_before_the_photo_is_fitted(scene, monkeypatch, capsys):
    monkeypatch.setattr("twin.relight.fit_photo", lambda *_: pytest.fail("the photo was fitted first"))
    mesh = scene.stage("mesh")
    mesh.mkdir()
    try:
        write_stamp(mesh, "mesh")  # the stage field has no baked field
        arguments = [str(scene.root), str(scene.root / "photo.png"), "--name", "x", "--sun", "120,35", "--quiet"]
        assert commands.main("relight", arguments) == 2
    finally:
        shutil.rmtree(mesh)
    assert "baked.json" in capsys.readouterr().err


def test_error_names_a_damaged_file(scene):
    path = scene.lightings / "broken.json"
    scene.lightings.mkdir(exist_ok=True)
    whole = asdict(AddedLighting("broken", [0.0] * 8, Fog(), "first", "photo.png", {})) | {"format": 2}
    without_air = {key: value for key, value in whole.items() if key != "air"}
    bad_air = whole | {"air": {"extinction": -0.1, "airlight": [1, 1, 1]}}
    try:
        for head, words in (
            ({"format": 2}, r"is damaged \(KeyError"),
            (without_air, r"is damaged \(KeyError: 'air'"),
            (bad_air, r"is damaged \(ValueError: extinction -0\.1"),
            (whole | {"air": {"extinction": 0.1, "airlight": [1, 2, 1]}}, r"is damaged \(ValueError: extinction 0\.1"),
            (whole | {"format": 4}, "format 4, expected 3; fit it again"),
            (whole | {"format": 3, "sun": {"coefficients": {}}}, r"is damaged \(KeyError: 'ambient'"),
        ):
            path.write_text(json.dumps(head))
            with pytest.raises(InputError, match=rf"broken\.json:? {words}") as error:
                added_lightings(scene, 8)
            assert "\n" not in str(error.value)
    finally:
        path.unlink()


def test_a_file_that_is_being_written_is_no_lighting(scene):
    scene.lightings.mkdir(exist_ok=True)
    before = added_lightings(scene, 8)
    partial = scene.lightings / ".afternoon.partial.json"  # see `files.atomic_path`
    partial.write_text('{"format": 2, "na')
    try:
        assert repr(added_lightings(scene, 8)) == repr(before)
    finally:
        partial.unlink()


def test_lighting_of_format_1_is_stale(scene):
    path = scene.lightings / "early.json"
    path.write_text('{"format": 1, "name": "early", "embedding": [0, 0, 0, 0, 0, 0, 0, 0], "field": "first"}')
    try:
        fresh, stale, airs, suns = added_lightings(scene, 8)
        assert stale == ("early",) and "early" not in {**fresh, **airs, **suns}
        with pytest.raises(InputError, match=r"'early': .* by an older twin; fit its photo again: twin relight"):
            twin.load_scene(scene.root).radiance_field().embedding("early")
    finally:
        path.unlink()


def test_fog_of_a_hazy_photo_is_stored_and_printed(scene, monkeypatch, capsys):
    air, image = Fog(0.03, (0.9, 0.8, 0.7)), np.zeros((*SIZE[::-1], 3), np.float32)
    relit = PhotoFit("day", np.zeros(8, np.float32), air, (image, image, image), 16.3, 25.3, 24.0, 12.34)
    monkeypatch.setattr("twin.relight.fit_photo", lambda *_: relit)
    assert commands.main("relight", [str(scene.root), str(scene.root / "photo.png"), "--name", "hazy"]) == 0
    assert "visibility 100 m; 12.3 dB on the other half without fog" in capsys.readouterr().out
    assert added_lightings(scene, 8)[2]["hazy"] == air


@pytest.mark.parametrize(("sun", "words"), [(None, "half without fog"), (object(), "half without fog and sun")])
def test_summary_names_what_the_compared_fit_lacks(sun, words):
    numbers = "inliers matches reprojection_error_px from_path_m focal_px psnr_nearest psnr_fitted psnr_other_half"
    figures = dict.fromkeys([*numbers.split(), "psnr_clear_other_half"], 1.0)
    figures |= {"camera_to_world": np.eye(4).tolist(), "focal_from": "the photo", "nearest": "day"}
    assert summary(AddedLighting("hazy", [], Fog(0.03), "first", "photo.png", figures, sun)).endswith(words)


def test_lightings_can_be_added():
    mine = Lightings(("a",), np.zeros((1, 3), np.float32), (), np.zeros((0, 3), np.float32))
    more = mine.added({"b": np.ones(3, np.float32)}, ("c",))
    assert more.names == ("a", "b")
    assert np.array_equal(more.embedding("a:b:0.25"), np.full(3, 0.25, np.float32))
    with pytest.raises(InputError, match="another build"):
        more.embedding("c")


@pytest.mark.parametrize("share", ["30", "nan", "inf", "-0.1", "1.01"])
def test_share_of_a_mixture_is_from_0_to_1(share):
    mine = Lightings(("a", "b"), np.eye(2, dtype=np.float32), (), np.zeros((0, 2), np.float32))
    for end in ("0", "1"):
        assert np.array_equal(mine.embedding(f"a:b:{end}"), mine.embedding("ab"[int(end)]))
    with pytest.raises(InputError, match=rf"share {share} is not from 0 to 1; give a:b:0\.3 for 30 %") as error:
        mine.embedding(f"a:b:{share}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [*RESERVED_LIGHTINGS, "drawn_3"])
def test_reserved_names_are_refused(name):
    with pytest.raises(InputError, match=rf"--name '{name}': reserved"):
        check_new_name(name, ("day",))
