"""Color augmentation: equal within a stack, different between samples, absent at strength 0."""

from itertools import pairwise

import numpy as np

from twin.learn.replay_buffer import draw_color_changes


def augment_colors(stacks: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    return draw_color_changes(len(stacks), stacks.shape[2:], strength, rng).applied(stacks)


def stacks(count: int = 6) -> np.ndarray:
    picture = np.random.default_rng(0).integers(40, 200, (3, 18, 32), np.uint8)
    return np.repeat(np.tile(picture, (4, 1, 1))[None], count, 0)


def test_strength_zero_changes_nothing():
    before = stacks()
    np.testing.assert_array_equal(augment_colors(before, 0.0, np.random.default_rng(1)), before)


def test_augmentation_is_shared_within_a_stack():
    before = stacks()
    after = augment_colors(before, 1.0, np.random.default_rng(1))
    assert after.shape == before.shape and after.dtype == np.uint8
    for stack in after:
        for later in stack.reshape(4, 3, 18, 32)[1:]:
            np.testing.assert_array_equal(later, stack[:3])
    assert all((a != b).mean() > 0.5 for a, b in pairwise(after))
    assert len({stack.tobytes() for stack in after}) == len(after)


def test_edges_become_sharper_or_softer_and_uniform_areas_stay_uniform():
    edge = np.full((3, 18, 32), 100, np.uint8)
    edge[..., 16:] = 140
    changes = draw_color_changes(400, (18, 32), 1.0, np.random.default_rng(5))
    plain = changes._replace(
        curves=np.broadcast_to(np.arange(256, dtype=np.uint8), changes.curves.shape).copy(),
        knots=np.ones_like(changes.knots),
        covers=np.zeros_like(changes.covers),
    )
    after = plain.applied(np.repeat(np.tile(edge, (4, 1, 1))[None], 400, 0)).astype(int)
    assert (after[..., :14] == 100).all() and (after[..., 18:] == 140).all()
    step = (after[..., 16] - after[..., 15])[:, 0, 0]
    # The step is 40 before, a third of it with the strongest blur, and 7/3 of it with the strongest sharpening.
    assert step.min() in range(13, 17) and step.max() in range(91, 95)
    assert 0.27 < (step < 40).mean() < 0.4


def test_augmentation_is_unbiased_and_repeats_with_the_seed():
    before = stacks(200)
    after = augment_colors(before, 1.0, np.random.default_rng(2))
    np.testing.assert_array_equal(after, augment_colors(before, 1.0, np.random.default_rng(2)))
    means = after.reshape(200, 4, 3, -1).mean((1, 3))
    assert abs(means.mean() - before.mean()) < 0.15 * before.mean()
    assert 10.0 < means.mean(1).std() < 60.0  # brightness differs
    assert (means[:, 0] - means[:, 2]).std() > 3.0  # and so does tint


def test_rectangles_of_one_color_cover_some_stacks():
    """Noise has no color twice, so repeated colors are rectangles."""
    picture = np.random.default_rng(3).integers(60, 190, (3, 45, 80), np.uint8)
    before = np.repeat(np.tile(picture, (4, 1, 1))[None], 200, 0)
    shares = []
    for stack in augment_colors(before, 1.0, np.random.default_rng(4)):
        pixels = stack[:3].reshape(3, -1).T
        pixels = pixels[((pixels > 0) & (pixels < 255)).all(1)]  # not what is merely too dark or too bright
        _, counts = np.unique(pixels, axis=0, return_counts=True)
        shares.append(counts.max() / (45 * 80))
    covered = np.array(shares) > 0.01
    assert 0.6 < covered.mean() < 0.9  # three of four
    assert 0.02 < np.mean(shares) < 0.2 and max(shares) < 0.3
