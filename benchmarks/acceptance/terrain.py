"""Rows E (ground as a build reconstructs it) and P (convex parts)."""

import math
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from acceptance import Row, Subject
from acceptance.drives import Recording, drive, on_ground, on_plane
from acceptance.grounds import level, random_relief, reconstructed, roughness
from twin.assets.ground import Ground
from twin.robot import WHEEL_RADIUS
from twin.types import Array


def flat_ground(subject: Subject) -> list[Row]:
    """E1 and E2: jolt, chi and power on a level height field and on a flat road reconstructed from noisy data."""
    rows = []
    turn, straight = subject.turn(), drive(subject.plane(), 1.0, 0.0, 1.0, 1.0, subject.params)
    for label, ground in (
        ("level field", level()),
        ("flat road reconstructed", reconstructed(np.random.default_rng(0))),
    ):
        model = on_ground(ground, subject.params, subject.edit, start=(-5.0, 0.37, 0.1))
        run = drive(model, 1.0, 0.0, 1.0, 5.0, subject.params)
        arc = drive(model, 0.5, 0.5, 1.5, 2.0, subject.params)
        spot = drive(model, 0.0, 1.0, 1.5, 1.5, subject.params)
        pitching = math.degrees(_rms(run.per_frame(run.pose[:, 4])))
        extra, extra_straight = spot.power.mean() - turn.power.mean(), run.power.mean() - straight.power.mean()
        ratio = float(spot.power.mean() / turn.power.mean())
        rows += [
            Row("E1", f"{label}: jolt straight, 1 m/s", run.jolt, 0.0, 1.0, "m/s²"),
            Row("E1", f"{label}: jolt on R = 1 m", arc.jolt, 0.0, 1.0, "m/s²"),
            Row("E1", f"{label}: jolt turning at 1 rad/s", spot.jolt, 0.0, 1.0, "m/s²"),
            Row("E1", f"{label}: change of z per frame", 1000 * _rms(run.per_frame(run.camera_z)), 0.0, 0.3, "mm rms"),
            Row("E1", f"{label}: change of pitch per frame", pitching, 0.0, 0.05, "° rms"),
            Row("E2", f"{label}: chi / plane's", spot.chi / turn.chi, 0.95, 1.05),
            Row("E2", f"{label}: turning power / plane's", ratio, 0.95, 1.05),
            Row("E2", f"{label}: turning power − plane's", float(extra), -math.inf, 10.0, "W"),
            Row("E2", f"{label}: power driving straight − plane's", float(extra_straight), -math.inf, 10.0, "W"),
        ]
    return rows


def reconstructed_ground(subject: Subject) -> list[Row]:
    """E3: chi on the roughest road that the pipeline produces, fitted to bumps of 3 cm rms and 0.5 m kernel width."""
    rng = np.random.default_rng(1)
    ground = reconstructed(rng, random_relief(0.03, 0.5, rng))
    return chi_on(subject, ground, (-4.0, 0.0, 0.1), np.array([[-7.0, 0.0], [7.0, 0.0]]), "reconstructed bumps")


def chi_on(subject: Subject, ground: Ground, start: tuple[float, float, float], line: Array, label: str) -> list[Row]:
    """E3 on any ground, starting at x, y [m] and yaw [rad]; the roughness is measured along `line` (m, ≥2) [m]."""
    rms, length = roughness(ground, line)
    model = on_ground(ground, subject.params, subject.edit, start)
    turn = drive(model, 0.0, 1.0, 1.5, 2.0 * math.pi, subject.params)
    quantity = f"chi on {label} (rms {1000 * rms:.1f} mm, correlation length {length:.2f} m)"
    return [Row("E3", quantity, turn.chi, 1.6, 2.3)]


def halved_step(subject: Subject) -> list[Row]:
    """E4: change of chi and power with half the time step, on a plane, and on a height field over a whole turn."""

    def halve(spec: mujoco.MjSpec) -> None:
        if subject.edit is not None:
            subject.edit(spec)
        spec.option.timestep /= 2

    def turns(of: Subject) -> dict[str, Recording]:
        field = on_ground(level(), of.params, of.edit)
        return {"plane": of.turn(), "height field": drive(field, 0.0, 1.0, 1.5, 2.0 * math.pi, of.params)}

    rows = []
    fine = turns(replace(subject, edit=halve))
    for label, coarse in turns(subject).items():
        chi, power = fine[label].chi / coarse.chi, float(fine[label].power.mean() / coarse.power.mean())
        rows += [
            Row("E4", f"{label}: change of chi with half the step", 100 * abs(chi - 1), 0.0, 1.0, "%"),
            Row("E4", f"{label}: change of power", 100 * abs(power - 1), 0.0, 1.0, "%"),
        ]
    return rows


def plates(subject: Subject) -> list[Row]:
    """P1: jolt and drift over flush convex parts, 0.3 m long, with seams across and along the path."""

    def lay(spec: mujoco.MjSpec) -> None:
        if subject.edit is not None:
            subject.edit(spec)
        for i in range(30):
            for j, y in enumerate((-1.0, 0.2)):
                _convex(spec, f"part_{i:02d}_{j}", _box((-1.0 + 0.3 * i, y, -0.2), (0.3, 1.2, 0.2)))
        spec.geom("ground").pos = (0.0, 0.0, -0.2)

    model = on_plane(subject.params, lay)
    run = drive(model, 1.0, 0.0, 1.0, 5.0, subject.params)
    arc = drive(model, 0.5, 0.5, 1.0, 2.0, subject.params)
    return [
        Row("P1", "jolt over flush plates, 1 m/s", run.jolt, 0.0, 1.0, "m/s²"),
        Row("P1", "jolt over flush plates on R = 1 m", arc.jolt, 0.0, 1.0, "m/s²"),
        Row("P1", "sideways after 5 m", 100 * abs(float(np.ptp(run.pose[:, 1]))), 0.0, 5.0, "cm"),
    ]


def ramp(subject: Subject) -> list[Row]:
    """P2: climbing a wedge of 10° to a platform of 0.35 m; both are convex meshes, like curbs and ramps of a build."""
    height, run_up = 0.35, 0.35 / math.tan(math.radians(10.0))

    def put(spec: mujoco.MjSpec) -> None:
        if subject.edit is not None:
            subject.edit(spec)
        side = ((1.0, 0.0), (1.0 + run_up, 0.0), (1.0 + run_up, height))
        _convex(spec, "part_wedge", np.array([[x, y, z] for y in (-1.0, 1.0) for x, z in side]))
        _convex(spec, "part_platform", _box((1.0 + run_up, -1.0, 0.0), (3.0, 2.0, height)))

    up = drive(on_plane(subject.params, put), 0.5, 0.0, 0.1, 8.0, subject.params)
    climbing = np.degrees(up.pose[:, 4])
    at_top = up.pose[-1, 2] - up.pose[0, 2]
    speed = np.linalg.norm(np.gradient(up.pose[:, :3], up.timestep, axis=0), axis=1)
    on_ramp = (climbing < -9.5) & (climbing > -10.5)
    return [
        Row("P2", "rise on a ramp of 10° and a platform of 0.35 m", float(at_top), 0.34, 0.36, "m"),
        Row("P2", "speed on the ramp / wheel speed", float(speed[on_ramp].mean() / _rolled(up, on_ramp)), 0.95, 1.0),
        Row("P2", "sideways", 100 * abs(float(np.ptp(up.pose[:, 1]))), 0.0, 5.0, "cm"),
    ]


def _rolled(run: Recording, chosen: NDArray[np.bool_]) -> float:
    """Mean speed of the wheels' circumference [m/s] over the chosen steps."""
    return float(run.wheel[chosen].mean()) * WHEEL_RADIUS


def _box(corner: tuple[float, float, float], size: tuple[float, float, float]) -> Array:
    """Corners (8, 3) of an axis-aligned box, given its low corner and size [m]."""
    return np.array(corner) + np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3) * np.array(size)


def _convex(spec: mujoco.MjSpec, name: str, vertices: Array) -> None:
    mesh = spec.add_mesh(name=name)
    mesh.uservert = vertices.ravel()
    spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))
