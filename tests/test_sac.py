"""SAC on a task of one picture: the update, privileged critics, and resumption from saved states."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

import gymnasium
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from twin.errors import InputError
from twin.learn.policy import load_policy, save_policy
from twin.learn.policy_network import Architecture, normalize_colors, preprocess
from twin.learn.replay_buffer import FrameReplayBuffer
from twin.learn.sac import DrivePolicy, Encoder, PixelSAC, actor_weights, load_state, save_state
from twin.learn.train_config import TrainConfig

SIZE = (32, 18)
TINY = Architecture(SIZE, 2, 2, ((8, 5, 3),), 16, (32, 32), 1)


class SpotEnv(gymnasium.Env):
    """Shows a bright spot; the action that points at it has the highest reward. Every episode has 5 steps."""

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
        return normalize_colors(picture)


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
        replay_buffer_kwargs={"file": file, "slack": 500, "seed": seed, "state_size": states},
        state_scales=(1.0,) * states,
        policy_kwargs={
            "features_extractor_class": Encoder,
            "features_extractor_kwargs": {"architecture": TINY},
            "net_arch": [32, 32],
            "share_features_extractor": True,
            "normalize_images": False,
            "state_size": states,
        },
        seed=seed,
        device="cpu",
    )
    model.set_logger(configure(None, []))
    return model


@pytest.mark.parametrize("privileged", [False, True])
def test_the_policy_learns_and_its_file_acts_alike(tmp_path, privileged):
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
        np.testing.assert_array_equal(preprocess(large, 2), small)
        action = policy(large)
        steady = model.averaged_actor(torch.as_tensor(small[None]), deterministic=True)[0]
        np.testing.assert_allclose(action, steady.detach().numpy(), atol=1e-5)
        errors.append(abs(action[0] - (env.where / 7.0 - 1.0)))
        untrained.append(abs(env.where / 7.0 - 1.0))
    assert np.mean(errors) < 0.5 * np.mean(untrained)


def test_critics_receive_the_state_and_the_encoder_learns_to_predict_it():
    model = spot_model(privileged=True)
    inputs = [q[0].in_features for q in (*model.critic.q_networks, *model.critic_target.q_networks)]
    assert inputs == [TINY.features + 1 + 1] * 4 and model.actor.latent_pi[0].in_features == TINY.features
    env = SpotEnv()
    env.reset(seed=9)

    def error() -> float:
        out = []
        for _ in range(60):
            features = model.actor.features_extractor(torch.as_tensor(env._look()[None]))
            out.append(model.state_head(features).item() - env.state[0])
        return float(np.sqrt(np.mean(np.square(out))))

    before = error()
    model.learn(600)
    assert error() < 0.25 < before
    assert model.replay_buffer.states[:300].shape == (300, 2, 1)
    assert 0.15 < np.isnan(model.replay_buffer.states[:300]).mean() < 0.25  # the first of five, in these episodes


def test_critics_use_the_state():
    """All pictures are equal, so values can only depend on the state."""
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
        assert not torch.equal(before, q[0].weight[:, TINY.features])  # it has a gradient: the input is not zero


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


def test_scaled_weights_equal_scaled_pictures():
    encoder = Encoder(SpotEnv.observation_space, TINY)
    pictures = torch.randint(0, 256, (3, 6, 9, 16))
    plain = encoder.further(encoder.first(pictures / 255.0 - 0.5))
    expected = torch.tanh(encoder.norm(encoder.linear(plain)))
    torch.testing.assert_close(encoder(pictures.to(torch.uint8)), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("privileged", [False, True])
def test_a_saved_training_resumes_exactly(tmp_path, privileged):
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
    for a, b in zip(model.state_head.parameters(), again.state_head.parameters(), strict=True):
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
