"""What of a scene's MJCF an episode needs: the ground, the robot, and the solid parts the robot can get at.

An episode ends when the robot leaves the *corridor*, so parts beyond its *reach* never touch it; leaving them out
changes no number of the physics and saves a fifth of its time and most of its memory. The visual mesh goes, too, unless
MuJoCo itself is to draw the scene.
"""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from twin.mjcf.husky import add_dry
from twin.mjcf.world import World, point_at
from twin.types import Array

PAYLOAD = "payload"
"""Body on the top plate, without mass until an episode loads it."""

_REACH = 1.5  # [m] beyond the corridor's edge: the robot's half length, and what it drives in a control step
_ROUTE_STEP = 0.1  # [m]


def episode_spec(world: World, start: float, end: float, half_width: float, looks: bool = False) -> mujoco.MjSpec:
    """The scene for episodes between two arc lengths of its route.

    Args:
        world: The scene.
        start: Arc length from which is driven [m].
        end: Arc length to which is driven [m].
        half_width: Of the corridor [m].
        looks: Keep what only pictures made by MuJoCo need: visual mesh and textures.
    """
    tree = ElementTree.parse(world.model_path)
    root, assets = tree.getroot(), world.folder / "assets"
    line = cKDTree(point_at(world.route[:, :2], np.arange(start, end + _ROUTE_STEP, _ROUTE_STEP)))

    def wanted(geom: Element) -> bool:
        if geom.get("contype") == "0":
            return looks
        center, radius = _ball(assets / f"{geom.get('mesh')}.obj")
        return line.query(center[:2])[0] - radius <= half_width + _REACH

    # Taken out of the XML: a compiled MjSpec needs milliseconds for every part that it drops.
    scenery, kept = root.find("worldbody"), root.find("asset")
    assert scenery is not None and kept is not None
    for geom in [g for g in scenery.findall("geom") if g.get("type") == "mesh" and not wanted(g)]:
        scenery.remove(geom)
        kept.remove(next(m for m in kept.findall("mesh") if m.get("name") == geom.get("mesh")))
    if not looks:
        _strip_textures(root, kept)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(world.folder.resolve())
    base = spec.body(world.names["body"])
    payload = base.add_body(name=PAYLOAD, pos=world.robot.payload_position)
    payload.explicitinertial = True
    payload.mass, payload.ipos, payload.inertia = 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    add_dry(payload, PAYLOAD)
    return spec


def _ball(path: Path) -> tuple[Array, float]:
    """Centre and radius [m] of a ball around the vertices of an OBJ file."""
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
