"""Branches: other routes through the same place, by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_twin import tiny_twin
from tiny_world import tiny_ground

import twin
from twin import runtime
from twin.config import Condition, TaskConfig
from twin.config_file import load_config
from twin.env import env_factory
from twin.env.drivers import follow_route
from twin.env.env_factory import EnvFactory, fingerprint
from twin.env.physics import HuskyPhysics
from twin.env.route_segments import scene_tasks
from twin.errors import InputError
from twin.geometry.polyline import arc_lengths
from twin.geometry.route import BRANCH
from twin.mjcf.scene_xml import run
from twin.mjcf.world import World
from twin.report import review_video
from twin.report.build_sections import mjcf_section, review_section
from twin.report.review_video import drive_metrics
from twin.scene import SceneDir, write_stamp

BRANCHED = """
[[branch]]
name = "side"
points = [[1.0, 0.0], [9.0, 1.0]]
[[task]]
name = "side_gate"
route = "side"
start = 2.0
length = 3.0
[[obstacle]]
kind = "cone"
station = 4.0
lateral = 0.6
[[obstacle]]
kind = "box"
route = "side"
station = 4.0
lateral = -1.4
"""


@pytest.fixture(autouse=True)
def quiet():
    runtime.set_quiet(True)
    yield
    runtime.set_quiet(False)


def side() -> np.ndarray:
    """A line that leaves the tiny route to the left, shape (m, 3)."""
    xy = np.stack([np.arange(1.0, 9.0, 0.25), np.linspace(0.0, 1.0, 32)], 1)
    return np.column_stack([xy, tiny_ground().at(xy)])


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    root = tiny_twin(tmp_path_factory.mktemp("branches") / "place", more=BRANCHED)
    scene = SceneDir(root)
    mesh, mjcf = scene.stage("mesh"), scene.stage("mjcf")
    with np.load(mesh / "route.npz") as stored:
        np.savez(mesh / "route.npz", **stored, **{f"{BRANCH}side": side()})
    run(scene, load_config(scene.config_file), mjcf)
    for stage in (mesh, mjcf):
        write_stamp(stage, stage.name.split("_")[1])
    return root


def test_branch_is_a_task_and_has_tasks(root):
    world, config = World.load(SceneDir(root).stage("mjcf")), load_config(root / "scene.toml")
    np.testing.assert_allclose(world.branches["side"], side())
    assert world.along("") is world and np.array_equal(world.along("side").goal, side()[-1])
    tasks = scene_tasks(world, config.task)
    assert tasks["side"].route == tasks["side_gate"].route == "side" and tasks["ahead"].route == ""
    assert tasks["side"].length == pytest.approx(arc_lengths(side())[-1])
    too_long = TaskConfig("far", 5.0, 5.0, "side")
    with pytest.raises(InputError, match=r"its route is 7\.8"):
        scene_tasks(world, (too_long,))
    with pytest.raises(InputError, match="has no branch 'north'; build the scene again"):
        scene_tasks(world, (TaskConfig("far", 0.0, 5.0, "north"),))


def test_episode_drives_along_the_branch(root):
    env = twin.load(root, "side_gate", seed=1, start_offset=0.0, start_heading=0.0)
    env.reset()
    start = env.physics.base_to_world[:2, 3]
    assert np.linalg.norm(start - np.array([3.0, 0.25])) < 0.1
    step = env.step([1.0, 0.0])
    while not step.last():
        step = env.step([1.0, 0.0])
    info = env.task.info(env.physics)
    assert info["cause"] == "goal" and abs(info["cross_track"]) < 0.2
    assert env.physics.base_to_world[0, 3] > 5.0 and env.physics.base_to_world[1, 3] > 0.4


def test_scripted_driver_follows_the_branch(root):
    world = World.load(SceneDir(root).stage("mjcf"))
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), branch="side")
    assert np.linalg.norm(drive.base_to_world[0, :2, 3] - side()[0, :2]) < 0.05
    assert drive.reached_goal and np.linalg.norm(drive.base_to_world[-1, :2, 3] - side()[-1, :2]) < 1.1


def test_scripted_driver_begins_at_the_start_of_the_branch(root):
    world = replace(World.load(SceneDir(root).stage("mjcf")), branch_starts={"side": 6.0})
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), branch="side")
    assert drive.progress[0] == pytest.approx(6.0, abs=0.05) and drive.reached_goal


def test_report_tells_the_drives_along_branches(root):
    world = World.load(SceneDir(root).stage("mjcf"))
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), branch="side")
    review = review_section({"review": {"branches": {"side": drive_metrics(drive)}}})
    assert (review.facts[0].name, review.facts[0].value) == ("goal of branch side reached", "yes")
    assert not review.cautions
    scene = mjcf_section({"mesh": {"branches_m": {"side": 8.06}}})
    assert ("branch side", "8.1 m") in [(fact.name, fact.value) for fact in scene.facts]


def test_obstacles_stand_on_their_own_route(root):
    kinds = {}
    for task in ("ahead", "side"):
        factory = EnvFactory.open(root, task, {"obstacles": "scene", "pixels": False})
        kinds[task] = [one.kind for one in factory.obstacles.pool]
    assert kinds == {"ahead": ["cone"], "side": ["box"]}


def test_digests_of_episodes_on_the_route_do_not_depend_on_branches(root, tmp_path, monkeypatch):
    """Validations of builds that are older than branches store these digests."""
    monkeypatch.setattr(env_factory, "stage_result", lambda scene, stage: stage)
    cone = BRANCHED[BRANCHED.index("[[obstacle]]") : BRANCHED.rindex("[[obstacle]]")]
    before = tiny_twin(tmp_path / "place", more=cone)
    old, new = (fingerprint(twin.load_scene(place), "ahead", Condition("day")) for place in (before, root))
    assert old == new
    assert fingerprint(twin.load_scene(root), "side", Condition("day")) != new


def test_a_branch_that_cannot_be_driven_is_named(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def off_the_ground(*_: object, **__: object) -> None:
        raise InputError("the robot would start beyond the ground; raise mesh.margin")

    monkeypatch.setattr(review_video, "follow_route", off_the_ground)
    world = World.load(SceneDir(root).stage("mjcf"))
    with pytest.raises(InputError, match=r"^branch side: the robot would start beyond the ground; raise mesh\.margin$"):
        review_video.branch_metrics(world, 1.0, "side")
