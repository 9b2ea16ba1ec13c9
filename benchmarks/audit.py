"""Audit of a scene for flaws of physics or task rules that a learning policy could exploit.

Two *explorers* drive the robot. The *random* one follows a random walk. The *greedy* one takes short cuts to the goal
in episodes, and rams convex parts of the collision geometry at full speed while roaming. *Episodes* end by the task's
rules; *roaming* has no task, so the robot can push against walls, slide along them and climb them for long.

*Tunnelling*: the robot penetrates a part deeper than `_TUNNEL_DEPTH`. *Climbing*: the base is more than `_CLIMB_HEIGHT`
above its standing height. *Wall sliding*: the robot touches a part and moves faster than `_SLIDE_SPEED`, which is
legitimate while roaming and a flaw of the rules in an episode. *Gap*: a vertex of the visual mesh is inside the robot's
body without a contact. A *false success* is an episode that reached its goal after any of these events.
"""

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from twin.env.env_factory import EnvFactory, episode_spec
from twin.env.obstacles import ground_height
from twin.env.physics import HuskyPhysics
from twin.env.route_segments import RouteSegment
from twin.env.task import control
from twin.geometry.polyline import nearest_on_route, point_at
from twin.geometry.poses import wrap_angle
from twin.mjcf.world import PART_GROUP, World
from twin.robot import BASE_HEIGHT
from twin.runtime import bar
from twin.types import Array

EVENTS = ("tunnelling", "climbing", "wall_sliding", "gap")

_TUNNEL_DEPTH = 0.05  # [m]
_CLIMB_HEIGHT = 0.08  # [m]
_SLIDE_SPEED = 0.2  # [m/s]
_BODY = ((-0.40, 0.40), (-0.22, 0.22), (0.02, 0.20))  # [m] x, y, z in the base frame, inside its hulls
_ROAM_WIDTH = 6.0  # [m] the robot roams at most this far from the route
_ROAM_TIME = 20.0  # [s] after which the robot is moved to a random pose
_CONTROL_PERIOD = 0.1  # [s]
_PUSH_STEPS, _BACK_STEPS = 60, 15  # control steps towards a part, and away from it


@dataclass
class Findings:
    """Results of an audit."""

    seconds: float = 0.0
    """Simulated time."""
    episodes: Counter = field(default_factory=Counter)
    """Number of episodes by cause of termination."""
    touching: int = 0
    """Number of control steps with a contact."""
    events: Counter = field(default_factory=Counter)
    """Number of control steps with an event, by its name; in episodes the name has the prefix `episode_`."""
    places: dict[str, list[list[float]]] = field(default_factory=dict)
    """x, y [m] of the first 20 occurrences of each event."""
    false_successes: int = 0
    wall_seconds: float = 0.0

    def note(self, name: str, xy: Array) -> None:
        """Counts an event and keeps its x, y [m]."""
        self.events[name] += 1
        if len(self.places.setdefault(name, [])) < 20:
            self.places[name].append([round(float(v), 2) for v in xy])

    def summary(self) -> dict[str, Any]:
        """Results as a JSON object."""
        names = [*(f"episode_{name}" for name in EVENTS), *EVENTS]
        return {
            "simulated_s": round(self.seconds, 1),
            "wall_s": round(self.wall_seconds, 1),
            "episodes": dict(sorted(self.episodes.items())),
            "steps_touching": self.touching,
            "steps_with": {name: self.events[name] for name in names},
            "false_successes": self.false_successes,
            "places": self.places,
        }


def audit(factory: EnvFactory, hours: float = 1.0) -> Findings:
    """Drives for `hours` of simulated time, half in episodes and half roaming, each half with both explorers."""
    findings, begin = Findings(), time.perf_counter()
    visual_mesh = VisualMesh(factory.world)
    seconds = hours * 3600.0 / 4.0
    with bar("audit", round(4 * seconds), "s") as progress:
        for greedy in (False, True):
            rng = np.random.default_rng([0, greedy])
            _episodes(factory, findings, visual_mesh, greedy, seconds, rng, progress)
            _roam(factory, findings, visual_mesh, greedy, seconds, rng, progress)
    findings.wall_seconds = time.perf_counter() - begin
    return findings


class VisualMesh:
    """Vertices of the visual mesh."""

    def __init__(self, world: World) -> None:
        spec = mujoco.MjSpec.from_file(str(world.model_path))
        visual = next((mesh for mesh in spec.meshes if mesh.name == "visual"), None)
        self._points = np.zeros((0, 3))
        if visual is not None:
            lines = (world.folder / "assets" / visual.file).read_text(encoding="ascii").splitlines()
            self._points = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
        self._tree = cKDTree(self._points[:, :2]) if len(self._points) else None

    def inside(self, base_to_world: Array) -> bool:
        """True if a vertex is inside the robot's body at a pose (4, 4)."""
        if self._tree is None:
            return False
        near = self._tree.query_ball_point(base_to_world[:2, 3], 0.5)
        local = (self._points[near] - base_to_world[:3, 3]) @ base_to_world[:3, :3]
        low, high = np.array(_BODY).T
        return bool(((local > low) & (local < high)).all(1).any())


class EventDetector:
    """Detects the events of a control step."""

    def __init__(self, physics: HuskyPhysics, visual_mesh: VisualMesh) -> None:
        self._physics, self._visual_mesh = physics, visual_mesh
        model = physics.model
        body = model.body("base_link").id
        self._robot = model.body_rootid[model.geom_bodyid] == body
        self._solid = ~self._robot & (np.arange(model.ngeom) != model.geom("ground").id)

    def events(self) -> list[str]:
        """Names of the events at the current state."""
        physics, found = self._physics, []
        contact = physics.data.contact
        pairs = contact.geom
        hit = (self._robot[pairs[:, ::-1]] & self._solid[pairs]).any(1) if len(pairs) else np.zeros(0, bool)
        if hit.any() and contact.dist[hit].min() < -_TUNNEL_DEPTH:
            found.append("tunnelling")
        base = physics.base_to_world
        ground = ground_height(physics.model, base[0, 3], base[1, 3])
        if base[2, 3] - ground > BASE_HEIGHT + _CLIMB_HEIGHT:
            found.append("climbing")
        if hit.any() and abs(physics.speed) > _SLIDE_SPEED:
            found.append("wall_sliding")
        if not physics.touched and self._visual_mesh.inside(base):
            found.append("gap")
        return found


def _episodes(
    factory: EnvFactory,
    findings: Findings,
    visual_mesh: VisualMesh,
    greedy: bool,
    seconds: float,
    rng: np.random.Generator,
    progress: Any,
) -> None:
    physics, task = factory.make_env(int(rng.integers(2**31)))
    environment = control.Environment(physics, task, control_timestep=task.options.control_timestep)
    done = 0.0
    while done < seconds:
        environment.reset()
        detector = EventDetector(physics.robot, visual_mesh)
        explorer = _ShortCut(task.world, task.segment, rng) if greedy else _Wanderer(rng)
        suspicious = False
        while True:
            v, yaw_rate = explorer.command(physics.planar_pose)
            action = np.array([v, yaw_rate]) if environment.action_spec().shape == (2,) else np.array([yaw_rate])
            last = environment.step(action).last()
            done += task.options.control_timestep
            progress.update(task.options.control_timestep)
            events = detector.events()
            findings.touching += bool(physics.touched)
            # A contact ends the episode, so sliding in its last step gains nothing.
            for name in events if task.cause != "collision" else [e for e in events if e != "wall_sliding"]:
                findings.note(f"episode_{name}", physics.planar_pose[:2])
                suspicious = True
            if last:
                break
        findings.episodes[task.cause] += 1
        findings.false_successes += suspicious and task.cause == "goal"
    findings.seconds += done


def _roam(
    factory: EnvFactory,
    findings: Findings,
    visual_mesh: VisualMesh,
    greedy: bool,
    seconds: float,
    rng: np.random.Generator,
    progress: Any,
) -> None:
    world, segment = factory.world, factory.segment
    model = episode_spec(world, segment.start, segment.end, _ROAM_WIDTH + 1.0).compile()
    robot = HuskyPhysics(model, world.robot)
    detector = EventDetector(robot, visual_mesh)
    done = 0.0
    while done < seconds:
        s = rng.uniform(segment.start, segment.end)
        x, y = point_at(world.route[:, :2], s)
        robot.set_pose(float(x), float(y), float(rng.uniform(-np.pi, np.pi)))
        explorer = _Rammer(model, rng) if greedy else _Wanderer(rng, reverse=True)
        until = done + _ROAM_TIME
        while done < until:
            robot.command(*explorer.command(robot.planar_pose))
            robot.step(_CONTROL_PERIOD)
            done += _CONTROL_PERIOD
            progress.update(_CONTROL_PERIOD)
            findings.touching += bool(robot.touched)
            for name in detector.events():
                findings.note(name, robot.planar_pose[:2])
            _, off = nearest_on_route(world.route, robot.planar_pose[:2])
            if abs(float(off)) > _ROAM_WIDTH or robot.uprightness < 0.3:
                break
    findings.seconds += done


class _Wanderer:
    """Commands a random walk of speed and yaw rate."""

    def __init__(self, rng: np.random.Generator, reverse: bool = False) -> None:
        self._rng, self._lowest, self._v, self._yaw_rate = rng, -1.0 if reverse else 0.0, 0.5, 0.0

    def command(self, pose: Array) -> tuple[float, float]:
        self._v = float(np.clip(self._v + self._rng.normal(0.02, 0.2), self._lowest, 1.0))
        self._yaw_rate = float(np.clip(0.9 * self._yaw_rate + self._rng.normal(0.0, 0.3), -1.0, 1.0))
        return self._v, self._yaw_rate


class _ShortCut:
    """Drives straight towards a point on the route 1 to 12 m ahead."""

    def __init__(self, world: World, segment: RouteSegment, rng: np.random.Generator) -> None:
        self._route, self._s = world.route[:, :2], segment.start
        self._ahead = rng.uniform(1.0, 12.0)

    def command(self, pose: Array) -> tuple[float, float]:
        foot, _ = nearest_on_route(self._route, pose[:2], self._s)
        self._s = max(self._s, float(foot))
        return _toward(pose, point_at(self._route, self._s + self._ahead))


class _Rammer:
    """Drives into one convex part after another and pushes."""

    def __init__(self, model: mujoco.MjModel, rng: np.random.Generator) -> None:
        parts = np.flatnonzero(model.geom_group == PART_GROUP)
        self._targets, self._rng, self._left = model.geom_pos[parts, :2], rng, 0
        self._target = np.zeros(2)

    def command(self, pose: Array) -> tuple[float, float]:
        if not self._left:
            near = np.argsort(np.linalg.norm(self._targets - pose[:2], axis=1))[:20]
            self._target = self._targets[self._rng.choice(near)] if len(near) else pose[:2] + self._rng.normal(0, 3, 2)
            self._target = self._target + self._rng.normal(0.0, 0.4, 2)  # some contacts are only glancing
            self._left = _PUSH_STEPS + _BACK_STEPS
        self._left -= 1
        if self._left < _BACK_STEPS:
            return -1.0, float(self._rng.uniform(-1.0, 1.0))
        v, yaw_rate = _toward(pose, self._target)
        return v, yaw_rate + float(self._rng.normal(0.0, 0.3))


def _toward(pose: Array, target: Array) -> tuple[float, float]:
    """Command at full speed towards a point; a turn on the spot if the point is more than 1 rad aside."""
    x, y = target - pose[:2]
    error = float(wrap_angle(np.arctan2(y, x) - pose[2]))
    return (1.0 if abs(error) < 1.0 else 0.0), float(np.clip(2.0 * error, -1.0, 1.0))
