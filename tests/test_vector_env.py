"""Vector environments in several processes: results equal those of one process, and errors reach the parent."""

import gc
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.env.env_factory import EnvFactory
from twin.env.gym_env import DriveVectorEnv
from twin.env.vector_env import ProcessVectorEnv, _Child, make_vector_env
from twin.env.vector_env_local import LocalVectorEnv
from twin.errors import InputError

PICTURES = {"size": (32, 18), "randomise": True, "time_limit": 1.5}
STATES = {"pixels": False, "randomise": True, "obstacles": 2, "time_limit": 1.5}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


def _spread(scene):
    envs = ProcessVectorEnv(scene, "bend", {"pixels": False}, [1, 2, 3], 2)
    yield envs
    envs.close()


spread = pytest.fixture(_spread, name="spread")
shared = pytest.fixture(_spread, name="shared", scope="module")  # for tests that leave it usable


@pytest.mark.parametrize("options", [PICTURES, STATES], ids=["pictures", "states"])
def test_processes_change_no_result(scene, options):
    """Rewards, ends, images, states and infos are bit-identical, also for subsets of the environments in any order."""
    seeds = [5, 6, 7]
    here = LocalVectorEnv(EnvFactory.open(scene, "bend", options), seeds)
    there = ProcessVectorEnv(scene, "bend", options, seeds, 2)
    assert (len(there), there.action_size, there.state_size) == (len(here), here.action_size, here.state_size)
    rng, over = np.random.default_rng(0), 0
    for envs in (here, there):
        envs.begin(range(3))
    for k in range(30):
        which = [[2, 1, 0], [1], [0, 2]][k % 3]
        actions = rng.uniform(-1, 1, (len(which), here.action_size))
        a, b = (envs.step(actions, which) for envs in (here, there))
        for name in ("reward", "terminated", "truncated"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_array_equal(here.observation(), there.observation())
        assert here.pixels is None or np.array_equal(here.pixels.trust, there.pixels.trust)
        for i in range(3):
            np.testing.assert_array_equal(here.state(i), there.state(i))
            assert here.info(i) == there.info(i)
        ended = [i for i, end in zip(which, a.over, strict=True) if end]
        over += len(ended)
        if ended:
            for envs in (here, there):
                envs.seed(ended[0], 40 + k)
                envs.begin(ended)
    assert over > 1
    for envs in (here, there):
        envs.close()


def test_attributes_of_tasks_are_read_and_set_in_children(shared):
    shared.begin(range(3))
    before = shared.get(2, "time_limit")
    shared.set(2, "time_limit", before + 1.0)
    assert shared.get(2, "time_limit") == before + 1.0 and shared.get(1, "time_limit") == before
    assert shared.call(0, "action_spec", None) is not None
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        shared.get(0, "colour")
    shared.set(1, "episode_seed", 77)
    assert shared.info(1)["episode_seed"] == 77 and shared.get(-1, "time_limit") == before + 1.0  # and it goes on
    with pytest.raises(IndexError):
        shared.step(np.zeros((1, shared.action_size)), [3])


def test_seeds_of_gymnasium_are_numbers_or_one_per_environment(scene):
    envs = DriveVectorEnv(2, scene, "bend", processes=1, pixels=False, control_timestep=0.05)
    assert envs.metadata["render_fps"] == 20

    def episodes(seed) -> list[int]:
        return envs.reset(seed=seed)[1]["episode_seed"].tolist()

    assert episodes(np.int64(0)) == episodes(0) == episodes([0, 1]) == episodes(np.arange(2))
    assert episodes((0, None))[0] == episodes(0)[0] and episodes(None) != episodes(0)
    for seeds in ([1], [1, 2, 3]):
        with pytest.raises(InputError, match=f"{len(seeds)} seeds; expected 2, one per environment"):
            envs.reset(seed=seeds)
    with pytest.raises(InputError, match="0 environments; expected at least 1"):
        DriveVectorEnv(0, scene, "bend", pixels=False)


class _Foreign:
    """A class that no child process can import, since it belongs to this process's `__main__`."""


def test_unpicklable_requests_and_replies_raise(shared, monkeypatch):
    monkeypatch.setattr(_Foreign, "__module__", "__main__")
    monkeypatch.setattr(sys.modules["__main__"], "_Foreign", _Foreign, raising=False)
    with pytest.raises(AttributeError, match="_Foreign"):
        shared.set(0, "time_limit", _Foreign())
    shared.begin(range(3))  # and it goes on


def test_input_errors_pass_to_the_parent(scene):
    with pytest.raises(InputError, match="nowhere"):
        ProcessVectorEnv(scene, "nowhere", {"pixels": False}, [1, 2], 1)
    with pytest.raises(InputError, match="processes = 0"):
        make_vector_env(scene, "bend", {}, [1, 2], 0)
    with pytest.raises(InputError, match="did you mean 'lighting'"):
        ProcessVectorEnv(scene, "bend", {"lightning": "day"}, [1, 2], 1)


def test_a_process_that_dies_is_an_error_with_a_cure(spread):
    spread.begin(range(3))
    os.kill(spread._children[1].process.pid, signal.SIGKILL)
    with pytest.raises(InputError, match=r"exit status -9.*use fewer"):
        spread.step(np.zeros((3, spread.action_size)))
    with pytest.raises(InputError, match="make a new one"):
        spread.begin(range(3))


def test_interrupted_step_closes_the_environment(spread):
    """Ctrl-C in a notebook interrupts a step like this; a pending reply would be taken for the reply to the next
    request.
    """
    spread.begin(range(3))
    receive = _Child.receive
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(_Child, "receive", lambda child: (_ for _ in ()).throw(KeyboardInterrupt))
        spread.step(np.zeros((3, spread.action_size)))
    assert _Child.receive is receive
    with pytest.raises(InputError, match="make a new one"):
        spread.begin(range(3))
    spread.close()


def test_children_ignore_interrupts(shared):
    """A parent that saves its state on Ctrl-C or SIGTERM still needs the environments."""
    shared.begin(range(3))
    for child in shared._children:
        assert os.getpgid(child.process.pid) != os.getpgid(0)
        os.kill(child.process.pid, signal.SIGTERM)
    assert np.isfinite(shared.step(np.zeros((3, shared.action_size))).reward).all()


def test_children_end_with_their_parent(scene):
    """However the parent ends, and even if its script has no `if __name__ == "__main__"`."""
    script = f"""
        import os, signal
        from twin.env.vector_env import ProcessVectorEnv
        envs = ProcessVectorEnv({str(scene.scene.root)!r}, "bend", {{"pixels": False}}, [1, 2], 2)
        envs.begin([0, 1])
        fork = os.fork()
        if not fork:  # has the sockets, too, and outlives us
            os.close(1)
            os.close(2)
            signal.pause()
        print(fork, *(child.process.pid for child in envs._children), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True)
    fork, *children = [int(pid) for pid in done.stdout.split()]
    assert done.returncode == -signal.SIGKILL and len(children) == 2, done.stderr
    import psutil

    _, alive = psutil.wait_procs([psutil.Process(p) for p in children if psutil.pid_exists(p)], timeout=20)
    os.kill(fork, signal.SIGKILL)
    assert not alive


def test_close_does_not_wait_for_inherited_sockets(spread):
    """A process that was forked meanwhile has inherited the sockets."""
    held = [os.dup(child.pipe.fileno()) for child in spread._children]
    spread.close()
    assert all(child.process.poll() == -signal.SIGKILL for child in spread._children)
    for one in held:
        os.close(one)


def test_children_end_when_the_environment_is_deleted(scene):
    envs = ProcessVectorEnv(scene, "bend", {"pixels": False}, [1, 2], 1)
    processes = [child.process for child in envs._children]
    del envs
    gc.collect()
    assert all(process.poll() is not None for process in processes)


def test_default_number_of_processes(scene, monkeypatch):
    monkeypatch.setattr("twin.env.vector_env.available_cores", lambda: 4)
    options = {"pixels": False}
    for count, processes, kind in (
        (1, None, LocalVectorEnv),
        (3, None, LocalVectorEnv),
        (4, None, ProcessVectorEnv),
        (4, 1, LocalVectorEnv),
    ):
        envs = make_vector_env(scene, "bend", options, list(range(count)), processes)
        assert type(envs) is kind, (count, processes)
        if isinstance(envs, ProcessVectorEnv):
            assert len(envs._children) == 2
        envs.close()
