"""USD file of a built scene (splats, collision, robot), for Isaac Sim and other programs that read UsdPhysics.

    /World                      variant sets `lighting` (colors) and `appearance` (splats, or the mesh)
        Place/Splats            ParticleField3DGaussianSplat
        Place/Mesh              the visual mesh with colors per vertex, for programs that draw no splats
        Collision/Ground        the simulator's height field, as triangles
        Collision/Parts/...     convex parts, fixed
        Materials/...           friction
        Husky                   articulation: base_link, four wheels, Joints/<wheel>
        Route/...               route, corridor, goal
        Sun, Sky, PhysicsScene

Meters, kilograms, z up. Bodies, masses, joints, shapes and cameras are read from the compiled MuJoCo model, so they are
those of the simulation. In MuJoCo, a belt couples the wheels of a side. UsdPhysics has no belt, so each wheel has a
drive with half of the side's gain and torque. Splats emit light; sun and sky light the robot and added objects.
"""

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdShade, UsdUtils, UsdVol, Vt
from scipy.spatial import ConvexHull

from twin.assets.gaussians import SH_CONSTANT, Gaussians
from twin.assets.ground import lattice_faces
from twin.errors import InputError
from twin.files import atomic_path
from twin.geometry.polyline import corridor_edges
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import World
from twin.robot import WHEELS, HuskyParams
from twin.types import Array

_DOUBLE = UsdGeom.XformOp.PrecisionDouble
_APERTURE = 20.955  # [tenths of a meter] width of a camera's sensor; only its ratio to the focal length has an effect
_CLIPPING = 0.01, 1000.0  # [m] nearest and farthest depth that cameras show
# Numbers of a tire's vertices around its middle and around each shoulder; distance of a shoulder from the middle / half
# width of the tire.
_RING, _SHOULDER, _SHOULDER_OFFSET = 32, 16, 0.6
_CURVE_WIDTH, _GOAL_RADIUS = 0.05, 0.2  # [m]
_SUN_INTENSITY, _SKY_INTENSITY = 1500.0, 600.0  # [nit]
_SPLAT_EXTENT = 3.0  # [standard deviations of a splat] half size of its bounding box


def write_usd(
    path: Path,
    splats: Mapping[str, Gaussians],
    mesh: tuple[NDArray, NDArray],
    colors: Mapping[str, NDArray[np.uint8]],
    parts: Parts,
    model: mujoco.MjModel,
    world: World | None,
    selected: str,
) -> None:
    """Writes a `.usdz`, or a binary `.usd` or `.usdc`.

    Args:
        path: The file; its suffix selects the format.
        splats: Splats by lighting; they differ only in `rgb`.
        mesh: Vertices (v, 3) [m] and faces (f, 3) of the visual mesh.
        colors: Colors of the mesh's vertices by lighting, shape (v, 3).
        parts: Convex parts.
        model: The compiled scene.
        world: Route and robot; None for a scene without them.
        selected: The lighting that is selected in the file.

    Raises:
        InputError: two lightings would have the same name.
    """
    if len({variant_name(name) for name in splats}) < len(splats):
        raise InputError(f"two of the lightings {', '.join(splats)} have the same name in USD; rename one")
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".twin-usd-") as folder:
        layer = Path(folder) / "place.usdc"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/World").GetPrim()
        stage.SetDefaultPrim(root)
        root.SetMetadata("kind", "assembly")
        root.SetDocumentation("Made by twin export --usd. Meters, kilograms, z up.")
        _add_place(stage, splats, mesh, colors, selected)
        _add_physics(stage, model)
        robot = world.robot if world else HuskyParams()
        tires, bare = (
            _friction(stage, f"/World/Materials/{name}", value)
            # In MuJoCo, a wheel's contacts have the wheel's friction. Programs that average the friction of two
            # surfaces, as PhysX does, get the same value if the ground has it, too.
            for name, value in (("TiresAndGround", robot.friction), ("Chassis", 1.0))
        )
        _add_collision(stage, model, parts, tires)
        if world:
            _add_route(stage, world)
            _add_robot(stage, model, tires, bare)
        _add_lights(stage, model)
        stage.GetRootLayer().Save()
        del stage
        with atomic_path(path) as partial:
            if path.suffix.lower() == ".usdz":
                if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(partial)):
                    raise RuntimeError(f"{path}: USD could not write the package")  # pragma: no cover
            else:
                shutil.copyfile(layer, partial)


# ---- the place


def variant_name(lighting: str) -> str:
    """The name of a lighting's variant: the lighting's name, with _ for characters that USD does not allow."""
    return "".join(c if c.isalnum() or c in "_-|" else "_" for c in lighting)


def _add_place(
    stage: Any,
    splats: Mapping[str, Gaussians],
    mesh: tuple[NDArray, NDArray],
    colors: Mapping[str, NDArray[np.uint8]],
    selected: str,
) -> None:
    UsdGeom.Xform.Define(stage, "/World/Place")
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Place/Splats")
    one = splats[selected]
    field.CreatePositionsAttr(_vectors(one.positions))
    field.CreateScalesAttr(_vectors(one.scales))
    # USD's quaternions have the real part last in memory.
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(one.rotations[:, [1, 2, 3, 0]])))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(np.ascontiguousarray(one.opacity)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    margin = _SPLAT_EXTENT * one.scales.max(1, keepdims=True)
    low, high = (one.positions - margin).min(0), (one.positions + margin).max(0)
    field.CreateExtentAttr([Gf.Vec3f(*map(float, low)), Gf.Vec3f(*map(float, high))])
    surface = _mesh(stage, "/World/Place/Mesh", *mesh)
    root = stage.GetDefaultPrim()
    lightings = root.GetVariantSets().AddVariantSet("lighting")
    for name, these in splats.items():
        lightings.AddVariant(variant_name(name))
        lightings.SetVariantSelection(variant_name(name))
        with lightings.GetVariantEditContext():
            harmonics = (these.rgb - np.float32(0.5)) / np.float32(SH_CONSTANT)
            field.CreateRadianceSphericalHarmonicsCoefficientsAttr(_vectors(harmonics))
            tint = UsdGeom.PrimvarsAPI(surface).CreatePrimvar(
                "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
            )
            tint.Set(_vectors(_linear(colors[name] / np.float32(255.0))))
    lightings.SetVariantSelection(variant_name(selected))
    appearance = root.GetVariantSets().AddVariantSet("appearance")
    for shown, hidden in (("splats", surface), ("mesh", field)):
        appearance.AddVariant(shown)
        appearance.SetVariantSelection(shown)
        with appearance.GetVariantEditContext():
            UsdGeom.Imageable(hidden).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    appearance.SetVariantSelection("splats")


def _add_lights(stage: Any, model: mujoco.MjModel) -> None:
    for i in np.flatnonzero(model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL):
        sun = UsdLux.DistantLight.Define(stage, "/World/Sun")
        sun.CreateIntensityAttr(_SUN_INTENSITY)
        sun.CreateAngleAttr(0.53)
        turn = Gf.Rotation(Gf.Vec3d(0, 0, -1), Gf.Vec3d(*map(float, model.light_dir[i]))).GetQuat()
        sun.AddOrientOp(precision=_DOUBLE).Set(turn)
    sky = UsdLux.DomeLight.Define(stage, "/World/Sky")
    sky.CreateIntensityAttr(_SKY_INTENSITY)
    sky.CreateColorAttr(Gf.Vec3f(0.86, 0.89, 0.92))


# ---- physics


def _add_physics(stage: Any, model: mujoco.MjModel) -> None:
    gravity = np.asarray(model.opt.gravity)
    size = float(np.linalg.norm(gravity))
    scene = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(*map(float, gravity / size if size else [0, 0, -1])))
    scene.CreateGravityMagnitudeAttr(size)
    UsdGeom.Scope.Define(stage, "/World/Materials")


def _friction(stage: Any, path: str, value: float) -> Any:
    """A material for collisions only, with one value for static and dynamic friction."""
    material = UsdShade.Material.Define(stage, path)
    physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr(value)
    physics.CreateDynamicFrictionAttr(value)
    physics.CreateRestitutionAttr(0.0)
    return material


def _collide(prim: Any, material: Any, approximation: str | None = None) -> None:
    """Makes a prim a collider; `approximation` is USD's name for the approximation of a mesh."""
    UsdPhysics.CollisionAPI.Apply(prim)
    if approximation:
        UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(approximation)
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, materialPurpose="physics")


def _add_collision(stage: Any, model: mujoco.MjModel, parts: Parts, material: Any) -> None:
    group = UsdGeom.Xform.Define(stage, "/World/Collision")
    group.CreatePurposeAttr(UsdGeom.Tokens.guide)  # not drawn in pictures
    ground = _mesh(stage, "/World/Collision/Ground", *ground_triangles(model))
    _collide(ground.GetPrim(), material, "none")
    UsdGeom.Xform.Define(stage, "/World/Collision/Parts")
    for i, (vertices, faces) in enumerate(zip(parts.vertices, parts.faces, strict=True)):
        part = _mesh(stage, f"/World/Collision/Parts/part_{i:04d}", vertices, faces)
        _collide(part.GetPrim(), material, "convexHull")


def ground_triangles(model: mujoco.MjModel) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The height field `ground`, triangulated as MuJoCo does: vertices (v, 3) [m] and faces (f, 3), facing up."""
    geom = model.geom("ground")
    field = int(geom.dataid[0])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, top, _ = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    height = model.hfield_data[start : start + rows * columns] * top
    y, x = np.meshgrid(np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), height], -1) + geom.pos
    return vertices.astype(np.float32), lattice_faces(rows, columns).astype(np.int32)


def _add_robot(stage: Any, model: mujoco.MjModel, tires: Any, bare: Any) -> None:
    """Adds the Husky at rest at the start of the route."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    wheels = [f"{name}_wheel" for name in WHEELS]
    for name in wheels:
        data.joint(name).qpos[0] = 0.0
    mujoco.mj_kinematics(model, data)
    husky = UsdGeom.Xform.Define(stage, "/World/Husky").GetPrim()
    husky.SetMetadata("kind", "component")
    UsdPhysics.ArticulationRootAPI.Apply(husky)
    for name in ("base_link", *wheels):
        body = model.body(name)
        link = UsdGeom.Xform.Define(stage, f"/World/Husky/{name}")
        _place(link, data.body(name).xpos, data.body(name).xquat)
        UsdPhysics.RigidBodyAPI.Apply(link.GetPrim())
        mass = UsdPhysics.MassAPI.Apply(link.GetPrim())
        mass.CreateMassAttr(float(body.mass[0]))
        mass.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, body.ipos)))
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, body.inertia)))
        mass.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, body.iquat)))
        for geom in np.flatnonzero(model.geom_bodyid == body.id):
            _add_geom(stage, f"/World/Husky/{name}", model, int(geom), tires if name in wheels else bare)
    for camera in np.flatnonzero(model.cam_bodyid == model.body("base_link").id):
        _add_camera(stage, "/World/Husky/base_link", model, int(camera))
    UsdGeom.Scope.Define(stage, "/World/Husky/Joints")
    for name in wheels:
        joint = UsdPhysics.RevoluteJoint.Define(stage, f"/World/Husky/Joints/{name}")
        joint.CreateBody0Rel().SetTargets([Sdf.Path("/World/Husky/base_link")])
        joint.CreateBody1Rel().SetTargets([Sdf.Path(f"/World/Husky/{name}")])
        joint.CreateAxisAttr(UsdPhysics.Tokens.y)
        joint.CreateLocalPos0Attr(Gf.Vec3f(*map(float, model.body(name).pos)))
        joint.CreateLocalPos1Attr(Gf.Vec3f(0.0))
        joint.CreateLocalRot0Attr(Gf.Quatf(1.0))
        joint.CreateLocalRot1Attr(Gf.Quatf(1.0))
        motor = model.actuator("left" if "left" in name else "right")
        drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "angular")
        drive.CreateTypeAttr(UsdPhysics.Tokens.force)
        drive.CreateTargetVelocityAttr(0.0)  # [°/s]
        drive.CreateStiffnessAttr(0.0)
        drive.CreateDampingAttr(float(motor.gainprm[0]) / 2 * np.pi / 180)  # [N m s/°]
        drive.CreateMaxForceAttr(float(motor.forcerange[1]) / 2)  # [N m]
        # An attribute that only PhysX has: the inertia of motor and gear at the wheel.
        joint.GetPrim().AddAppliedSchema("PhysxJointAPI")
        armature = joint.GetPrim().CreateAttribute("physxJoint:armature", Sdf.ValueTypeNames.Float, custom=False)
        armature.Set(float(model.joint(name).armature[0]))


def _add_geom(stage: Any, parent: str, model: mujoco.MjModel, index: int, material: Any) -> None:
    """Adds a geom to its link: a collider as a guide (not drawn), a visual geom in its color. Others are left out."""
    geom = model.geom(index)
    collides = bool(model.geom_contype[index] or model.geom_conaffinity[index])
    if not collides and model.geom_group[index] != 1:
        return
    path = f"{parent}/{geom.name or f'visual_{index}'}"
    kind, (a, b, c) = mujoco.mjtGeom(int(model.geom_type[index])), (float(x) for x in geom.size)
    shape: Any
    scale = None
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape, scale = UsdGeom.Cube.Define(stage, path), (2 * a, 2 * b, 2 * c)
        shape.CreateSizeAttr(1.0)
        shape.CreateExtentAttr(_vectors(np.array([[-0.5] * 3, [0.5] * 3])))
    elif collides:
        assert kind in (mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER)
        shape = _mesh(stage, path, *tire_hull(model, index))
    elif kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        has_caps = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
        shape = (UsdGeom.Capsule if has_caps else UsdGeom.Cylinder).Define(stage, path)
        shape.CreateAxisAttr(UsdGeom.Tokens.z)
        shape.CreateRadiusAttr(a)
        shape.CreateHeightAttr(2 * b)
        top = [a, a, b + a * has_caps]
        shape.CreateExtentAttr(_vectors(np.array([[-x for x in top], top])))
    else:
        assert kind == mujoco.mjtGeom.mjGEOM_MESH, f"{path}: {kind}"
        number = int(model.geom_dataid[index])
        v, nv = int(model.mesh_vertadr[number]), int(model.mesh_vertnum[number])
        f, nf = int(model.mesh_faceadr[number]), int(model.mesh_facenum[number])
        shape = _mesh(stage, path, model.mesh_vert[v : v + nv], model.mesh_face[f : f + nf])
    if not (collides and kind != mujoco.mjtGeom.mjGEOM_BOX):  # a tire's hull is already in its wheel's frame
        _place(shape, geom.pos, geom.quat, scale)
    if collides:
        shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
        _collide(shape.GetPrim(), material, None if kind == mujoco.mjtGeom.mjGEOM_BOX else "convexHull")
    else:
        rgba = model.mat_rgba[model.geom_matid[index]] if model.geom_matid[index] >= 0 else model.geom_rgba[index]
        shape.CreateDisplayColorAttr(Vt.Vec3fArray.FromNumpy(_linear(rgba[None, :3].astype(np.float32))))


def tire_hull(model: mujoco.MjModel, geom: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """A tire (ellipsoid or cylinder about the wheel's y axis) as a convex hull: vertices (64, 3) [m], faces (f, 3).

    PhysX allows at most 64 vertices per hull on a GPU.
    """
    size = model.geom_size[geom]
    ellipsoid = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    radius, half = float(size[0]), float(size[1])
    if ellipsoid:
        at = _SHOULDER_OFFSET
        rings = [(_RING, 0.0, radius)] + [
            (_SHOULDER, side * at * half, radius * np.sqrt(1 - at * at)) for side in (-1, 1)
        ]
    else:
        rings = [(_RING, side * half, radius) for side in (-1.0, 1.0)]
    vertices = np.concatenate(
        [
            np.stack([r * np.cos(angle), np.full(n, y), r * np.sin(angle)], 1)
            for n, y, r in rings
            for angle in [np.arange(n) * 2 * np.pi / n]
        ]
    )
    hull = ConvexHull(vertices)
    faces = hull.simplices
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normal * hull.equations[:, :3]).sum(1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return vertices.astype(np.float32), faces.astype(np.int32)


def _add_camera(stage: Any, parent: str, model: mujoco.MjModel, index: int) -> None:
    """Adds a camera at its pose on the robot; cameras have the same axes in USD and MuJoCo."""
    camera = model.camera(index)
    width, height = (int(x) for x in model.cam_resolution[index])
    sensor, (fx, fy, right, up) = model.cam_sensorsize[index], model.cam_intrinsic[index]
    scale = _APERTURE / float(sensor[0])
    out = UsdGeom.Camera.Define(stage, f"{parent}/{camera.name}")
    _place(out, camera.pos, camera.quat)
    out.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    out.CreateFocalLengthAttr(float(fx) * scale)
    out.CreateHorizontalApertureAttr(_APERTURE)
    # A USD camera has one focal length. So if pixels are not square, the height of the sensor is scaled.
    stretch = scale * float(fx / fy)
    out.CreateVerticalApertureAttr(float(sensor[1]) * stretch)
    # MuJoCo's offset of the principal point from the center is positive to the left and up. USD's is the offset of the
    # sensor from the optical axis, positive to the right and up.
    out.CreateHorizontalApertureOffsetAttr(float(right) * scale)
    out.CreateVerticalApertureOffsetAttr(-float(up) * stretch)
    out.CreateClippingRangeAttr(Gf.Vec2f(*_CLIPPING))
    out.GetPrim().SetCustomDataByKey("twin:resolution", Gf.Vec2i(width, height))


def _add_route(stage: Any, world: World) -> None:
    group = UsdGeom.Xform.Define(stage, "/World/Route")
    group.CreatePurposeAttr(UsdGeom.Tokens.guide)
    left, right = corridor_edges(world.route, world.half_width)
    for name, line, color in (
        ("Centerline", world.route, (0.1, 0.8, 0.2)),
        ("CorridorLeft", left, (0.9, 0.9, 0.2)),
        ("CorridorRight", right, (0.9, 0.9, 0.2)),
    ):
        curve = UsdGeom.BasisCurves.Define(stage, f"/World/Route/{name}")
        curve.CreateTypeAttr(UsdGeom.Tokens.linear)
        curve.CreatePointsAttr(_vectors(line))
        curve.CreateCurveVertexCountsAttr([len(line)])
        curve.CreateWidthsAttr([_CURVE_WIDTH])
        curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        curve.CreateDisplayColorAttr([Gf.Vec3f(*color)])
        margin = _CURVE_WIDTH / 2
        curve.CreateExtentAttr(_vectors(np.array([line.min(0) - margin, line.max(0) + margin])))
    goal = UsdGeom.Sphere.Define(stage, "/World/Route/Goal")
    goal.CreateRadiusAttr(_GOAL_RADIUS)
    goal.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(-_GOAL_RADIUS), Gf.Vec3f(_GOAL_RADIUS)]))
    goal.CreateDisplayColorAttr([Gf.Vec3f(0.9, 0.1, 0.1)])
    _place(goal, world.goal, (1.0, 0.0, 0.0, 0.0))


# ---- helpers


def _mesh(stage: Any, path: str, vertices: NDArray, faces: NDArray) -> Any:
    """A triangle mesh, counter-clockwise seen from outside."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(_vectors(vertices))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(_vectors(np.array([vertices.min(0), vertices.max(0)])))
    return mesh


def _place(prim: Any, position: Any, quaternion: Any, scale: Any = None) -> None:
    """Sets the pose of a prim in its parent: position [m], quaternion (w, x, y, z)."""
    prim.AddTranslateOp(precision=_DOUBLE).Set(Gf.Vec3d(*map(float, position)))
    prim.AddOrientOp(precision=_DOUBLE).Set(Gf.Quatd(*map(float, quaternion)))
    if scale is not None:
        prim.AddScaleOp(precision=_DOUBLE).Set(Gf.Vec3d(*map(float, scale)))


def _vectors(array: NDArray | Array) -> Any:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(array, np.float32))


def _linear(srgb: NDArray) -> NDArray[np.float32]:
    """Linear colors from sRGB in [0, 1]; USD's display colors are linear."""
    srgb = np.asarray(srgb, np.float32)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
