"""Random lightings: the rule accepts plausible embeddings and rejects others; samples are repeatable."""

import numpy as np
import pytest

from twin.errors import InputError
from twin.nerf import lightings as lightings_module
from twin.nerf.lightings import AppearancePrior, Lightings, Probes, picture_statistics

_LIFT = 20.0  # keeps the rectifiers of the made-up head open, so that it is linear


def probes(k: int = 300) -> Probes:
    """A place of random colors. Embedding: exposure, warmth, green, and how its left and right half differ."""
    rng = np.random.default_rng(0)
    first = np.zeros((15 + 16 + 4, 4), np.float32)
    first[:4, :4] = np.eye(4)
    first[31:, :3] = [[1, 1, 1], [1, 0, -1], [0, 1, 0], [0, 0, 0]]
    first[34, 3] = 1.0
    features = np.zeros((k, 15), np.float32)
    features[:, :3] = rng.normal(-0.5, 0.8, (k, 1)) + rng.normal(0.0, 0.3, (k, 3))
    features[:, 3] = np.where(np.arange(k) % 2, 0.0, -100.0)  # shuts the fourth unit in every other probe
    second, third = np.eye(4, dtype=np.float32), np.zeros((4, 3), np.float32)
    third[:3] = np.eye(3)
    third[3] = [1.0, -1.0, 1.0]
    head = {"head.0": first, "head.1": second, "head.2": third}
    head |= {"head.0.bias": np.array([_LIFT, _LIFT, _LIFT, 0.0], "f4"), "head.1.bias": np.zeros(4, "f4")}
    return Probes(features, np.zeros((k, 16), np.float32), head | {"head.2.bias": np.full(3, -_LIFT, "f4")})


def lightings(vectors: list[list[float]], frames: int = 12) -> Lightings:
    """Frames vary about the lightings in exposure and warmth, in turn."""
    v = np.array(vectors, np.float32)
    rng = np.random.default_rng(1)
    drift = rng.normal(size=(frames, 4)) * [0.2, 0.05, 0.0, 0.0]
    names = tuple(f"film{i}" for i in range(len(v)))
    frame_names = tuple(f"film{i % len(v)}/{i:06d}" for i in range(frames))
    frame_vectors = (v[np.arange(frames) % len(v)] + drift).astype(np.float32)
    return Lightings(names, v, frame_names, frame_vectors, probes())


DAY_AND_DUSK = [[0.8, 0.0, 0.0, 0.0], [-0.8, 0.4, 0.0, 0.0]]


def test_filmed_lightings_are_plausible():
    mine = lightings(DAY_AND_DUSK)
    for vector in (*mine.vectors, *mine.frame_vectors):
        assert mine.prior.violations(vector) == []


def test_samples_obey_the_rule_and_vary():
    mine = lightings(DAY_AND_DUSK)
    drawn = [mine.sample(np.random.default_rng(i)) for i in range(40)]
    pictures = np.array([mine.probes.picture(e) for e in drawn])
    for picture in pictures:
        off = mine.prior.color_error(picture)
        assert np.sqrt((off**2).mean()) <= 0.06
        assert (off > 0.2).mean() <= 0.02
    filmed = np.array([picture_statistics(mine.probes.picture(v)) for v in (*mine.vectors, *mine.frame_vectors)])
    margin = 0.02 + 0.1 * np.ptp(filmed, axis=0)
    got = np.array([picture_statistics(picture) for picture in pictures])
    assert (got >= filmed.min(0) - margin - 1e-6).all()
    assert (got <= filmed.max(0) + margin + 1e-6).all()
    brightness = np.ptp([mine.probes.picture(v).mean() for v in mine.vectors])
    assert np.ptp(pictures.mean((1, 2))) > 0.6 * brightness
    assert len({e.tobytes() for e in drawn}) == 40


@pytest.mark.parametrize(
    ("embedding", "fault"),
    [
        ([0.0, 0.2, 3.0, 0.0], "red cast"),
        ([6.0, 0.0, 0.0, 0.0], "brightness"),
        ([-6.0, 0.0, 0.0, 0.0], "brightness"),
        ([0.0, 0.2, 0.0, 3.0], "from any sum"),
    ],
)
def test_implausible_embeddings_are_rejected(embedding, fault):
    assert any(fault in found for found in lightings(DAY_AND_DUSK).prior.violations(np.array(embedding)))


def test_sums_of_lights_have_no_color_error():
    """A longer exposure and both lights at once are sums of lights; colors in another order of the probes are not."""
    mine = lightings(DAY_AND_DUSK)
    day, dusk = (mine.probes.picture(v) ** 2.2 for v in mine.vectors)
    assert mine.prior.color_error((0.3 * day + 0.9 * dusk) ** (1 / 2.2)).max() < 1e-3
    assert mine.prior.color_error((0.25 * day) ** (1 / 2.2)).max() < 1e-3
    assert np.sqrt((mine.prior.color_error(day[::-1] ** (1 / 2.2)) ** 2).mean()) > 0.1


def test_the_same_seed_gives_the_same_lighting():
    mine, again = lightings(DAY_AND_DUSK), lightings(DAY_AND_DUSK)
    for seed in range(5):
        a, b = mine.sample(np.random.default_rng(seed)), again.sample(np.random.default_rng(seed))
        assert np.array_equal(a, b)
    assert not np.array_equal(mine.sample(np.random.default_rng(0)), mine.sample(np.random.default_rng(1)))


def test_one_lighting_varies_as_its_frames_do():
    mine = lightings([[0.3, 0.0, 0.2, 0.0]])
    drawn = np.array([mine.sample(np.random.default_rng(i)) for i in range(40)]) - mine.vectors[0]
    assert np.allclose(drawn[:, 2:], 0.0, atol=1e-6)  # no frame differs in these
    assert drawn[:, 0].std() > 0.05
    still = Lightings(mine.names, mine.vectors, (), np.zeros((0, 4), np.float32), mine.probes)
    assert np.allclose(still.sample(np.random.default_rng(0)), mine.vectors[0])


def test_sampling_fails_with_a_reason(monkeypatch):
    mine = lightings(DAY_AND_DUSK)
    monkeypatch.setattr(AppearancePrior, "violations", lambda self, embedding: ["brightness 9 (filmed: 0 to 1)"])
    with pytest.raises(
        InputError, match=rf"among {lightings_module._MAX_TRIES} sampled; the last has brightness 9 .*nerf\.steps"
    ):
        mine.sample(np.random.default_rng(0))


def test_error_without_probes_names_the_baked_field():
    mine = lightings(DAY_AND_DUSK)
    bare = Lightings(mine.names, mine.vectors, mine.frames, mine.frame_vectors)
    with pytest.raises(InputError, match="use the baked one"):
        bare.sample(np.random.default_rng(0))
