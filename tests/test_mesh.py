"""The mesh stage on a known place: a road, a wall, a post, and a crate that reaches into the corridor."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticField, Box, Post, drive
from scipy.ndimage import label
from scipy.spatial import cKDTree

from twin.assets import mesh, solids, tsdf
from twin.assets.convex import ConvexPart, inside_hull
from twin.assets.ground import Ground
from twin.assets.mesh import build_assets
from twin.assets.solids import HEADROOM, Corridor, solid_pieces
from twin.assets.tsdf import FREE_SPACE_REACH
from twin.assets.views import render_views
from twin.config import BranchConfig, MeshConfig, MetricConfig, MjcfConfig, SceneConfig, SourceConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.route import BRANCH, distance_to_route, filmed_branches
from twin.nerf.poles import Poles

HALF_WIDTH = 1.0  # [m]
WALL = Box(7.0, 3.0, 3.0, 1.0, 1.4)
POST = Post(6.0, -2.2, 0.15, 2.0)
CRATE = Box(9.0, -1.3, 0.8, 1.0, 0.7)
SETTINGS = MeshConfig(margin=4.5, views=14, view_width=100, ground_cell=0.2)
PLACE = AnalyticField(boxes=(WALL, CRATE), posts=(POST,), slope=0.02)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory):
    """Folder of the stage's files, and its metrics."""
    root = tmp_path_factory.mktemp("place")
    path = np.stack([np.arange(0.0, 12.01, 0.5), np.zeros(25)], -1)
    cameras = drive(PLACE, path, root / "2_metric", points=800)
    out = root / "4_mesh"
    out.mkdir()
    return out, _build(cameras, root, out)


def _build(cameras: Cameras, root: Path, out: Path, half_width: float = HALF_WIDTH, poles=None, **settings):
    config = SceneConfig(
        source=(SourceConfig(path="day.mp4"),),
        metric=MetricConfig(camera_height=1.8),
        mesh=SETTINGS,
        mjcf=MjcfConfig(half_width=half_width),
        **settings,
    )
    return build_assets(PLACE, cameras, SparsePoints.load(root / "2_metric"), config, out, root / "cache", poles)


def _load(folder: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(folder / f"{name}.npz", allow_pickle=False) as data:
        return dict(data)


def _parts(folder: Path) -> list[ConvexPart]:
    data = _load(folder, "parts")
    at, of = data["vertex_start"], data["face_start"]
    return [
        ConvexPart(data["vertices"][at[i] : at[i + 1]].astype(float), data["faces"][of[i] : of[i + 1]].astype(np.int64))
        for i in range(len(at) - 1)
    ]


@pytest.fixture(scope="module")
def stood(made):
    """Views, ground, corridor, path and box of the place: the input of the fusion."""
    folder, facts = made
    cameras = Cameras.load(folder.parent / "2_metric")
    views = render_views(PLACE, cameras, 14, 100, FREE_SPACE_REACH * (SETTINGS.margin + 2.0))
    route = _load(folder, "route")["xy"]
    return views, Ground.load(folder), Corridor((route,), HALF_WIDTH), route[::2], np.array(facts["bounds_m"])


def _edges(faces):
    """Number of faces at each edge."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def test_poles_are_parts_and_visible_but_never_in_the_corridor(made, tmp_path):
    folder, facts = made
    feet = np.array([[4.0, 2.0, 0.08], [5.0, 0.5, 0.1]])
    poles = Poles(feet, np.array([0.04, 0.04]), np.array([5.0, 1.5]))  # the first is cut at 3.1 m
    cameras = Cameras.load(folder.parent / "2_metric")
    told = _build(cameras, folder.parent, tmp_path, poles=poles)
    before, parts = _parts(folder), _parts(tmp_path)
    assert facts["poles"] == 0 and told["poles"] == 1 and len(parts) == len(before) + 1 == told["parts"]
    away = np.linalg.norm(parts[-1].vertices[:, :2] - (4.0, 2.0), axis=1)
    assert np.allclose(away, 0.04, atol=1e-6) and np.isclose(parts[-1].vertices[:, 2].max(), 3.18)
    assert inside_hull(parts[-1], np.array([[4.0, 2.0, 0.5]])).all()
    near = [
        int((np.linalg.norm(_load(one, "visual")["vertices"][:, :2] - (4.0, 2.0), axis=1) < 0.05).sum())
        for one in (folder, tmp_path)
    ]
    assert near[1] >= near[0] + 16


def test_sections_give_the_surface_and_the_solid_of_one(stood, monkeypatch):
    (whole_vertices, whole_faces), whole, outvoted = mesh._fuse_sections(*stood, SETTINGS)
    monkeypatch.setattr(tsdf, "_MAX_VOXELS", 1000)
    monkeypatch.setattr(tsdf, "_SECTION_SIDE", 32)
    fuse, fused = tsdf.fuse_volume, []
    monkeypatch.setattr(tsdf, "fuse_volume", lambda *given: fused.append(fuse(*given)) or fused[-1])
    (vertices, faces), joined, outvoted_in_sections = mesh._fuse_sections(*stood, SETTINGS)
    assert len(fused) > 4 and max(volume.distance.size for volume in fused) < 600_000
    for name in ("index", "field", "above"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
    assert outvoted_in_sections == outvoted
    assert len(vertices) == len(whole_vertices) and len(faces) == len(whole_faces)
    assert cKDTree(vertices).query(whole_vertices)[0].max() < 1e-5
    np.testing.assert_array_equal(np.bincount(_edges(faces)), np.bincount(_edges(whole_faces)))  # no cracks


def test_pieces_do_not_end_at_borders_of_sections(stood, monkeypatch):
    views, ground, corridor, path, box = stood
    found = []
    for most in (tsdf._MAX_VOXELS, 1000):
        monkeypatch.setattr(tsdf, "_MAX_VOXELS", most)
        monkeypatch.setattr(tsdf, "_SECTION_SIDE", 32)
        solid = mesh._fuse_sections(views, ground, corridor, path, box, SETTINGS)[1]
        found.append(solid_pieces(solid, box[0], SETTINGS.voxel, path, SETTINGS))
    assert found[0][1] == found[1][1] and len(found[0][0]) == len(found[1][0]) > 2
    for a, b in zip(found[0][0], found[1][0], strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.faces, b.faces)


@pytest.mark.parametrize("reach", [1.0, 10.5])
def test_a_wide_corridor_leaves_what_stands_beside_it(stood, reach):
    """The crate is 13 m away from this line across the place, so it stays."""
    views, ground, _, _, box = stood
    line = np.stack([np.full(30, -4.4), np.linspace(-4.4, 4.4, 30)], -1)
    settings = replace(SETTINGS, margin=40.0)
    found = [
        mesh._fuse_sections(views, ground, one, line, box, settings)[1] for one in (Corridor((line,), reach), None)
    ]
    beside = [box[0, 0] + SETTINGS.voxel * solid.index[:, 0] > 8.4 for solid in found]
    assert beside[1].sum() > 100
    for name in ("index", "field"):
        np.testing.assert_array_equal(*(getattr(one, name)[of] for one, of in zip(found, beside, strict=True)))


def test_components_touch_at_corners_and_are_numbered_by_their_first_voxels():
    solid = np.random.default_rng(0).random((9, 11, 7)) < 0.06
    mine = solids._components(solids._keys(np.argwhere(solid)))
    assert mine.max() > 5
    np.testing.assert_array_equal(mine + 1, label(solid, np.ones((3, 3, 3), bool))[0][solid])


def _wall_front():
    """Points on the wall's side towards the road, clear of the ground and of its edges."""
    x, z = np.meshgrid(np.arange(5.8, 8.2, 0.1), np.arange(0.4, 1.2, 0.1))
    return np.stack([x, np.full_like(x, WALL.y - WALL.width / 2), z], -1).reshape(-1, 3)


def _post_front(low, high):
    """Points on the post's side that the camera comes from."""
    z = np.linspace(low, high, 8)
    return np.column_stack([np.full(8, POST.x - POST.radius), np.full(8, POST.y), z])


def test_layout_of_files(made):
    folder, facts = made
    visual, parts, route = (_load(folder, name) for name in ("visual", "parts", "route"))
    assert {k: v.dtype.name for k, v in visual.items()} == {"vertices": "float32", "faces": "int32", "colors": "uint8"}
    assert visual["vertices"].shape == visual["colors"].shape and visual["faces"].max() < len(visual["vertices"])
    assert {k: v.dtype.name for k, v in parts.items()} == {
        "vertices": "float32",
        "faces": "int32",
        "vertex_start": "int64",
        "face_start": "int64",
    }
    for name, start in (("vertices", "vertex_start"), ("faces", "face_start")):
        assert parts[start][0] == 0 and parts[start][-1] == len(parts[name]) and (np.diff(parts[start]) >= 4).all()
    assert len(_parts(folder)) == facts["parts"] > 0
    for part in _parts(folder):
        assert sorted(set(part.faces.ravel())) == list(range(len(part.vertices)))
    assert np.allclose(route["z"], Ground.load(folder).at(route["xy"]))
    json.dumps(facts, allow_nan=False)


def test_coverage_is_unknown_if_no_coarse_node_is_near_the_route():
    ground = Ground(
        np.zeros((21, 41)), np.full(2, -10.0), 1.0, np.ones((21, 41), bool), np.zeros((21, 41, 3), np.uint8)
    )
    route = np.stack([np.arange(0.0, 20.0, 0.25), np.zeros(80)], 1)
    assert mesh._roughness(ground, route)["corridor_coverage"] is None
    assert mesh._roughness(ground, route + np.array([0.0, 2.0]))["corridor_coverage"] == 1.0


def test_route_is_the_filmed_line(made):
    route = _load(made[0], "route")["xy"]
    assert np.allclose(route[[0, -1]], [[0, 0], [12, 0]], atol=0.05) and np.abs(route[:, 1]).max() < 0.02
    assert made[1]["route_length_m"] == pytest.approx(12.0, abs=0.1)


def test_ground_matches_the_place(made):
    ground = Ground.load(made[0])
    x, y = np.meshgrid(np.arange(0.0, 12.0, 0.2), np.arange(-2.0, 2.0, 0.2))
    xy = np.stack([x, y], -1)
    error = np.abs(ground.at(xy) - PLACE.ground(xy))
    assert np.median(error) < 0.04 and np.quantile(error, 0.95) < 0.08
    assert ground.measured.any() and not ground.measured.all()


def test_wall_and_post_are_in_both_meshes(made):
    folder, _ = made
    parts, vertices = _parts(folder), _load(folder, "visual")["vertices"].astype(float)
    for points in (_wall_front(), _post_front(0.2, 0.45)):
        assert np.any([inside_hull(part, points, 0.2) for part in parts], axis=0).all()
        assert np.linalg.norm(points[:, None] - vertices, axis=-1).min(1).max() < 0.2


def test_a_thin_post_has_its_full_height(made):
    points = _post_front(0.8, 1.6)
    assert np.any([inside_hull(part, points, 0.2) for part in _parts(made[0])], axis=0).all()


def test_no_parts_in_free_space(made):
    folder, facts = made
    corners = np.concatenate([part.vertices for part in _parts(folder)])
    corners = corners[corners[:, 2] > PLACE.ground(corners[:, :2]) + 0.2]
    # Behind a front, two voxels of its band and 0.3 m of hidden space count as solid; the bound is 0.3 m wider.
    assert PLACE.distance_to_obstacles(corners).max() < 0.5 + 2 * 0.15 + 0.1
    assert facts["parts_beyond_bound"] == 0 and facts["max_protrusion_m"] <= 0.2


def test_no_part_is_in_the_corridor(made):
    folder, _ = made
    route = _load(folder, "route")["xy"]
    rng = np.random.default_rng(0)
    xy = rng.uniform([-1, -1], [13, 1], (20_000, 2))
    xy = xy[distance_to_route(route, xy) <= HALF_WIDTH]
    points = np.column_stack([xy, PLACE.ground(xy) + rng.uniform(0.05, HEADROOM - 0.05, len(xy))])
    assert (PLACE.distance_to_obstacles(points) < -0.05).any()
    parts = _parts(folder)
    assert not any(inside_hull(part, points).any() for part in parts)
    behind = np.array([[CRATE.x, CRATE.y - 0.2, 0.4]])
    assert any(inside_hull(part, behind, 0.1)[0] for part in parts), "the crate must stay beside the corridor"


@pytest.mark.parametrize(("counted_length", "views"), [(100.0, 14), (6.0, 28)])
def test_views_are_per_length_of_a_long_route(made, monkeypatch, counted_length, views):
    counts = []

    def stop(field, cameras, count, *_):
        counts.append(count)
        raise StopIteration

    monkeypatch.setattr(mesh, "_COUNTED_LENGTH", counted_length)
    monkeypatch.setattr(mesh, "render_views", stop)
    metric = made[0].parent / "2_metric"
    with pytest.raises(StopIteration):
        mesh.build_assets(
            PLACE,
            Cameras.load(metric),
            SparsePoints.load(metric),
            SceneConfig(mesh=SETTINGS),
            made[0].parent / "unused",
            made[0].parent / "cache",
        )
    assert counts == [pytest.approx(views, abs=1)]


def test_corridor_of_a_branch_is_free(made, tmp_path):
    """The branch passes so close to the wall that the wall is cut back; the route alone leaves the wall whole."""
    root = made[0].parent
    cameras = Cameras.load(root / "2_metric")
    branch = BranchConfig(name="left", points=((0.0, 0.3), (3.0, 0.95), (11.0, 0.95), (12.0, 0.9)))
    nearest = []
    for branches in ((), (branch,)):
        out = tmp_path / str(len(branches))
        out.mkdir()
        facts = _build(cameras, root, out, half_width=1.8, branch=branches)
        line = filmed_branches(cameras, (branch,))["left"]
        corners = np.concatenate([part.vertices for part in _parts(out)])
        low = corners[corners[:, 2] < HEADROOM]
        nearest.append(distance_to_route(line, low[:, :2]).min())
    assert nearest[0] < 1.75 < 1.79 < nearest[1]
    stored = _load(out, "route")[f"{BRANCH}left"]
    np.testing.assert_array_equal(stored[:, :2], line)
    np.testing.assert_allclose(stored[:, 2], Ground.load(out).at(line))
    assert facts["branches_m"]["left"] == pytest.approx(12.1, abs=0.2)
    wrong = BranchConfig(name="left", passes=("night",))
    with pytest.raises(InputError, match=r"\[\[branch\]\] 'left'\.passes: no pass 'night'"):
        filmed_branches(cameras, (wrong,))
