"""Applies the twin's rules of success and failure to a recorded trial on the road; compares the trial with the twin.

`judge` applies the environment's `RewardAndTermination` to the recorded poses, sampled once per control step. The
operator reports outcomes that poses do not show, such as a collision. `replay` drives the twin's robot by the recorded
commands, from the same start. `view` renders the radiance field from the poses of the robot's pictures.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin.env.env_factory import EnvFactory
from twin.env.task import Motion, RewardAndTermination
from twin.errors import InputError
from twin.geometry.cameras import Rendering, Viewpoints, evenly_spaced, pixel_grid, unproject
from twin.geometry.images import psnr, to_uint8
from twin.geometry.polyline import heading_at
from twin.geometry.poses import wrap_angle
from twin.nerf.sun import relit
from twin.robot import PixelCamera
from twin.types import Array, Image

_PROBES = 8  # largest number of pictures used to choose a lighting


@dataclass(frozen=True)
class JudgedTrial:
    """k instants of a trial, one per control step from its start to its end."""

    times: Array
    """[s] since the start, shape (k,)."""
    poses: Array
    """x, y [m], yaw [rad] of the base in the scene, shape (k, 3)."""
    cross_track: Array
    """Distance from the route, left positive [m], shape (k,)."""
    progress: Array
    """Distance along the task's route segment [m], shape (k,)."""
    cause: str
    """Cause of the end, one of `twin.config.CAUSES`; empty if the recording ends before an outcome."""
    start_heading: float
    """Yaw relative to the route at the start [rad]."""
    rewards: Array
    """Reward of the step that ended at each instant, without the term for steering, shape (k,); the first is zero."""

    def with_cause(self, cause: str | None, where: Path) -> "JudgedTrial":
        """The trial with the cause stated by the operator, if one is given; `where` is the recording's name in errors.

        Raises InputError: there is neither a cause nor an outcome, or the cause is the goal, which was not reached.
        """
        if cause == "goal" and self.cause != "goal":
            raise InputError(
                f"{where}: the recording ends {self.progress[-1]:.1f} m along the task ({self.cause or 'no outcome'}); "
                "expected a cause of failure, as the goal was not reached"
            )
        if not (cause or self.cause):
            raise InputError(
                f"{where}: the recording ends after {self.times[-1]:.1f} s and {self.progress[-1]:.1f} m without an "
                "outcome; record to the end, or give the cause, such as --cause collision"
            )
        return replace(self, cause=cause or self.cause)


def judge(factory: EnvFactory, times: Array, poses: Array, uprightness: Array) -> JudgedTrial:
    """Applies the environment's termination to recorded poses.

    Args:
        factory: Scene, task and options.
        times: [s] since the start, one control step apart, starting at 0; shape (n,).
        poses: x, y [m], yaw [rad] of the base in the scene, shape (n, 3).
        uprightness: Cosine of the tilt, shape (n,).
    """
    rules = RewardAndTermination(factory.world, factory.segment, factory.options)
    rules.begin([0], np.array([factory.segment.start]), poses[:1, :2])
    cross, foot, rewards, cause = [float(rules.cross_track[0])], [float(rules.foot[0])], [0.0], ""
    for i in range(1, len(times)):
        still = np.zeros(1), np.zeros(1), uprightness[i : i + 1], np.zeros(1, bool)
        rules.evaluate([0], Motion(poses[i : i + 1], *still, times[i : i + 1]))
        cross.append(float(rules.cross_track[0]))
        foot.append(float(rules.foot[0]))
        rewards.append(float(rules.reward([0])[0]))
        cause = rules.cause(0)
        if cause:
            break
    k = len(cross)
    heading = float(wrap_angle(poses[0, 2] - float(heading_at(factory.world.route[:, :2], foot[0]))))
    progress = np.array(foot) - factory.segment.start
    return JudgedTrial(times[:k], poses[:k], np.array(cross), progress, cause, heading, np.array(rewards))


def replay(factory: EnvFactory, start: Array, times: Array, command_times: Array, commands: Array) -> Array:
    """Drives the twin's robot by recorded commands; returns its poses (k, 3) at `times`: x, y [m], yaw [rad].

    Args:
        factory: Scene and robot.
        start: x, y [m], yaw [rad] at rest, shape (3,).
        times: [s], increasing, starting at 0, shape (k,).
        command_times: Times at which the commands were given [s], increasing, shape (c,).
        commands: v [m/s], ω [rad/s], shape (c, 2).
    """
    robot = factory.make_env(0)[0].robot
    robot.set_pose(*start.tolist())
    out, timestep, given = [robot.planar_pose], robot.model.opt.timestep, 0
    for until in times[1:]:
        while given < len(commands) and command_times[given] < until - timestep / 2:
            ahead = command_times[given] - robot.time
            if ahead >= timestep:
                robot.step(ahead // timestep * timestep)
            robot.command(*commands[given].tolist())
            given += 1
        robot.step(until - robot.time)
        out.append(robot.planar_pose)
    return np.array(out)


@dataclass(frozen=True)
class TrialViews:
    """Renderings from the poses of the robot's pictures, and their agreement with these."""

    lighting: str
    twin: list[Image]
    """RGB uint8 (h, w, 3), one per picture."""
    psnr: Array
    """Peak signal-to-noise ratio [dB], shape (n,)."""
    matched_psnr: Array
    """PSNR [dB], shape (n,), with the mean and standard deviation of each color channel matched to the robot's picture,
    so global brightness, contrast and tint do not affect it."""
    trust: Array
    """See `twin.env.trust`, shape (n,)."""


def view(
    factory: EnvFactory, poses: Array, pictures: list[Image], camera: PixelCamera, lighting: str | None
) -> TrialViews:
    """Renders the field from the poses at which pictures were taken, and compares the pictures.

    Args:
        factory: Scene, with its field.
        poses: x, y [m], yaw [rad] of the base, shape (n, 3).
        pictures: RGB uint8 (h, w, 3) of `camera`.
        camera: A pinhole camera with the pictures' size.
        lighting: Name of a lighting; None: the field's lighting with the best median PSNR.
    """
    field, trust = factory.field, factory.trust
    assert field is not None and trust is not None  # the options enable pictures
    robot = factory.make_env(0)[0].robot
    seen = []
    for pose in poses:
        robot.set_pose(*pose.tolist())
        seen.append(robot.camera_to_world)
    real = [one / np.float32(255.0) for one in pictures]
    intrinsics = np.array(camera.intrinsics)
    rays = unproject(pixel_grid(*camera.size), intrinsics)

    def render(i: int, name: str) -> Rendering:
        """The picture of an episode under this lighting: with its sun and fog, if it was fitted to a photo."""
        out = field.render(Viewpoints.of(seen[i], intrinsics, camera.size), name)
        rgb, fog = relit(out.rgb[0], out.depth[0], rays, seen[i], field.sunlight(name)), field.fog(name)
        if fog:
            rgb = fog.apply(rgb, out.depth[0] * np.linalg.norm(rays, axis=-1).astype(np.float32))
        return replace(out, rgb=rgb[None])

    if lighting is None:
        some = evenly_spaced(len(seen), _PROBES).tolist()
        scores = {name: np.median([psnr(render(i, name).rgb[0], real[i]) for i in some]) for name in field.lightings}
        lighting = max(scores, key=lambda name: float(scores[name]))
    renderings = [render(i, lighting) for i in range(len(seen))]
    twin = [np.clip(one.rgb[0], 0.0, 1.0) for one in renderings]
    return TrialViews(
        lighting,
        [to_uint8(one) for one in twin],
        np.array([psnr(a, b) for a, b in zip(twin, real, strict=True)]),
        np.array([psnr(_matched(a, b), b) for a, b in zip(twin, real, strict=True)]),
        np.array([trust.of(pose[None], one)[0] for pose, one in zip(seen, renderings, strict=True)]),
    )


def _matched(picture: Array, reference: Array) -> Array:
    """Scales each color channel of a picture to the mean and standard deviation of the reference's channel."""
    mean, std = picture.mean((0, 1)), picture.std((0, 1))
    return np.clip((picture - mean) / np.maximum(std, 1e-3) * reference.std((0, 1)) + reference.mean((0, 1)), 0.0, 1.0)
