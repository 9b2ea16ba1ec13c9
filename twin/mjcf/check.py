"""Whether an exported scene can be moved, and what the robot meets at its start.

*Built* is the model as the exporter compiled it; the *copy* is what plain MuJoCo makes of the written folder, moved.
"""

import shutil
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.mjcf.world import PART_GROUP, SCENE_XML

Array = NDArray[np.float64]

_STEPS = 200  # driven through for the comparison
_APART = 0.002  # [m] base of the built robot and of the copy's may come apart in them
_DIGITS = 1e-5  # and as a share of where they are, for XML keeps six digits of a number
_CLEARANCE_RANGE = 5.0  # [m] within which parts are looked for around the spawn


def check_portable(folder: Path, built: mujoco.MjModel) -> dict[str, Any]:
    """Loads a moved copy of the scene in plain MuJoCo; its robot must do there what the built one does.

    Args:
        folder: Holds the written scene.
        built: With a keyframe `spawn` where there is a robot.

    Returns:
        Metrics for the report. `spawn_drift_m` is how far the parked robot creeps in 0.4 s, which on a slope is what
        its tyres imply.

    Raises:
        RuntimeError: the copy is another model, or its robot moves otherwise: a bug of the exporter.
    """
    with tempfile.TemporaryDirectory(prefix="twin-moved-") as temporary:
        moved = Path(temporary) / "elsewhere"
        shutil.copytree(folder, moved)
        copy = mujoco.MjModel.from_xml_path(str(moved / SCENE_XML))
    metrics: dict[str, Any] = {
        "geoms": int(copy.ngeom),
        "xml_bytes": (folder / SCENE_XML).stat().st_size,
        "assets_bytes": sum(path.stat().st_size for path in (folder / "assets").iterdir()),
    }
    sizes = [(model.ngeom, model.nq, model.nu, model.nkey) for model in (built, copy)]
    if sizes[0] != sizes[1]:
        raise RuntimeError(f"the moved copy has {sizes[1]} geoms, coordinates, motors, keyframes; built: {sizes[0]}")
    if not built.nkey:
        return metrics
    data = _at_spawn(copy)
    metrics["spawn_clearance_m"] = spawn_clearance(copy, data)
    path, touched = _parked(copy, data)
    apart = float(np.linalg.norm(path - _parked(built, _at_spawn(built))[0], axis=1).max())
    if not apart <= _APART + _DIGITS * np.abs(path[0]).max():
        raise RuntimeError(f"the robot of the moved copy moves otherwise: {apart:.4f} m apart within {_STEPS} steps")
    drift = float(np.linalg.norm(path[-1] - path[0]))
    return metrics | {"spawn_touched": sorted(touched), "spawn_drift_m": drift}


def robot_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms belong to the robot, shape (ngeom,)."""
    return model.body_rootid[model.geom_bodyid] == model.body("base_link").id


def touched_names(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """Names of the geoms that the robot touches now, besides the ground."""
    pairs = data.contact.geom
    mine = robot_geoms(model)[pairs]
    other = pairs[mine[:, 0] != mine[:, 1]][~mine[mine[:, 0] != mine[:, 1]]]
    return {model.geom(int(i)).name for i in np.unique(other)} - {"ground"}


def spawn_clearance(model: mujoco.MjModel, data: mujoco.MjData) -> float | None:
    """Distance from the robot to the nearest convex part [m]; None where none is within 5 m."""
    robot = np.flatnonzero(robot_geoms(model) & (model.geom_contype > 0))
    parts = np.flatnonzero(model.geom_group == PART_GROUP)
    center = data.body("base_link").xpos
    near = parts[np.linalg.norm(data.geom_xpos[parts] - center, axis=1) < model.geom_rbound[parts] + _CLEARANCE_RANGE]
    distances = [
        mujoco.mj_geomDistance(model, data, int(a), int(b), _CLEARANCE_RANGE, None) for a in robot for b in near
    ]
    best = min(distances, default=_CLEARANCE_RANGE)
    return float(best) if best < _CLEARANCE_RANGE else None


def _at_spawn(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    mujoco.mj_forward(model, data)
    return data


def _parked(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, set[str]]:
    """Where the base of a robot left alone is after every step [m], shape (steps + 1, 3), and what it touched."""
    path, touched = [data.qpos[:3].copy()], touched_names(model, data)
    for _ in range(_STEPS):
        mujoco.mj_step(model, data)
        path.append(data.qpos[:3].copy())
        touched |= touched_names(model, data)
    return np.array(path), touched
