"""Cross-lighting control: filmed places shown under the lightings they were *not* filmed in.

A *pose* is that of a training frame, with the lighting it was filmed in. It is *shown* under every lighting, and what
counts is the picture's mean colour (RGB in [0, 1], over the pixels that are not masked). No film shows the same place
at the same time under two lightings, so the reference is the film's frame of the shown lighting that was taken nearest.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import Cameras, nearest_frame
from twin.nerf.dataset import load_frame
from twin.nerf.rendering import Field
from twin.progress import track

Array = NDArray[np.float64]

_POSES = 60  # in all, spread evenly over each lighting's frames
_WIDTH = 96  # [px] longer side of the pictures
_DIGITS = 4


def cross_lighting(field: Field, cameras: Cameras, most: int = _POSES, width: int = _WIDTH) -> dict[str, Any] | None:
    """How the training poses look under every lighting, and whether the depth stays; None with less than two lightings.

    Keys, colours (r, g, b), distances between colours Euclidean in RGB:

    * `poses`: how many were rendered, under every lighting each.
    * `filmed_colour[i]`: mean colour of the film at the poses of lighting i.
    * `mean_colour[i][j]`: mean colour of the poses of lighting i, shown under j.
    * `to_shown_rms[j]`: of poses filmed under others and shown under j, the rms distance to `filmed_colour[j]`.
    * `to_filmed_rms[j]`: of the same pictures, to `filmed_colour` of the lighting their pose was filmed in.
    * `colour_follows[j]`: share of the same pictures that are nearer to the film's nearest frame of j than to the film
      at their own pose. 1 where the light asked for decides the colour, 0 where the pose does. A tie counts one half,
      so lightings that do not differ come to about one half.
    * `follows_by_pair[i][j]`: the same, of the poses of lighting i alone.
    * `depth_moves_m`: the greatest change of any pixel's depth between any two lightings [m]. Depth has no lighting in
      it, so this is 0 by construction; it is measured all the same.
    """
    trained = cameras.select(~cameras.held_out)
    lightings = [name for name in field.lightings if name in trained.lightings]
    if len(lightings) < 2:
        return None

    @cache
    def filmed(i: int) -> Array:
        image, mask, _ = load_frame(trained, i, width)
        return mean_colour(image / 255.0, mask)

    poses = []
    for name in lightings:
        mine = [i for i, light in enumerate(trained.lightings) if light == name]
        some = np.unique(np.linspace(0, len(mine) - 1, max(1, most // len(lightings))).round().astype(int))
        poses += [mine[k] for k in some]
    light = np.array([lightings.index(trained.lightings[i]) for i in poses])
    shown = np.empty((len(poses), len(lightings), 3))
    moves = 0.0
    for row, i in enumerate(track(poses, "poses under every lighting", unit="pose")):
        mask = load_frame(trained, i, width)[1]
        views = [field.render(trained.select(np.array([i])), name, mask.shape[::-1]) for name in lightings]
        shown[row] = [mean_colour(view.rgb[0], mask) for view in views]
        moves = max(moves, float(np.ptp([view.depth[0] for view in views], axis=0).max()))
    own = np.array([filmed(i) for i in poses])
    film = np.array([own[light == j].mean(0) for j in range(len(lightings))])
    out: dict[str, Any] = {
        "poses": len(poses),
        "filmed_colour": {name: rounded(film[j]) for j, name in enumerate(lightings)},
        "mean_colour": {
            name: {other: rounded(shown[light == i, j].mean(0)) for j, other in enumerate(lightings)}
            for i, name in enumerate(lightings)
        },
    }
    columns: dict[str, dict[str, float]] = {"to_shown_rms": {}, "to_filmed_rms": {}, "colour_follows": {}}
    pairs: dict[str, dict[str, float]] = {name: {} for name in lightings}
    for j, name in enumerate(lightings):
        rows = np.flatnonzero(light != j)
        there = np.array([filmed(nearest(trained, poses[row], name)) for row in rows])
        # Differences below a thousandth of a byte are a tie: only rounding would decide it.
        nearer = np.round(off(shown[rows, j], own[rows]) - off(shown[rows, j], there), 6)
        columns["to_shown_rms"][name] = rms(off(shown[rows, j], film[j]))
        columns["to_filmed_rms"][name] = rms(off(shown[rows, j], film[light[rows]]))
        follows = 0.5 + 0.5 * np.sign(nearer)
        columns["colour_follows"][name] = round(float(follows.mean()), _DIGITS)
        for i in np.unique(light[rows]):
            pairs[lightings[i]][name] = round(float(follows[light[rows] == i].mean()), _DIGITS)
    return out | columns | {"follows_by_pair": pairs, "depth_moves_m": moves}


def mean_colour(image: NDArray, mask: NDArray[np.bool_]) -> Array:
    """Mean of an image (h, w, 3) where the mask (h, w) is true, shape (3,); of all of it where it is true nowhere."""
    return np.asarray(image[mask] if mask.any() else image.reshape(-1, 3), np.float64).mean(0)


def nearest(cameras: Cameras, i: int, lighting: str) -> int:
    """The frame of a lighting, which there is, that was taken nearest to frame i."""
    found = nearest_frame(cameras, i, lighting)
    assert found is not None
    return found


def off(a: Array, b: Array) -> Array:
    """Distances between colours, shapes (n, 3) and (n, 3) or (3,) → (n,)."""
    return np.linalg.norm(a - b, axis=-1)


def rms(values: Array) -> float:
    return round(float(np.sqrt((values**2).mean())), _DIGITS)


def rounded(colour: Array) -> list[float]:
    return [round(float(value), _DIGITS) for value in colour]
