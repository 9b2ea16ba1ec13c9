"""The verb: files and folders for other programs, read back by their own readers; bad arguments get one line."""

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import trimesh
from PIL import Image
from test_gaussians import floor_views
from tiny_twin import filmed_tiny_twin

from twin import commands, runtime
from twin.assets.gaussians import read_ply
from twin.capture.formats import read_model, read_transforms
from twin.export import gltf
from twin.export.__main__ import export
from twin.geometry.cameras import Cameras, SparsePoints, project
from twin.geometry.images import read_image
from twin.loading import load_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return filmed_tiny_twin(tmp_path_factory.mktemp("export") / "scene")


@pytest.fixture(scope="module")
def out(scene, tmp_path_factory) -> Path:
    """All files that the verb writes."""
    out = tmp_path_factory.mktemp("out")
    options = {
        "usd": "p.usdz",
        "glb": "p.glb",
        "ply": "p.ply",
        "nerfstudio": "ns",
        "colmap": "cm",
        "task-file": "t.json",
    }
    given = [text for name, value in options.items() for text in (f"--{name}", str(out / value))]
    assert commands.main("export", [str(scene), *given, "--task", "ahead", "--lighting", "night", "--quiet"]) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(options.values())
    return out


def _cameras(scene) -> Cameras:
    return Cameras.load(scene / "build" / "2_metric")


def test_colmap_reads_the_same_poses(scene, out) -> None:
    cameras, points = _cameras(scene), SparsePoints.load(scene / "build" / "2_metric")
    model = pycolmap.Reconstruction(str(out / "cm" / "sparse" / "0"))
    assert model.num_reg_images() == 6 and len(model.cameras) == 2
    for image in model.images.values():
        i = cameras.names.index(image.name.removesuffix(".png"))
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        assert np.abs(np.linalg.inv(pose) - cameras.camera_to_world[i]).max() < 1e-12
        assert np.allclose(model.cameras[image.camera_id].params, cameras.intrinsics[i], atol=0)
        assert (read_image(out / "cm" / "images" / image.name) == read_image(cameras.image_path(i))).all()
        # COLMAP projects its points to where we do.
        for seen in image.points2D:
            xyz = model.points3D[seen.point3D_id].xyz
            ours, _ = project(xyz, cameras.camera_to_world[i], cameras.intrinsics[i])
            assert np.abs(image.project_point(xyz) - ours).max() < 1e-9 and np.abs(seen.xy - ours).max() < 1e-9
    for key, point in model.points3D.items():
        assert np.allclose(point.xyz, points.xyz[key - 1], atol=0) and (point.color == points.rgb[key - 1]).all()
    assert model.compute_mean_reprojection_error() < 1.1
    assert {p.relative_to(out / "cm" / "masks").as_posix() for p in (out / "cm" / "masks").rglob("*.png")} == {
        "day/000001.png.png",
        "night/000001.png.png",
    }
    assert len(read_model(out / "cm" / "sparse" / "0")) == 6


def test_nerfstudio_has_opengl_axes_and_meters(scene, out) -> None:
    cameras = _cameras(scene)
    table = json.loads((out / "ns" / "transforms.json").read_text())
    assert table["applied_transform"] == np.eye(4)[:3].tolist() and table["camera_model"] == "OPENCV"
    assert len(table["frames"]) == 6
    for i, frame in enumerate(table["frames"]):
        pose = np.array(frame["transform_matrix"])
        right, up, back, eye = pose[:3].T
        assert (eye == cameras.positions[i]).all()
        assert np.allclose(right, cameras.camera_to_world[i, :3, 0]) and np.allclose(
            -back, cameras.camera_to_world[i, :3, 2]
        )
        assert up[2] > 0.5  # a level camera's up points up
        assert [frame[k] for k in ("fl_x", "fl_y", "cx", "cy")] == cameras.intrinsics[i].tolist()
        assert (read_image(out / "ns" / frame["file_path"]) == read_image(cameras.image_path(i))).all()
        white = i != 4
        assert (read_image(out / "ns" / frame["mask_path"]) == 255 * white).all()
    # All lists or none, as nerfstudio demands, of paths that frames have.
    assert table["val_filenames"] == table["test_filenames"] == ["images/day/000000.png"]
    assert set(table["train_filenames"]) == {f["file_path"] for f in table["frames"][1:]}
    night = json.loads((out / "ns" / "transforms_night.json").read_text())
    assert [f["lighting"] for f in night["frames"]] == ["night"] * 3
    cloud = trimesh.load(out / "ns" / table["ply_file_path"])
    points = SparsePoints.load(scene / "build" / "2_metric")
    assert np.allclose(cloud.vertices, points.xyz, atol=1e-5) and (cloud.colors[:, :3] == points.rgb).all()
    # Our own reader of such files finds the poses again.
    again = read_transforms(out / "ns" / "transforms.json")
    assert np.abs(again.camera_to_world - cameras.camera_to_world).max() < 1e-12


def test_splats_and_mesh_have_the_lighting(out, scene) -> None:
    splats = read_ply(out / "p.ply")
    assert len(splats.rgb) > 1000 and np.abs(splats.positions).max() < 200.0
    mesh = trimesh.load(io.BytesIO((out / "p.glb").read_bytes()), file_type="glb").to_geometry()
    stored = np.load(scene / "build" / "4_mesh" / "visual.npz")
    corners = stored["vertices"][stored["faces"]].reshape(-1, 3)
    assert np.allclose(mesh.vertices, corners[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)  # y up
    head = (out / "p.glb").read_bytes()[20:]
    assert b"KHR_materials_unlit" in head and b"image/jpeg" in head and mesh.visual.uv is not None


def test_compressed_splats_are_those_of_the_ply(out, tmp_path) -> None:
    spz = pytest.importorskip("gsply.spz", reason="needs gsply")
    splats = read_ply(out / "p.ply")
    splats.write_spz(tmp_path / "p.spz")
    read, wanted = spz.read_spz(tmp_path / "p.spz"), splats.stored()
    assert (tmp_path / "p.spz").stat().st_size < (out / "p.ply").stat().st_size / 4
    assert np.abs(read.means - wanted["means"]).max() < 2**-12
    assert np.abs(read.sh0 - wanted["sh0"]).max() < 0.02 and np.abs(read.scales - wanted["scales"]).max() < 0.04
    assert np.abs(1 / (1 + np.exp(-read.opacities)) - splats.opacity).max() < 0.005
    unit = splats.rotations / np.linalg.norm(splats.rotations, axis=1, keepdims=True)
    assert np.abs((read.quats * unit).sum(1)).min() > 0.9999  # the same rotation, up to the sign
    far = replace(splats, positions=splats.positions + np.float32(2500.0), opacity=np.ones_like(splats.opacity))
    far.write_spz(tmp_path / "far.spz")
    assert np.abs(spz.read_spz(tmp_path / "far.spz").means - far.positions).max() < 2**-10
    assert np.isfinite(far.stored()["opacities"]).all()


# ---- texture


def test_each_progress_bar_has_its_own_name(scene, tmp_path, monkeypatch) -> None:
    names: list[str] = []
    bar = runtime.bar
    monkeypatch.setattr(runtime, "bar", lambda what, *more, **how: (names.append(what), bar(what, *more, **how))[1])
    export(scene, None, ply=tmp_path / "a.ply", glb=tmp_path / "a.glb")
    assert [name.split(",")[0] for name in names] == ["splats", "splats", "textures", "visible faces"] and len(
        set(names)
    ) == len(names)


def test_a_baked_texture_shows_what_the_views_show() -> None:
    views = floor_views([(0.0, -0.8, 2.0), (0.6, -0.5, 1.5), (-0.5, 0.4, 1.8)])
    vertices = np.array(
        [[-0.6, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.6, 0], [-0.6, 0.6, 0], [0, 0, -3], [1, 0, -3], [0, 1, -3.0]]
    )
    faces = np.array([[0, 1, 2], [2, 3, 0], [4, 5, 6]])
    texture, coordinates = gltf.bake(vertices, faces, views)
    rng = np.random.default_rng(0)
    for face in range(2):
        share = rng.dirichlet([1, 1, 1], 300)
        point, at = share @ vertices[faces[face]], share @ coordinates[face]
        u, v = np.floor(at * texture.shape[1::-1]).astype(int).T
        away = np.abs(point[:, :2]).min(1) > 0.12  # from where colors change
        expected = np.stack([np.where(point[:, 0] > 0, 220, 40), np.where(point[:, 1] > 0, 200, 60)], 1)
        assert np.abs(texture[v, u, :2].astype(int) - expected)[away].max() <= 2
    # The face that no view sees has the mean color of the nearest one.
    u, v = np.floor(coordinates[2].mean(0) * texture.shape[1::-1]).astype(int)
    assert texture[v, u].min() > 30
    # The file has the texture as it was encoded, not encoded once more at another quality.
    read = trimesh.load(io.BytesIO(gltf.textured_glb(vertices, faces, views)), file_type="glb").to_geometry()
    encoded = io.BytesIO()
    Image.fromarray(texture).save(encoded, "JPEG", quality=95, subsampling=0)
    assert (np.asarray(read.visual.material.baseColorTexture) == np.asarray(Image.open(encoded))).all()


FLOOR = np.array([[-0.4, -0.4, 0], [0.4, -0.4, 0], [0.4, 0.4, 0], [-0.4, 0.4, 0]]), np.array([[0, 1, 2], [2, 3, 0]])


def frame_of(views, rgb: np.ndarray, used: bool = True) -> gltf.Pictures:
    """A frame filmed at the pose of the first view."""
    shape = views.depth[:1].shape
    picture = np.broadcast_to(rgb, (*shape, 3)).astype(np.uint8)
    return gltf.Pictures(views.camera_to_world[:1], views.intrinsics[:1], picture, np.full(shape, used))


def test_frames_add_detail_and_what_passed_is_left_out() -> None:
    """A view renders gray; the frame there is lighter, of another color (someone passed), or masked."""
    views = floor_views([(0.0, -0.2, 2.0)])
    views = replace(views, rgb=np.full_like(views.rgb, 120))
    for frame, mean in (
        (frame_of(views, np.array([150, 150, 150])), 135),
        (frame_of(views, np.array([230, 60, 60])), 120),
        (frame_of(views, np.array([150, 150, 150]), used=False), 120),
    ):
        texture, coordinates = gltf.bake(*FLOOR, views, [frame])
        u, v = np.floor(coordinates.mean(1) * texture.shape[1::-1]).astype(int).T
        assert np.abs(texture[v, u].astype(int) - mean).max() <= 1


def test_a_face_has_no_color_of_what_stands_before_it() -> None:
    """A wall hides half of the floor from one of two views, which shows it in another color."""
    views = floor_views([(0.0, -1.5, 1.0), (0.0, 0.0, 2.0)])
    rgb = np.full_like(views.rgb, 120)
    rgb[0] = 60
    views = replace(views, rgb=rgb)
    wall = np.array([[-3, -0.6, -0.5], [3, -0.6, -0.5], [3, -0.6, 3], [-3, -0.6, 3.0]])
    vertices, faces = np.concatenate([FLOOR[0], wall]), np.concatenate([FLOOR[1], FLOOR[1] + 4])
    texture, coordinates = gltf.bake(vertices, faces, views)
    u, v = np.floor(coordinates.mean(1) * texture.shape[1::-1]).astype(int).T
    assert (texture[v, u][:2] == 120).all() and (texture[v, u][2:] < 80).all()  # the other view grazes the wall


def test_training_frames_of_the_lighting_are_baked(scene) -> None:
    cameras = load_scene(scene).cameras()
    for lighting in set(cameras.lightings):
        wanted = np.flatnonzero(~cameras.held_out & (np.array(cameras.lightings) == lighting))
        frames = gltf.filmed_frames(cameras, lighting)
        assert [frame.camera_to_world[0].tolist() for frame in frames] == cameras.camera_to_world[wanted].tolist()
        assert (frames[0].rgb[0] == read_image(cameras.image_path(wanted[0]))).all()
    assert [bool(frame.masks.all()) for frame in gltf.filmed_frames(cameras, "night")] == [True, False, True]
    assert gltf.filmed_frames(replace(cameras, images=cameras.images / "absent"), cameras.lightings[0]) == []


def test_tiles_do_not_overlap() -> None:
    side = np.random.default_rng(0).integers(2, 60, 500)
    x, y, width = gltf.pack_tiles(side)
    used = np.zeros(((y + side).max(), width), int)
    for n, left, top in zip(side, x, y, strict=True):
        used[top : top + n, left : left + n] += 1
    assert used.max() == 1 and used.sum() == (side**2).sum()


def test_the_texture_is_no_higher_than_viewers_support(monkeypatch) -> None:
    """Eight tiles of 86 px have fewer texels than 256 × 256, but only two fit into a row, so four rows are too high."""
    monkeypatch.setattr(gltf, "_SIDE", 256)
    monkeypatch.setattr(gltf, "_MAX_TILE", 86)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) * 40.0 + np.arange(8)[:, None, None] * [0.1, 0.0, 0.0] - 15.0
    corners[..., 2] = 0.0
    texture, _ = gltf.bake(corners.reshape(-1, 3), np.arange(24).reshape(-1, 3), floor_views([(0.0, -0.2, 2.0)]))
    assert max(texture.shape[:2]) <= 256


def test_vertices_have_the_colors_of_the_views() -> None:
    vertices = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [0.3, 0.31, -0.5]])
    colours = gltf.vertex_colors(floor_views(), vertices)
    assert np.abs(colours[:3, :2].astype(int) - [[220, 200], [40, 200], [220, 60]]).max() <= 1
    assert (colours[3] == colours[0]).all()  # hidden below the floor: as the nearest seen


def test_a_task_file_has_the_scenes_line_and_rules(scene, out) -> None:
    table = json.loads((out / "t.json").read_text())
    world = load_scene(scene).world()
    assert (table["format"], table["name"], table["half_width"]) == ("twin task", "ahead", world.half_width)
    assert np.array_equal(table["line"], world.route)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "nothing to write"),
        (["--glb", "absent/a.glb"], "there is no folder absent"),
        (["--ply", "a.ply"], "no scene.toml"),
        (["--usd", "a.obj"], "expected a file ending in .usdz"),
        (["--glb", "a.gltf"], "a.gltf: expected a file ending in .glb"),
        (["--ply", "a.spz"], "a.spz: expected a file ending in .ply"),
        (["--spz", "a.ply"], "a.ply: expected a file ending in .spz"),
        (
            ["--colmap", "a", "--lighting", "night"],
            "--lighting night: only --usd, --glb, --ply and --spz have a lighting",
        ),
        (["--usd", "folder.usd"], "is a folder; give a file"),
        (["--colmap", "folder"], "is there already"),
        (["--nerfstudio", "file"], "is there already"),
        (["--task-file", "a.json"], "--task and --task-file belong together"),
        (["--task-file", "folder", "--task", "ahead"], "is a folder; give a file"),
        (["--nerfstudio", "new", "--colmap", "../{here}/new"], "new is given twice"),
        (["--glb", "a.glb", "--task", "ahead", "--task-file", "a.glb"], "a.glb is given twice"),
    ],
)
def test_bad_arguments_are_refused(tmp_path, monkeypatch, capsys, arguments, words) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("folder", "folder.usd"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("")
    assert commands.main("export", ["nowhere", *(one.format(here=tmp_path.name) for one in arguments)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "folder.usd"]


def test_an_unknown_lighting_is_refused(scene, tmp_path, capsys) -> None:
    assert commands.main("export", [str(scene), "--ply", str(tmp_path / "a.ply"), "--lighting", "noon"]) == 2
    assert "noon" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_task_is_looked_up_before_anything_is_rendered(scene, tmp_path, capsys) -> None:
    files = ["--glb", str(tmp_path / "a.glb"), "--task-file", str(tmp_path / "t.json")]
    assert commands.main("export", [str(scene), *files, "--task", "ahed", "--quiet"]) == 2
    assert capsys.readouterr().err == "error: task 'ahed': unknown; did you mean 'ahead'?\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("package", "option", "name"), [("pxr", "usd", "a.usdz"), ("gsply", "spz", "a.spz")])
def test_a_missing_package_is_named(scene, tmp_path, monkeypatch, capsys, package, option, name) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert commands.main("export", [str(scene), f"--{option}", str(tmp_path / name)]) == 2
    assert f"pip install 'twin[{option}]'" in capsys.readouterr().err and not list(tmp_path.iterdir())
