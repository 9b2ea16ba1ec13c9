"""The vectorized controller equals the controllers of single robots."""

from dataclasses import replace

import numpy as np
import pytest
from test_route_follower import on_a_plane

from twin.env.controller import Controller, VectorController, wheel_speeds
from twin.env.physics import HuskyPhysics
from twin.robot import HuskyParams

PARAMS = HuskyParams(max_acceleration=1.0, max_wheel_speed=0.8)


@pytest.mark.parametrize(("period", "controller"), [(0.1, "ros1"), (0.06, "ros1"), (0.24, "ros1"), (0.1, "ros2_50hz")])
def test_vector_controller_equals_single_controllers(period, controller):
    params = replace(PARAMS, controller=controller)
    rng = np.random.default_rng(0)
    model = on_a_plane().model
    latencies, rolling = np.array([0.0, 0.013, 0.1, 0.237, 0.05, 0.4]), np.array([0.0, 0.5, 0.0, 0.3, 0.7, 0.6])
    n, steps = len(latencies), round(period / model.opt.timestep)

    def husky(i: int) -> HuskyPhysics:
        robot = HuskyPhysics(model, replace(params, command_latency=latencies[i]))
        robot.data.ctrl[robot.actuators] = wheel_speeds(np.array([rolling[i], 0.0]), params)
        robot.begin()
        assert robot.controller.speed == pytest.approx(rolling[i])
        return robot

    robots = [husky(i) for i in range(n)]
    many = VectorController(params, n, period, model.opt.timestep, robots[0].check_steps)

    def begin(which: np.ndarray) -> None:
        for i in which:
            robots[i] = husky(i)
        until = np.array([robots[i].steps_to_update for i in which])
        many.begin(which, latencies[which], until, np.array([robots[i].controller.speed for i in which]))

    begin(np.arange(n))
    for k in range(30):
        if k == 11:
            latencies[2] = 0.71  # more commands under way than there were before
            begin(np.array([0, 2]))
        which = np.arange(n) if k % 4 else np.array([1, 2, 5])  # the others' time stands still
        commands = rng.uniform([-1.0, -2.0], [1.0, 2.0], (len(which), 2))
        told = many.schedules(which, commands)
        for i, command in zip(which, commands, strict=True):
            robot = robots[i]
            robot.command(*command)
            course, done = robot.schedule(period), 0
            for p, (some, sides) in enumerate(course):
                np.testing.assert_array_equal(told.speeds[p, i], sides)
                assert (told.segment[done : done + some, i] == p).all()
                assert told.checks[done : done + some, i].tolist() == [0] * (some - 1) + [1]
                done += some
                robot.data.time += some * model.opt.timestep
                assert told.times[p, i] == robot.data.time
            robot.data.ctrl[robot.actuators] = course[-1][1]
            assert done == steps and np.isinf(told.times[len(course) :, i]).all()
    moving = [Controller(replace(params, command_latency=latency)).phase for latency in latencies]
    assert len(set(np.round(moving, 6))) > 3  # or pieces would all have been alike
