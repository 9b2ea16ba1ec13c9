"""The model of an episode: ground, robot, and the solid parts of the scene within the robot's reach.

An episode ends when the robot leaves the *corridor*, so parts beyond its reach are never touched. Removing them changes
no result and saves a fifth of the physics' time and most of its memory. The visual mesh is removed as well, unless
MuJoCo itself renders the scene.
"""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from twin.mjcf.husky import disable_fluid_drag
from twin.mjcf.world import World, point_at
from twin.types import Array

PAYLOAD = "payload"
"""Name of a body on the top plate; its mass is zero until an episode sets a payload."""

_REACH = 1.5  # [m] beyond the corridor's edge: the robot's half length plus its motion in a control step
_ROUTE_STEP = 0.1  # [m]


def episode_spec(world: World, start: float, end: float, half_width: float, visuals: bool = False) -> mujoco.MjSpec:
    """Returns the model of episodes between two arc lengths of a scene's route.

    Args:
        world: The scene.
        start: Arc length of the start [m].
        end: Arc length of the end [m].
        half_width: Half width of the corridor [m].
        visuals: Keep the visual mesh and textures, which only MuJoCo's renderer needs.
    """
    tree = ElementTree.parse(world.model_path)
    root, assets = tree.getroot(), world.folder / "assets"
    line = cKDTree(point_at(world.route[:, :2], np.arange(start, end + _ROUTE_STEP, _ROUTE_STEP)))

    def wanted(geom: Element) -> bool:
        if geom.get("contype") == "0":
            return visuals
        center, radius = _bounding_sphere(assets / f"{geom.get('mesh')}.obj")
        return line.query(center[:2])[0] - radius <= half_width + _REACH

    # Removed from the XML, as removing from a compiled MjSpec takes milliseconds per part.
    worldbody, kept = root.find("worldbody"), root.find("asset")
    assert worldbody is not None and kept is not None
    for geom in [g for g in worldbody.findall("geom") if g.get("type") == "mesh" and not wanted(g)]:
        worldbody.remove(geom)
        kept.remove(next(m for m in kept.findall("mesh") if m.get("name") == geom.get("mesh")))
    if not visuals:
        _strip_textures(root, kept)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(world.folder.resolve())
    base = spec.body(world.names["body"])
    payload = base.add_body(name=PAYLOAD, pos=world.robot.payload_position)
    payload.explicitinertial = True
    payload.mass, payload.ipos, payload.inertia = 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    disable_fluid_drag(payload, PAYLOAD)
    return spec


def _bounding_sphere(path: Path) -> tuple[Array, float]:
    """Center and radius [m] of a sphere around the vertices of an OBJ file."""
    lines = path.read_text(encoding="ascii").splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    center = (vertices.min(0) + vertices.max(0)) / 2
    return center, float(np.linalg.norm(vertices - center, axis=1).max())


def _strip_textures(root: Element, assets: Element) -> None:
    textured = {m.get("name") for m in assets.findall("material") if m.get("texture") or m.find("layer") is not None}
    for geom in root.iter("geom"):
        if geom.get("material") in textured:
            del geom.attrib["material"]
    for asset in list(assets):
        if asset.tag == "texture" or (asset.tag == "material" and asset.get("name") in textured):
            assets.remove(asset)
