"""Obstacles on the route: put into a model before it is compiled, and moved while it runs.

*Station* is the arc length on the route [m], *lateral* the distance from it, left positive [m]. Every obstacle is a
mocap body `obstacle_<name>`, which no force moves; its geoms are `obstacle_<name>_<number>`. One model therefore serves
many episodes: `place` puts its obstacles anywhere on the route, and those that an episode does without are *parked* far
below the ground. The route itself is kept in the model, as the numeric `obstacle_route`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from twin.config import OBSTACLE_KINDS, ObstacleConfig
from twin.env.obstacle_models import RADIUS, ObstacleModel, add_shape
from twin.env.route_segments import RouteSegment
from twin.errors import InputError
from twin.mjcf.world import World, arc_lengths, heading_at, point_at
from twin.types import Array

PREFIX = "obstacle_"
STANDING = ("cone", "box", "bollard")
"""What `random_obstacles` draws from unless told otherwise: things that stand on a path."""

_ROUTE = "obstacle_route"
_PARKED = -100.0  # [m] below the ground, where nothing sees or touches it
_ROBOT_HALF_WIDTH = 0.34  # [m]
_PASSAGE = 0.15  # [m] that a robot has to spare beside a random obstacle
_BESIDE = 0.5  # [m] beyond the corridor's edge at which random obstacles still stand
_TRIES = 20  # draws for a bystander
_ROBOT_RADIUS = 0.6  # [m] from its base to the farthest corner
_STRIP = 2.5  # [m] beside the corridor in which bystanders stand
_CLEAR_ENDS = (4.0, 3.0)  # [m] of the route's start and end that random obstacles leave free
_SPACING = 4.0  # [m] of the route between random obstacles, if there is room
_SINK = 0.01  # [m] into the ground, so that no light shows below


def body_name(obstacle: ObstacleConfig, number: int) -> str:
    """Of the obstacle with this place in its list."""
    return PREFIX + (obstacle.name or f"{obstacle.kind}_{number}")


def add_obstacles(spec: mujoco.MjSpec, obstacles: Sequence[ObstacleConfig], world: World) -> None:
    """Adds the bodies of obstacles to a world, where they are at the beginning of an episode.

    Args:
        spec: Of the world, see `World.model_path`, not compiled yet.
        obstacles: What to add; where each is can be changed later by `place`, its kind, colour and size cannot.
        world: Has the route.

    Raises:
        InputError: an unknown kind, or two of one name.
    """
    names = [body_name(one, k) for k, one in enumerate(obstacles)]
    if len(set(names)) < len(names):
        raise InputError(f"two obstacles are named {max(names, key=names.count)!r}; give each a name of its own")
    for name, one in zip(names, obstacles, strict=True):
        if one.kind not in OBSTACLE_KINDS:
            raise InputError(f"obstacle kind {one.kind!r}: expected one of {', '.join(OBSTACLE_KINDS)}")
        body = spec.worldbody.add_body(name=name, mocap=True, pos=(0, 0, _PARKED))
        add_shape(ObstacleModel(spec, body), one.kind, one.color, one.size)
    if not any(numeric.name == _ROUTE for numeric in spec.numerics):
        spec.add_numeric(name=_ROUTE, size=world.route.size, data=world.route.ravel())


def place(obstacles: Sequence[ObstacleConfig], data: mujoco.MjData, time: float) -> None:
    """Puts the obstacles where they are at a time of the episode, and parks the others of the model.

    Call it before every step where something moves, and once after a reset where all stand (`mj_resetData` moves mocap
    bodies back to where they were compiled, which is parked).

    Args:
        obstacles: Those of the episode, by the names they have in the model.
        data: Its `mocap_pos` and `mocap_quat` are set.
        time: Since the episode began [s].

    Raises:
        InputError: the model has no such obstacle.
    """
    model = data.model
    wanted = {body_name(one, k): one for k, one in enumerate(obstacles)}
    for body in range(model.nbody):
        mocap = model.body_mocapid[body]
        if mocap < 0 or not model.body(body).name.startswith(PREFIX):
            continue
        one = wanted.pop(model.body(body).name, None)
        data.mocap_quat[mocap] = (1.0, 0.0, 0.0, 0.0)
        data.mocap_pos[mocap] = (0.0, 0.0, _PARKED)
        if one is not None:
            x, y, yaw = pose_at(one, route_of(model), time)
            data.mocap_pos[mocap] = (x, y, ground_height(model, x, y) - _SINK)
            data.mocap_quat[mocap] = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
    if wanted:
        raise InputError(f"the model has no {', '.join(wanted)}; name it in [[obstacle]], or add it with add_obstacles")


def moves(obstacles: Sequence[ObstacleConfig]) -> bool:
    """Whether `place` is needed before every step."""
    return any(one.to for one in obstacles)


def pose_at(obstacle: ObstacleConfig, route: Array, time: float) -> tuple[float, float, float]:
    """x, y [m] and yaw [rad] of an obstacle at a time [s]; one that moves goes to and fro along its line."""
    start = np.array([obstacle.station, obstacle.lateral])
    turn = np.deg2rad(obstacle.yaw)
    if not obstacle.to:
        x, y = _spot(route, *start)
        return x, y, float(heading_at(route, start[0])) + turn
    step = np.array(obstacle.to) - start
    length = float(np.linalg.norm(step))
    if length < 1e-9:
        return (*_spot(route, *start), float(heading_at(route, start[0])) + turn)
    way = (time + obstacle.delay) * obstacle.speed / length
    back = bool(int(way) % 2)
    share = way % 1.0
    station, lateral = start + step * (1.0 - share if back else share)
    x, y = _spot(route, station, lateral)
    direction = -step if back else step
    yaw = float(heading_at(route, station) + np.arctan2(direction[1], direction[0]))
    return x, y, yaw + turn


def _spot(route: Array, station: float, lateral: float) -> tuple[float, float]:
    point = point_at(route[:, :2], station)
    # Beyond an end the route goes straight on.
    over = station - np.clip(station, 0.0, arc_lengths(route)[-1])
    heading = float(heading_at(route, station))
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    x, y = point + over * along + lateral * left
    return float(x), float(y)


def route_of(model: mujoco.MjModel) -> Array:
    """The route that `add_obstacles` kept in the model [m], shape (m, 3)."""
    return np.array(model.numeric(_ROUTE).data).reshape(-1, 3)


def ground_height(model: mujoco.MjModel, x: float, y: float) -> float:
    """Bilinear height [m] of the geom `ground`, an upright height field; beyond its edge, that of the edge."""
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
    world: World, rng: np.random.Generator, count: int, kinds: Sequence[str] = STANDING
) -> tuple[ObstacleConfig, ...]:
    """Obstacles that stand along the route, apart from each other, leaving a way past each within the corridor.

    The same generator state gives the same obstacles; they are named `random_<number>`.

    Args:
        world: Has route and corridor.
        rng: Decides where and what.
        count: How many.
        kinds: Which kinds may be drawn.

    Raises:
        InputError: the route is too short for so many.
    """
    length = float(arc_lengths(world.route)[-1])
    room = length - sum(_CLEAR_ENDS)
    if room <= 0.0 or count > room:
        raise InputError(f"{count} obstacles on a route of {length:.1f} m; expected at most {max(0, int(room))}")
    spacing = min(_SPACING, 0.8 * room / max(count, 1))
    # Uniform among all arrangements that keep the spacing: sort, then spread by it.
    free = np.sort(rng.uniform(0.0, room - spacing * (count - 1), count)) if count else np.zeros(0)
    out = []
    for k, station in enumerate(_CLEAR_ENDS[0] + free + spacing * np.arange(count)):
        kind = str(rng.choice(list(kinds)))
        radius = RADIUS[kind]
        nearest = max(0.0, radius + _ROBOT_HALF_WIDTH + _PASSAGE - world.half_width)
        lateral = rng.uniform(nearest, max(nearest, world.half_width + _BESIDE) + radius) * rng.choice([-1.0, 1.0])
        yaw = float(rng.uniform(-180.0, 180.0)) if kind in STANDING else 0.0
        out.append(ObstacleConfig(f"random_{k}", kind, float(station), float(lateral), yaw))
    return tuple(out)


def bystanders(
    world: World, rng: np.random.Generator, count: int, kinds: Sequence[str] = STANDING
) -> tuple[ObstacleConfig, ...]:
    """Things that stand beside the corridor where no robot within it can touch them: as if they had been moved there.

    The same generator state gives the same ones; they are named `random_<number>`.

    Args:
        world: Has route and corridor.
        rng: Decides where and what.
        count: How many; fewer where a winding route leaves no room.
        kinds: Which kinds may be drawn.
    """
    route, out = world.route[:, :2], []
    length = float(arc_lengths(world.route)[-1])
    for k in range(count):
        kind = str(rng.choice(list(kinds)))
        nearest = world.half_width + _ROBOT_RADIUS + RADIUS[kind]
        for _ in range(_TRIES):
            station = float(rng.uniform(0.0, length))
            lateral = float(rng.uniform(nearest, nearest + _STRIP) * rng.choice([-1.0, 1.0]))
            # Inside a bend, what is beside one part of the route may be on another.
            if np.linalg.norm(route - _spot(route, station, lateral), axis=1).min() >= nearest:
                out.append(ObstacleConfig(f"random_{k}", kind, station, lateral, float(rng.uniform(-180.0, 180.0))))
                break
    return tuple(out)


# ---- Which obstacles an episode has: those of `scene.toml`, given ones, or some drawn at random for it.
#
# A compiled model cannot gain bodies, so for random obstacles it holds a *pool*: as many of every kind as there may be.


_COLORS = 7  # seed of what bystanders are painted with
_STEP = 0.25  # [m] between points of a stretch's own route


class EpisodeObstacles:
    """The obstacles of a task's episodes."""

    def __init__(
        self, wanted: int | Sequence[ObstacleConfig], world: World, stretch: RouteSegment, beside: int = 0
    ) -> None:
        """
        Args:
            wanted: How many to draw for every episode, or which there are in all of them.
            world: Has the route.
            stretch: Along which random ones stand.
            beside: How many stand beside the corridor, at most.
        """
        self._count = wanted if isinstance(wanted, int) else 0
        self._given = () if isinstance(wanted, int) else tuple(wanted)
        self._beside = beside
        self._colors = np.random.default_rng(_COLORS).uniform(0.05, 0.9, (len(STANDING), beside, 3))
        s = np.append(np.arange(stretch.start, stretch.end, _STEP), stretch.end)
        self._along, self._start = replace(world, route=point_at(world.route, s)), stretch.start

    @property
    def pool(self) -> tuple[ObstacleConfig, ...]:
        """What the model must hold."""
        standing = [_standing(kind, k) for kind in STANDING for k in range(self._count)]
        return (*self._given, *standing, *(self._bystander(kind, k) for kind in STANDING for k in range(self._beside)))

    def draw(self, rng: np.random.Generator, beside: int = 0) -> tuple[ObstacleConfig, ...]:
        """Those of one episode, with so many beside the corridor."""
        standing = random_obstacles(self._along, rng, self._count) if self._count else ()
        return (
            *self._given,
            *self._placed(standing, _standing),
            *self._placed(bystanders(self._along, rng, beside), self._bystander),
        )

    def _placed(
        self, drawn: Sequence[ObstacleConfig], of_pool: Callable[[str, int], ObstacleConfig]
    ) -> list[ObstacleConfig]:
        """Those of the pool where others were drawn."""
        out: list[ObstacleConfig] = []
        for one in drawn:
            mine = of_pool(one.kind, sum(other.kind == one.kind for other in out))
            out.append(replace(mine, station=one.station + self._start, lateral=one.lateral, yaw=one.yaw))
        return out

    def _bystander(self, kind: str, number: int) -> ObstacleConfig:
        color = self._colors[STANDING.index(kind), number]
        return ObstacleConfig(f"beside_{kind}_{number}", kind, color=tuple(color.tolist()))


def _standing(kind: str, number: int) -> ObstacleConfig:
    return ObstacleConfig(f"{kind}_{number}", kind)


class Surroundings:
    """Keeps an episode's obstacles in their places."""

    def __init__(self, obstacles: Sequence[ObstacleConfig], data: mujoco.MjData) -> None:
        self.obstacles, self._data = tuple(obstacles), data
        self.moving = moves(self.obstacles)
        """Whether any of them does."""

    def __call__(self, time: float) -> None:
        """Moves what moves to where it is at a time [s]; at 0 everything."""
        if self.moving or time == 0.0:
            place(self.obstacles, self._data, time)
