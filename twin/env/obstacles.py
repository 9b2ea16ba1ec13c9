"""Obstacles on the route: added to a model before it is compiled, sampled for each episode, and moved in simulation.

*Station* is the arc length on the route [m], *lateral* the signed distance from it, positive to the left [m]. An
obstacle is a mocap body `obstacle_<name>`, which forces do not move; its geoms are `obstacle_<name>_<number>`. One
model serves many episodes: `place` sets the poses of an episode's obstacles, and parks the others far below the ground.
The model stores the route as the custom numeric `obstacle_route`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from twin.config import ObstacleConfig
from twin.config_file import check_obstacles
from twin.env.obstacle_models import RADIUS, ObstacleModel, add_obstacle_geoms
from twin.env.route_segments import RouteSegment
from twin.errors import InputError
from twin.mjcf.world import World, arc_lengths, heading_at, point_at
from twin.types import Array

PREFIX = "obstacle_"
STATIC_KINDS = ("cone", "box", "bollard")
"""Default kinds of `random_obstacles`: static objects that occur on a path."""

_ROUTE_NUMERIC = "obstacle_route"
_PARKED_HEIGHT = -100.0  # [m], far below the ground
_ROBOT_HALF_WIDTH = 0.34  # [m]
_CLEARANCE = 0.15  # [m] smallest gap between a random obstacle and a robot that passes it within the corridor
_RANDOM_MARGIN = 0.5  # [m] a random obstacle's near edge is at most this far beyond the corridor's edge
_MAX_TRIES = 20  # a distractor object is left out if this many samples give it no free position
_ROBOT_RADIUS = 0.6  # [m] distance from the robot's base to its farthest corner
_DISTRACTOR_STRIP = 2.5  # [m] width of the strip beside the corridor where distractor objects stand
_FREE_ENDS = (4.0, 3.0)  # [m] lengths at the route's start and end in which there are no random obstacles
_SPACING = 4.0  # [m] smallest distance along the route between random obstacles; less if the route is too short
_SINK_DEPTH = 0.01  # [m] obstacles are sunk this far into the ground, to avoid a visible gap below


def body_name(obstacle: ObstacleConfig, number: int) -> str:
    """Body name of an obstacle; `number` is its index in the list of obstacles."""
    return PREFIX + (obstacle.name or f"{obstacle.kind}_{number}")


def add_obstacles(spec: mujoco.MjSpec, obstacles: Sequence[ObstacleConfig], world: World) -> None:
    """Adds obstacles' bodies, below the ground, and the route to a scene; `place` moves them in the compiled model.

    Raises:
        InputError: see `check_obstacles`.
    """
    check_obstacles(obstacles)
    for k, one in enumerate(obstacles):
        body = spec.worldbody.add_body(name=body_name(one, k), mocap=True, pos=(0, 0, _PARKED_HEIGHT))
        add_obstacle_geoms(ObstacleModel(spec, body), one.kind, one.color, one.size)
    if not any(numeric.name == _ROUTE_NUMERIC for numeric in spec.numerics):
        spec.add_numeric(name=_ROUTE_NUMERIC, size=world.route.size, data=world.route.ravel())


def place(obstacles: Sequence[ObstacleConfig], data: mujoco.MjData, time: float) -> None:
    """Sets the mocap poses of an episode's obstacles at a time [s], and parks the model's other obstacles.

    Call it before every step if an obstacle moves, and once after each `mj_resetData`, which parks all of them.

    Raises:
        InputError: the model lacks an obstacle of the episode.
    """
    model = data.model
    wanted = {body_name(one, k): one for k, one in enumerate(obstacles)}
    for body in range(model.nbody):
        mocap = model.body_mocapid[body]
        if mocap < 0 or not model.body(body).name.startswith(PREFIX):
            continue
        one = wanted.pop(model.body(body).name, None)
        data.mocap_quat[mocap] = (1.0, 0.0, 0.0, 0.0)
        data.mocap_pos[mocap] = (0.0, 0.0, _PARKED_HEIGHT)
        if one is not None:
            x, y, yaw = obstacle_pose(one, stored_route(model), time)
            data.mocap_pos[mocap] = (x, y, ground_height(model, x, y) - _SINK_DEPTH)
            data.mocap_quat[mocap] = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
    if wanted:
        raise InputError(f"the model has no {', '.join(wanted)}; add it as [[obstacle]], or by add_obstacles")


def obstacle_pose(obstacle: ObstacleConfig, route: Array, time: float) -> tuple[float, float, float]:
    """x, y [m] and yaw [rad] of an obstacle at a time [s]; a moving one goes back and forth along its line."""
    start = np.array([obstacle.station, obstacle.lateral])
    turn = np.deg2rad(obstacle.yaw)
    step = np.array(obstacle.to) - start if obstacle.to else np.zeros(2)
    length = float(np.linalg.norm(step))
    if length < 1e-9:
        return (*_route_point(route, *start), float(heading_at(route, start[0])) + turn)
    passes = (time + obstacle.delay) * obstacle.speed / length
    back = bool(passes // 1.0 % 2.0)  # a pass back; also before the first pass, if the delay is negative
    share = passes % 1.0
    station, lateral = start + step * (1.0 - share if back else share)
    x, y = _route_point(route, station, lateral)
    direction = -step if back else step
    yaw = float(heading_at(route, station) + np.arctan2(direction[1], direction[0]))
    return x, y, yaw + turn


def _route_point(route: Array, station: float, lateral: float) -> tuple[float, float]:
    """x, y [m] of a point given by station and lateral; the route continues straight beyond its ends."""
    point = point_at(route[:, :2], station)
    over = station - np.clip(station, 0.0, arc_lengths(route)[-1])
    heading = float(heading_at(route, station))
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    x, y = point + over * along + lateral * left
    return float(x), float(y)


def stored_route(model: mujoco.MjModel) -> Array:
    """The route that `add_obstacles` stored in the model [m], shape (m, 3)."""
    return np.array(model.numeric(_ROUTE_NUMERIC).data).reshape(-1, 3)


def ground_height(model: mujoco.MjModel, x: float, y: float) -> float:
    """Height [m] of the height field `ground`, interpolated bilinearly; beyond its edge, the height of the edge."""
    geom = model.geom("ground")
    k = int(geom.dataid[0])
    rows, columns, adr = int(model.hfield_nrow[k]), int(model.hfield_ncol[k]), int(model.hfield_adr[k])
    half_x, half_y, high, _ = model.hfield_size[k]
    grid = model.hfield_data[adr : adr + rows * columns].reshape(rows, columns)
    column = np.clip((x - geom.pos[0] + half_x) / (2 * half_x), 0, 1) * (columns - 1)
    row = np.clip((y - geom.pos[1] + half_y) / (2 * half_y), 0, 1) * (rows - 1)
    i, j = min(int(row), rows - 2), min(int(column), columns - 2)
    u, v = row - i, column - j
    corners = grid[i : i + 2, j : j + 2]
    return float(geom.pos[2] + high * (np.array([1 - u, u]) @ corners @ np.array([1 - v, v])))


def random_obstacles(
    world: World, rng: np.random.Generator, count: int, kinds: Sequence[str] = STATIC_KINDS
) -> tuple[ObstacleConfig, ...]:
    """Samples static obstacles `random_<number>` along the route; within the corridor, a robot can pass each of them.

    Raises:
        InputError: the route is too short for `count` obstacles.
    """
    length = float(arc_lengths(world.route)[-1])
    room = length - sum(_FREE_ENDS)
    if room <= 0.0 or count > room:
        raise InputError(f"{count} obstacles on a route of {length:.1f} m; expected at most {max(0, int(room))}")
    spacing = min(_SPACING, 0.8 * room / max(count, 1))
    # Sorted uniform samples plus multiples of the spacing are uniform over all arrangements that keep this spacing.
    free = np.sort(rng.uniform(0.0, room - spacing * (count - 1), count)) if count else np.zeros(0)
    out = []
    for k, station in enumerate(_FREE_ENDS[0] + free + spacing * np.arange(count)):
        kind = str(rng.choice(list(kinds)))
        radius = RADIUS[kind]
        nearest = max(0.0, radius + _ROBOT_HALF_WIDTH + _CLEARANCE - world.half_width)
        farthest = max(nearest, world.half_width + _RANDOM_MARGIN) + radius
        lateral = rng.uniform(nearest, farthest) * rng.choice([-1.0, 1.0])
        yaw = float(rng.uniform(-180.0, 180.0)) if kind in STATIC_KINDS else 0.0
        out.append(ObstacleConfig(f"random_{k}", kind, float(station), float(lateral), yaw))
    return tuple(out)


def random_distractors(world: World, rng: np.random.Generator, count: int) -> tuple[ObstacleConfig, ...]:
    """Samples distractor objects beside the corridor, out of reach of a robot within it.

    They are named as in `random_obstacles`. A winding route may leave room for fewer than `count`.
    """
    route, out = world.route[:, :2], []
    length = float(arc_lengths(world.route)[-1])
    for k in range(count):
        kind = str(rng.choice(list(STATIC_KINDS)))
        nearest = world.half_width + _ROBOT_RADIUS + RADIUS[kind]
        for _ in range(_MAX_TRIES):
            station = float(rng.uniform(0.0, length))
            lateral = float(rng.uniform(nearest, nearest + _DISTRACTOR_STRIP) * rng.choice([-1.0, 1.0]))
            # At a bend, a point beside one part of the route may be on another part of it.
            if np.linalg.norm(route - _route_point(route, station, lateral), axis=1).min() >= nearest:
                out.append(ObstacleConfig(f"random_{k}", kind, station, lateral, float(rng.uniform(-180.0, 180.0))))
                break
    return tuple(out)


# ---- obstacles of an episode

_COLOR_SEED = 7  # random seed of the distractor objects' colors
_ROUTE_STEP = 0.25  # [m] distance between points of a segment's route


class EpisodeObstacles:
    """Obstacles of a task's episodes: configured or random ones along the segment, plus distractor objects.

    Bodies cannot be added to a compiled model. So the model contains a *pool*: as many obstacles of each kind as an
    episode may need.
    """

    def __init__(
        self, wanted: int | Sequence[ObstacleConfig], world: World, segment: RouteSegment, beside: int = 0
    ) -> None:
        """
        Args:
            wanted: Number of random obstacles per episode, or the obstacles that all episodes have.
            world: Contains route and corridor.
            segment: Route segment along which random obstacles stand.
            beside: Largest number of distractor objects.
        """
        self._count = wanted if isinstance(wanted, int) else 0
        self._given = () if isinstance(wanted, int) else tuple(wanted)
        self._beside = beside
        self._colors = np.random.default_rng(_COLOR_SEED).uniform(0.05, 0.9, (len(STATIC_KINDS), beside, 3))
        s = np.append(np.arange(segment.start, segment.end, _ROUTE_STEP), segment.end)
        self._segment_world, self._start = replace(world, route=point_at(world.route, s)), segment.start

    @property
    def pool(self) -> tuple[ObstacleConfig, ...]:
        """Obstacles that the model must contain."""
        standing = [_static_obstacle(kind, k) for kind in STATIC_KINDS for k in range(self._count)]
        distractors = [self._distractor(kind, k) for kind in STATIC_KINDS for k in range(self._beside)]
        return (*self._given, *standing, *distractors)

    def sample(self, rng: np.random.Generator, beside: int = 0) -> tuple[ObstacleConfig, ...]:
        """Samples the obstacles of one episode, with `beside` distractor objects."""
        standing = random_obstacles(self._segment_world, rng, self._count) if self._count else ()
        distractors = random_distractors(self._segment_world, rng, beside)
        return (
            *self._given,
            *self._from_pool(standing, _static_obstacle),
            *self._from_pool(distractors, self._distractor),
        )

    def _from_pool(
        self, sampled: Sequence[ObstacleConfig], member: Callable[[str, int], ObstacleConfig]
    ) -> list[ObstacleConfig]:
        """Returns members of the pool, moved to the poses of sampled obstacles."""
        out: list[ObstacleConfig] = []
        for one in sampled:
            mine = member(one.kind, sum(other.kind == one.kind for other in out))
            out.append(replace(mine, station=one.station + self._start, lateral=one.lateral, yaw=one.yaw))
        return out

    def _distractor(self, kind: str, number: int) -> ObstacleConfig:
        color = self._colors[STATIC_KINDS.index(kind), number]
        return ObstacleConfig(f"beside_{kind}_{number}", kind, color=tuple(color.tolist()))


def _static_obstacle(kind: str, number: int) -> ObstacleConfig:
    return ObstacleConfig(f"{kind}_{number}", kind)


class ObstacleMotion:
    """Moves an episode's obstacles; used as `HuskyPhysics.move_obstacles`."""

    def __init__(self, obstacles: Sequence[ObstacleConfig], data: mujoco.MjData) -> None:
        self.obstacles, self._data = tuple(obstacles), data
        self.moving = any(one.to for one in self.obstacles)

    def __call__(self, time: float) -> None:
        """Moves obstacles to their poses at a time [s]; static ones are set only at time 0."""
        if self.moving or time == 0.0:
            place(self.obstacles, self._data, time)
