"""The USD file: its schemas' validators are silent, and what is read back is what the simulator has."""

import mujoco
import numpy as np
import pytest
from test_gaussians import draw, floor_views
from tiny_world import box, tiny_world

pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation, UsdVol

from twin.assets.gaussians import Gaussians, gaussians_by_lighting, read_ply
from twin.assets.views import Views
from twin.export.usd import ground_triangles, tire_hull, variant_name, write_usd
from twin.geometry.cameras import Viewpoints, opencv_to_mujoco, project
from twin.mjcf.scene_xml import Parts
from twin.robot import WHEELS

LIGHTINGS = ("day", "night", "day:night:0.5")
MESH = box((3.0, 2.2, 0.8), (0.6, 0.6, 0.8)).astype(np.float32), np.array([[0, 1, 2], [2, 3, 0]], np.int32)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return tiny_world(tmp_path_factory.mktemp("world") / "scene")


@pytest.fixture(scope="module")
def splats() -> dict[str, Gaussians]:
    one = floor_views()
    return gaussians_by_lighting(
        {name: Views(**{**vars(one), "rgb": one.rgb // (k + 1)}) for k, name in enumerate(LIGHTINGS)}
    )


def _write(path, splats, world) -> None:
    colors = {name: np.full((8, 3), 60 * k, np.uint8) for k, name in enumerate(splats)}
    parts = Parts.load(world.folder.parent / "4_mesh" / "parts.npz")
    write_usd(path, splats, MESH, colors, parts, world.model(), world, "day")


@pytest.fixture(scope="module")
def file(tmp_path_factory, world, splats):
    path = tmp_path_factory.mktemp("usd") / "place.usdz"
    _write(path, splats, world)
    return path


@pytest.fixture
def stage(file):
    return Usd.Stage.Open(str(file))


def _errors(stage) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    return [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("suffix", [".usdz", ".usd", ".usdc"])
def test_validators_find_nothing(tmp_path, world, splats, suffix) -> None:
    path = tmp_path / f"place{suffix}"
    _write(path, splats, world)
    stage = Usd.Stage.Open(str(path))
    assert _errors(stage) == []
    for lighting in LIGHTINGS:
        stage.GetDefaultPrim().GetVariantSet("lighting").SetVariantSelection(variant_name(lighting))
        assert _errors(stage) == []
    assert [one.name for one in tmp_path.iterdir()] == [path.name]  # nothing temporary is left
    # They do speak, of units, bodies, joints and articulations.
    stage.GetRootLayer().pseudoRoot.ClearInfo("upAxis")
    UsdPhysics.RigidBodyAPI.Apply(stage.GetPrimAtPath("/World/Husky/Joints"))
    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/World/Husky/base_link"))
    stage.RemovePrim("/World/Husky/rear_left_wheel")
    assert len(_errors(stage)) >= 4


def test_units_and_axes(stage) -> None:
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    scene = UsdPhysics.Scene(stage.GetPrimAtPath("/World/PhysicsScene"))
    assert scene.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)
    assert scene.GetGravityDirectionAttr().Get() == Gf.Vec3f(0, 0, -1)


def _read_splats(stage, lighting) -> Gaussians:
    stage.GetDefaultPrim().GetVariantSet("lighting").SetVariantSelection(variant_name(lighting))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Place/Splats"))
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
    rotations = [(q.real, *q.imaginary) for q in field.GetOrientationsAttr().Get()]
    harmonics = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    return Gaussians(
        np.array(field.GetPositionsAttr().Get()),
        np.array(rotations, np.float32),
        np.array(field.GetScalesAttr().Get()),
        harmonics * np.float32(0.28209479177387814) + np.float32(0.5),
        np.array(field.GetOpacitiesAttr().Get()),
    )


@pytest.mark.parametrize("lighting", LIGHTINGS)
def test_splats_come_back_exactly(stage, splats, lighting) -> None:
    read, written = _read_splats(stage, lighting), splats[lighting]
    for name in ("positions", "rotations", "scales", "opacity"):
        assert (getattr(read, name) == getattr(written, name)).all(), name
    assert np.abs(read.rgb - written.rgb).max() < 1e-6


def test_splats_are_drawn_as_those_of_the_ply(tmp_path, stage, splats) -> None:
    (tmp_path / "floor.ply").write_bytes(splats["night"].to_ply())
    pose = floor_views().camera_to_world[0]
    from_usd, from_ply = draw(_read_splats(stage, "night"), pose), draw(read_ply(tmp_path / "floor.ply"), pose)
    assert from_usd.std() > 10.0 and np.abs(from_usd - from_ply).max() <= 2.0


def test_three_lightings_share_the_geometry(tmp_path, world, splats, file) -> None:
    one = tmp_path / "one.usdz"
    _write(one, {"day": splats["day"]}, world)
    assert file.stat().st_size < 2.0 * one.stat().st_size


def test_splats_or_mesh_are_shown(stage) -> None:
    def shown() -> list[str]:
        prims = [stage.GetPrimAtPath(f"/World/Place/{name}") for name in ("Splats", "Mesh")]
        return [p.GetName() for p in prims if UsdGeom.Imageable(p).ComputeVisibility() == "inherited"]

    assert shown() == ["Splats"]
    stage.GetDefaultPrim().GetVariantSet("appearance").SetVariantSelection("mesh")
    assert shown() == ["Mesh"]
    color = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Place/Mesh")).GetDisplayColorAttr()
    assert np.array(color.Get()).max() == 0.0  # day
    stage.GetDefaultPrim().GetVariantSet("lighting").SetVariantSelection("night")
    assert np.array(color.Get()).min() > 0.0


def _pose(stage, path) -> np.ndarray:
    return np.array(UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(0)).T


def test_bodies_are_those_of_the_simulator(stage, world) -> None:
    model = world.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    data.qpos[7:] = 0.0
    mujoco.mj_kinematics(model, data)
    for name in ("base_link", *(f"{wheel}_wheel" for wheel in WHEELS)):
        body, prim = data.body(name), stage.GetPrimAtPath(f"/World/Husky/{name}")
        pose = _pose(stage, prim.GetPath())
        assert np.abs(pose[:3, 3] - body.xpos).max() < 1e-12
        assert np.abs(pose[:3, :3] - body.xmat.reshape(3, 3)).max() < 1e-12
        mass, own = UsdPhysics.MassAPI(prim), model.body(name)
        assert mass.GetMassAttr().Get() == np.float32(own.mass[0])
        assert np.array_equal(mass.GetCenterOfMassAttr().Get(), own.ipos.astype(np.float32))
        assert np.array_equal(mass.GetDiagonalInertiaAttr().Get(), own.inertia.astype(np.float32))
        axes = mass.GetPrincipalAxesAttr().Get()
        assert np.array_equal([axes.real, *axes.imaginary], own.iquat.astype(np.float32))


def test_joints_are_driven_axles(stage, world) -> None:
    model = world.model()
    for wheel in WHEELS:
        prim = stage.GetPrimAtPath(f"/World/Husky/Joints/{wheel}_wheel")
        joint, drive = UsdPhysics.RevoluteJoint(prim), UsdPhysics.DriveAPI(prim, "angular")
        base, link = (_pose(stage, r.GetTargets()[0]) for r in (joint.GetBody0Rel(), joint.GetBody1Rel()))
        anchor = base @ [*joint.GetLocalPos0Attr().Get(), 1.0]
        assert np.abs(anchor - link[:, 3]).max() < 1e-6 and joint.GetAxisAttr().Get() == "Y"
        motor = model.actuator("left" if "left" in wheel else "right")
        # Both wheels of a side together have the side's gain [N m s/rad] and torque.
        assert 2 * drive.GetDampingAttr().Get() * 180 / np.pi == pytest.approx(motor.gainprm[0], rel=1e-6)
        assert 2 * drive.GetMaxForceAttr().Get() == pytest.approx(motor.forcerange[1])
        assert prim.GetAttribute("physxJoint:armature").Get() == pytest.approx(
            model.joint(f"{wheel}_wheel").armature[0]
        )


def test_friction_is_that_of_the_tires(stage, world) -> None:
    paths = ["Husky/front_left_wheel/front_left_tyre", "Collision/Ground", "Collision/Parts/part_0000"]
    for path in paths:
        binding = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(f"/World/{path}"))
        material = UsdPhysics.MaterialAPI(binding.ComputeBoundMaterial("physics")[0].GetPrim())
        assert material.GetDynamicFrictionAttr().Get() == pytest.approx(world.robot.friction)


def test_collision_shapes(stage, world) -> None:
    ground = stage.GetPrimAtPath("/World/Collision/Ground")
    assert UsdPhysics.MeshCollisionAPI(ground).GetApproximationAttr().Get() == "none"
    parts = Parts.load(world.folder.parent / "4_mesh" / "parts.npz")
    prims = stage.GetPrimAtPath("/World/Collision/Parts").GetChildren()
    assert len(prims) == len(parts.vertices)
    for prim, vertices in zip(prims, parts.vertices, strict=True):
        assert UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "convexHull"
        assert (np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get()) == vertices).all()


def test_the_ground_has_mujocos_triangles(world) -> None:
    model = world.model()
    vertices, faces = ground_triangles(model)
    corners = vertices[faces].astype(np.float64)
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0.0).all()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(0)
    for corner in corners[rng.integers(0, len(corners), 200)]:
        point = rng.dirichlet([1, 1, 1]) @ corner
        distance = mujoco.mj_rayHfield(
            model, data, model.geom("ground").id, point + np.array([0, 0, 5.0]), np.array([0, 0, -1.0]), None
        )
        assert distance == pytest.approx(5.0, abs=1e-5)


def test_tires_are_hulls_of_64_vertices_on_the_tire(world) -> None:
    model = world.model()
    geom = model.geom("front_left_tyre").id
    vertices, faces = tire_hull(model, geom)
    radius, half, _ = model.geom_size[geom]
    assert len(vertices) == 64
    assert np.abs((vertices / [radius, half, radius]) ** 2 @ [1, 1, 1] - 1.0).max() < 1e-5
    corners = vertices[faces].astype(np.float64)
    assert (
        np.einsum("fi,fi->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(1))
        > 0
    ).all()
    edges = {tuple(e) for face in faces for e in zip(face, np.roll(face, -1), strict=True)}
    assert edges == {(b, a) for a, b in edges}  # closed


def test_the_camera_projects_as_ours_does(stage, world) -> None:
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Husky/base_link/front_native"))
    width, height = camera.GetPrim().GetCustomDataByKey("twin:resolution")
    assert (width, height) == world.camera.size
    pose = opencv_to_mujoco(_pose(stage, camera.GetPath()))  # back to OpenCV's axes
    model = world.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    mujoco.mj_forward(model, data)
    assert np.abs(pose[:3, 3] - data.camera("front_native").xpos).max() < 1e-9
    views = Viewpoints.of(pose, world.camera.intrinsics, world.camera.size)
    points = pose[:3, 3] + pose[:3, :3] @ [0, 0, 4.0] + np.random.default_rng(0).normal(0, 0.5, (20, 3))
    pixels, _ = project(points, pose, views.intrinsics[0])
    frustum = camera.GetCamera().frustum
    clip = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).T
    ndc = np.column_stack([points, np.ones(20)]) @ clip.T
    ndc = ndc[:, :2] / ndc[:, 3:]
    theirs = (ndc * [1, -1] + 1) / 2 * [width, height]
    assert np.abs(theirs - pixels).max() < 1e-2


def test_route_and_corridor_are_curves(stage, world) -> None:
    curve = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/Route/Centerline"))
    assert np.allclose(np.array(curve.GetPointsAttr().Get()), world.route, atol=1e-6)
    left = np.array(UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/Route/CorridorLeft")).GetPointsAttr().Get())
    assert np.allclose(np.linalg.norm((left - world.route)[:, :2], axis=1), world.half_width, atol=1e-5)
    assert np.allclose(_pose(stage, "/World/Route/Goal")[:3, 3], world.goal)
