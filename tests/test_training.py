"""Training runs: the update is SAC's, a run that was stopped goes on as if it had not been, and policies come out."""

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

import gymnasium
import torch
from gymnasium import spaces
from safetensors.torch import load_file
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv
from tiny_twin import tiny_twin

import twin
from twin import progress, train
from twin.env.randomisation import Ranges
from twin.errors import InputError
from twin.learn.architecture import Architecture, levelled, prepared
from twin.learn.choosing import FRESH
from twin.learn.policy import load_policy, save_policy
from twin.learn.replay import FrameReplayBuffer
from twin.learn.sac import DrivePolicy, Encoder, PixelSAC, actor_weights
from twin.learn.state import load_state, save_state
from twin.learn.train_config import TrainConfig
from twin.learn.training import EPISODE_COLUMNS, _check_same, _keep_rows
from twin.learn.vectors import DriveVecEnv
from twin.report.training import read_episodes
from twin.report.trials import csv_text
from twin.scene import write_json

SIZE = (32, 18)
TINY = Architecture(SIZE, 2, 2, ((8, 5, 3),), 16, (32, 32), 1)


class SpotEnv(gymnasium.Env):
    """A bright spot; the action that points at it is worth most. Every episode has 5 steps."""

    observation_space = spaces.Box(0, 255, (6, 9, 16), np.uint8)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._look(), {}

    def step(self, action):
        reward = 1.0 - abs(float(action[0]) - (self.where / 7.0 - 1.0))
        self.count += 1
        picture = self._look()
        unknown = np.full(1, np.nan, np.float32)  # where the next episode begins
        return picture, reward, False, self.count == 5, {"state": self.state, "first_state": unknown}

    def _look(self):
        self.where = int(self.np_random.integers(15))
        self.state = np.array([self.where / 7.0 - 1.0], np.float32)
        picture = np.zeros((6, 9, 16), np.uint8)
        picture[:, :, self.where : self.where + 2] = 255
        self.raw = picture
        return levelled(picture)


def spot_model(folder: Path | None = None, seed: int = 0, privileged: bool = False) -> PixelSAC:
    torch.set_num_threads(1)
    states = 1 if privileged else 0
    file = folder / "pictures.bin" if folder else None
    model = PixelSAC(
        DrivePolicy,
        DummyVecEnv([SpotEnv, SpotEnv]),
        learning_rate=3e-3,
        buffer_size=2000,
        learning_starts=100,
        batch_size=64,
        gamma=0.5,
        train_freq=1,
        gradient_steps=1,
        ent_coef="auto_0.1",
        replay_buffer_class=FrameReplayBuffer,
        replay_buffer_kwargs={"file": file, "slack": 500, "seed": seed, "states": states},
        states=(1.0,) * states,
        policy_kwargs={
            "features_extractor_class": Encoder,
            "features_extractor_kwargs": {"architecture": TINY},
            "net_arch": [32, 32],
            "share_features_extractor": True,
            "normalize_images": False,
            "states": states,
        },
        seed=seed,
        device="cpu",
    )
    model.set_logger(configure(None, []))
    return model


@pytest.mark.parametrize("privileged", [False, True])
def test_it_learns_to_point_and_its_file_does_the_same(tmp_path, privileged):
    model = spot_model(privileged=privileged)
    model.learn(1000)
    save_policy(tmp_path, TINY, TrainConfig().control, actor_weights(model, TINY), {})
    policy = load_policy(tmp_path)
    env = SpotEnv()
    env.reset(seed=9)
    errors, untrained = [], []
    for _ in range(50):
        small = env._look()
        large = env.raw.repeat(2, 1).repeat(2, 2)
        np.testing.assert_array_equal(prepared(large, 2), small)
        action = policy(large)
        steady = model.steady(torch.as_tensor(small[None]), deterministic=True)[0]
        np.testing.assert_allclose(action, steady.detach().numpy(), atol=1e-5)
        errors.append(abs(action[0] - (env.where / 7.0 - 1.0)))
        untrained.append(abs(env.where / 7.0 - 1.0))
    assert np.mean(errors) < 0.5 * np.mean(untrained)


def test_critics_are_told_the_state_and_the_encoder_learns_to_tell_it():
    model = spot_model(privileged=True)
    inputs = [q[0].in_features for q in (*model.critic.q_networks, *model.critic_target.q_networks)]
    assert inputs == [TINY.features + 1 + 1] * 4 and model.actor.latent_pi[0].in_features == TINY.features
    env = SpotEnv()
    env.reset(seed=9)

    def error() -> float:
        out = []
        for _ in range(60):
            features = model.actor.features_extractor(torch.as_tensor(env._look()[None]))
            out.append(model.teller(features).item() - env.state[0])
        return float(np.sqrt(np.mean(np.square(out))))

    before = error()
    model.learn(600)
    assert error() < 0.25 < before
    assert model.replay_buffer.states[:300].shape == (300, 2, 1)
    assert 0.15 < np.isnan(model.replay_buffer.states[:300]).mean() < 0.25  # the first of five, in these episodes


def test_critics_use_what_they_are_told():
    """Of pictures that are all alike, what is worth something can only be known from the state."""
    model = spot_model(privileged=True)
    model.learn(120)
    pictures = torch.zeros((64, 6, 9, 16), dtype=torch.uint8)
    features = model.actor.features_extractor(pictures).detach()
    states, actions = torch.linspace(-1, 1, 64)[:, None], torch.zeros((64, 1))
    values = torch.cat([q(torch.cat([features, states, actions], 1)) for q in model.critic.q_networks], 1)
    assert values.std(0).min() > 1e-4
    told = [q[0].weight[:, TINY.features].clone() for q in model.critic.q_networks]
    model.learn(60, reset_num_timesteps=False)
    for before, q in zip(told, model.critic.q_networks, strict=True):
        assert not torch.equal(before, q[0].weight[:, TINY.features])  # it has a gradient: the input is not nought


def test_the_encoder_learns_from_the_critics_alone():
    model = spot_model()
    encoder = list(model.actor.features_extractor.parameters())
    assert model.critic.features_extractor is model.actor.features_extractor
    owned = [
        {id(p) for group in optimizer.param_groups for p in group["params"]}
        for optimizer in (model.actor.optimizer, model.critic.optimizer)
    ]
    assert all(id(p) not in owned[0] and id(p) in owned[1] for p in encoder)
    model.learn(120)
    before = [p.clone() for p in encoder]
    for group in model.critic.optimizer.param_groups:
        group["lr"] = 0.0
    model.lr_schedule = lambda _: 0.0
    model.train(1, 64)
    assert all(torch.equal(a, b) for a, b in zip(before, encoder, strict=True))


def test_scaled_weights_are_scaled_pictures():
    encoder = Encoder(SpotEnv.observation_space, TINY)
    pictures = torch.randint(0, 256, (3, 6, 9, 16))
    plain = encoder.further(encoder.first(pictures / 255.0 - 0.5))
    expected = torch.tanh(encoder.norm(encoder.linear(plain)))
    torch.testing.assert_close(encoder(pictures.to(torch.uint8)), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("privileged", [False, True])
def test_a_saved_training_goes_on_as_if_never_stopped(tmp_path, privileged):
    """Updates after loading are, number for number, those of the model that was saved."""
    (tmp_path / "a").mkdir()
    model = spot_model(tmp_path / "a", privileged=privileged)
    model.learn(300)
    save_state(tmp_path / "a", model, {"wall": 3.0})
    at_saving = torch.get_rng_state()
    again = spot_model(tmp_path / "a", seed=77, privileged=privileged)
    assert load_state(tmp_path / "a", again) == {"wall": 3.0}
    assert (again.num_timesteps, again._n_updates) == (model.num_timesteps, model._n_updates)
    after_loading = torch.get_rng_state()
    again.train(5, 32)
    torch.set_rng_state(at_saving)
    model.train(5, 32)
    assert torch.equal(at_saving, after_loading)
    for (name, a), b in zip(model.policy.state_dict().items(), again.policy.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    for a, b in zip(model.teller.parameters(), again.teller.parameters(), strict=True):
        assert torch.equal(a, b)
    assert torch.equal(model.log_ent_coef, again.log_ent_coef)


def test_a_damaged_state_is_refused(tmp_path):
    model = spot_model(tmp_path)
    model.learn(120)
    save_state(tmp_path, model, {})
    (file,) = tmp_path.glob("state_*/tensors.safetensors")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        load_state(tmp_path, spot_model(tmp_path))
    file.write_bytes(whole)
    load_state(tmp_path, spot_model(tmp_path))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    progress.set_quiet(True)
    return tiny_twin(tmp_path_factory.mktemp("twin"))


SHORT = TrainConfig(
    task="ahead",
    lighting="day",
    steps=240,
    worlds=4,
    starts=40,
    batch=16,
    buffer=400,
    convolutions=((8, 8, 8),),
    features=16,
    hidden=(16,),
    save_every=80,
    checkpoints=3,
    updates=0.25,
)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_killed_at_random_three_times_comes_to_its_end(scene, tmp_path):
    """As a process, with SIGKILL: all steps are there, tables have no gap and nothing twice, and the policy drives."""
    folder = tmp_path / "run"
    code = (
        "import sys, dataclasses; sys.path.insert(0, sys.argv[3])\n"
        "from pathlib import Path; import twin\n"
        "from twin.learn.training import train\n"
        "from test_training import SHORT\n"
        "train(twin.load_scene(sys.argv[1]), Path(sys.argv[2]), SHORT)\n"
    )
    command = [sys.executable, "-c", code, str(scene), str(folder), str(Path(__file__).parent)]
    rng = np.random.default_rng(0)
    for wanted in sorted(rng.choice([1, 2], 3)):
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        while process.poll() is None and len(rows_of(folder)) < wanted:
            time.sleep(0.02)
        time.sleep(float(rng.uniform(0.0, 0.3)))
        process.send_signal(signal.SIGKILL)
        process.wait()
    done = subprocess.run(command, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    head = json.loads((folder / "state" / "state.json").read_text())
    assert head["steps"] == SHORT.steps
    steps = [int(r["step"]) for r in rows(folder / "episodes.csv")]
    assert steps == sorted(steps) and max(steps, default=0) <= SHORT.steps
    seeds = [r["seed"] for r in rows(folder / "episodes.csv")]
    assert len(set(seeds)) == len(seeds)
    assert [int(r["step"]) for r in rows(folder / "log.csv")] == [80, 160, 240]
    with np.load(folder / "state" / head["folder"] / "replay.npz") as data:
        assert data["age"].shape[0] == SHORT.buffer // SHORT.worlds
        assert (data["written"] >= SHORT.steps // SHORT.worlds).all()
    assert load_policy(folder)(np.zeros((12, 90, 160), np.uint8)).shape == (1,)
    assert len(list((folder / "checkpoints").iterdir())) >= 2
    assert load_file(folder / "state" / head["folder"] / "tensors.safetensors")


def rows_of(folder: Path) -> list[dict[str, str]]:
    return rows(folder / "log.csv") if (folder / "log.csv").exists() else []


def test_another_config_is_refused(scene, tmp_path):
    from twin.learn.training import train as run

    built = twin.load_scene(scene)
    run(built, tmp_path, replace(SHORT, steps=8))
    with pytest.raises(InputError, match=r"gamma = 0\.97"):
        run(built, tmp_path, replace(SHORT, gamma=0.9))
    run(built, tmp_path, replace(SHORT, steps=16))
    assert json.loads((tmp_path / "state" / "state.json").read_text())["steps"] == 16


def test_the_verb(scene, capsys):
    common = [str(scene), "--task", "ahead", "--quiet", "--worlds", "2"]
    assert train.main([*common, "--run", "one", "--steps", "4", "--observe", "simulator"]) == 0
    assert (scene / "runs/one/success.png").exists()
    assert load_policy(scene / "runs/one").trained["observe"] == "simulator"
    choice = json.loads((scene / "runs/one/choice.json").read_text())
    assert choice["steps"] == 4 and choice["chosen"]["trials"] == FRESH
    assert train.main([*common, "--run", "one", "--steps", "4", "--lighting", "day"]) == 2
    assert "error: " in capsys.readouterr().err
    assert train.main([*common, "--run", "two", "--lighting", "dusk"]) == 2
    assert "dusk" in capsys.readouterr().err


def test_a_finished_run_is_left_as_it_is(scene, tmp_path):
    from twin.learn.training import train as run

    built = twin.load_scene(scene)
    run(built, tmp_path, replace(SHORT, steps=8))
    before = {
        path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and "tensorboard" not in path.parts
    }
    for steps in (8, 4):
        run(built, tmp_path, replace(SHORT, steps=steps))
    assert before == {path: path.read_bytes() for path in before}


def test_nothing_is_noted_of_a_run_that_could_not_begin(scene, capsys):
    common = [str(scene), "--run", "typo", "--quiet", "--worlds", "2", "--steps", "4"]
    assert train.main([*common, "--task", "strait"]) == 2
    assert train.main([*common, "--task", "ahead", "--lighting", "dusk"]) == 2
    assert train.main([*common, "--task", "ahead"]) == 0
    assert capsys.readouterr().err.count("error: ") == 2


def test_the_last_policy_is_a_checkpoint(scene, tmp_path):
    from twin.learn.training import train as run

    run(twin.load_scene(scene), tmp_path, replace(SHORT, steps=80, checkpoints=2))
    assert [path.name for path in sorted((tmp_path / "checkpoints").iterdir())] == ["000000040", "000000080"]


def test_no_resumption_drives_what_validation_or_another_seed_drives(scene, tmp_path, monkeypatch):
    from twin.learn import training

    given, whole = [], training.PreparedVecEnv.seed

    def spy(worlds, seed):
        given.append(seed)
        return whole(worlds, seed)

    monkeypatch.setattr(training.PreparedVecEnv, "seed", spy)
    for seed in (0, 1):
        for steps in (8, 16, 24):
            training.train(twin.load_scene(scene), tmp_path / str(seed), replace(SHORT, seed=seed, steps=steps))
    assert len(given) == 12  # stable-baselines3 seeds with the run's seed before, which is without effect
    worlds = [seed + i for seed in given[1::2] for i in range(SHORT.worlds)]
    assert len(set(worlds)) == len(worlds)
    others = [range(100), *(range(k * 1_000_000, k * 1_000_000 + 100_000) for k in (1, 2, 3, 7))]
    assert not any(seed in few for seed in worlds for few in others)


def test_a_changed_road_is_another_run(scene, tmp_path):
    from twin.learn.training import train as run

    built, toml = twin.load_scene(scene), scene / "scene.toml"
    run(built, tmp_path, replace(SHORT, steps=8))
    text = toml.read_text()
    try:
        toml.write_text(text + '\n[[obstacle]]\nkind = "cone"\nstation = 2.0\n')
        with pytest.raises(InputError, match="obstacles changed"):
            run(built, tmp_path, replace(SHORT, steps=16))
    finally:
        toml.write_text(text)


@pytest.mark.parametrize(
    "wrong", [{"seed": -1}, {"steps": 0}, {"worlds": 0}, {"updates": 0.0}, {"colours": -1.0}, {"lighting": "held-out"}]
)
def test_what_no_training_can_be_is_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        TrainConfig(**wrong)


def test_a_run_that_is_asked_to_stop_saves_and_goes_on(scene, tmp_path):
    from twin.learn.training import train as run

    def interrupt(now) -> None:
        if now.steps == 120:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        run(twin.load_scene(scene), tmp_path, SHORT, interrupt)
    head = json.loads((tmp_path / "state" / "state.json").read_text())
    assert (head["steps"], head["replay"]["pos"]) == (120, 30)
    seen = []
    run(twin.load_scene(scene), tmp_path, SHORT, lambda now: seen.append(now.steps))
    assert seen[0] == 124 and seen[-1] == SHORT.steps


def test_arriving_is_worth_what_surviving_for_ever_would_be():
    config = TrainConfig()
    rewards = config.options()["rewards"]
    for_ever = sum(rewards.step * config.gamma**k for k in range(2000))
    assert rewards.step + rewards.goal == pytest.approx(for_ever)
    assert (rewards.collision, rewards.out_of_bounds) == (-4.0, -5.0)


def test_episodes_that_began_on_the_way_do_not_count(tmp_path):
    some = [("8", 1, "0.00"), ("16", 0, "7.50"), ("24", 0, "0.00"), ("32", 1, "0.10"), ("40", 1, "0.00")]
    rows = [[step, "1.0", "7", "training", str(won), "goal", "3.0", "8", "1.0", start] for step, won, start in some]
    (tmp_path / "episodes.csv").write_text(csv_text(EPISODE_COLUMNS, rows))
    steps, success = read_episodes(tmp_path)
    assert steps.tolist() == [8, 24, 40] and success.tolist() == [1, 0, 1]
    assert _keep_rows(tmp_path / "episodes.csv", EPISODE_COLUMNS, 32) == [True, False]
    assert (tmp_path / "episodes.csv").read_text().count("\n") == 5  # all that was driven is kept
    before = [row[:-1] for row in rows]  # as trainings of before wrote them
    (tmp_path / "episodes.csv").write_text(csv_text(EPISODE_COLUMNS[:-1], before))
    assert read_episodes(tmp_path)[1].tolist() == [1, 0, 0, 1, 1]


def test_a_run_of_an_earlier_version_is_told_to_be_one(tmp_path):
    write_json(tmp_path / "config.json", {"road": "x", "steps": 8})
    with pytest.raises(InputError, match="by an earlier version, which had no centring; give another --run"):
        _check_same(tmp_path, {"road": "x", "steps": 8, "centring": 1.0})
    _check_same(tmp_path, {"road": "x", "steps": 9})


def test_setups_vary_what_they_say():
    varied, day = TrainConfig().options(), TrainConfig(lighting="day").options()
    assert varied["randomise"] == Ranges() and TrainConfig(randomise=False).options()["randomise"] is None
    assert day["randomise"] == Ranges(extinction=(0.0, 0.0), shade=(0.0, 0.0), bystanders=(0, 0))
    assert TrainConfig(observe="simulator").options()["randomise"] == day["randomise"]
    assert varied["rewards"].cross_track == -varied["rewards"].step and varied["start_along"] > 0.0
    assert varied["rewards"].steering == -0.5 * varied["rewards"].step
    assert len(TrainConfig().states) == 7 and TrainConfig(privileged=False).states == ()


def test_states_are_what_the_world_tells(scene):
    """Also of an episode's first picture, which comes with the last of the episode before."""
    env = DriveVecEnv(scene, "ahead", 2, seed=3, lighting="day", time_limit=0.5, action="steering")
    env.reset()
    for _ in range(4):
        *_, done, infos = env.step(np.array([[0.5], [-0.5]], np.float32))
        assert not done.any() and all("first_state" not in info for info in infos)
        for i, info in enumerate(infos):
            assert info["state"].shape == (len(TrainConfig().states),)
            assert info["state"][2] == pytest.approx(info["cross_track"], abs=1e-6)
            assert info["state"][0] == pytest.approx(info["speed"], abs=1e-6)
            assert np.sign(info["state"][1]) == (1, -1)[i]
    *_, done, infos = env.step(np.zeros((2, 1), np.float32))
    assert done.all()
    for i, info in enumerate(infos):
        assert info["state"][2] == pytest.approx(info["cross_track"], abs=1e-6)
        assert info["first_state"][2] == pytest.approx(float(env.worlds.tasks[i].cross_track), abs=1e-6)
        assert info["first_state"][0] == pytest.approx(0.0, abs=1e-3) and info["state"][0] > 0.1
    env.close()
