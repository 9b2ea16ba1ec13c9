"""Picture of the ground from above, the texture of MuJoCo's ground. It is composed of renderings at filmed poses.

A texel takes its color from the pose that has it ahead, at the distance nearest to `_BEST_DISTANCE`.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from twin import runtime
from twin.assets.ground import Ground
from twin.geometry.cameras import Cameras, project, scaled_intrinsics
from twin.nerf.rendering import RenderableField

_TEXEL = 0.025  # [m] side of a texel
_BEST_DISTANCE = 3.5  # [m] horizontal, from the lens to a texel; nearer texels are seldom in the image
_MAX_DISTANCE = 12.0  # [m]; farther ground keeps its mean color
_WIDTH = 640  # [px] width of the renderings
_MAX_TEXELS = 12_000_000
_DEPTH_TOLERANCE = 0.15  # a texel is visible if its depth differs from the rendered one by a smaller fraction


def ground_picture(field: RenderableField, cameras: Cameras, ground: Ground, lighting: str) -> NDArray[np.uint8]:
    """Colors of the ground under one lighting, shape (rows · k, columns · k, 3). The height field has rows × columns
    cells of k² texels each. Row 0 is at the lowest y. Texels that no pose sees well have the ground's mean color."""
    rows, columns = (n - 1 for n in ground.height.shape)
    k = max(1, round(ground.cell / _TEXEL))
    while k > 1 and rows * columns * k * k > _MAX_TEXELS:
        k -= 1
    cells = ground.rgb.astype(np.uint16)
    cells = (cells[1:, 1:] + cells[1:, :-1] + cells[:-1, 1:] + cells[:-1, :-1] + 2) // 4
    picture = np.repeat(np.repeat(cells.astype(np.uint8), k, 0), k, 1)
    step = ground.cell / k
    best = np.full(picture.shape[:2], np.inf, np.float32)
    trained = cameras.select(np.flatnonzero([name == lighting for name in cameras.lightings]))
    reach = int(np.ceil(_MAX_DISTANCE / step))
    with runtime.bar("ground picture", len(trained), "view") as bar:
        for i in range(len(trained)):
            bar.update()
            pose = trained.camera_to_world[i]
            column, row = np.floor((pose[:2, 3] - ground.origin) / step).astype(int)
            low = max(0, row - reach), max(0, column - reach)
            window = slice(low[0], max(0, row + reach)), slice(low[1], max(0, column + reach))
            v, u = np.indices(best[window].shape) + np.array(low)[:, None, None]
            xy = ground.origin + (np.stack([u, v], -1) + 0.5) * step
            distance = np.linalg.norm(xy - pose[:2, 3], axis=-1)
            ahead = ((xy - pose[:2, 3]) @ pose[:2, 2]) > 0.5 * distance
            cost = np.abs(np.log(np.maximum(distance, 1e-3) / _BEST_DISTANCE)).astype(np.float32)
            at = np.flatnonzero((ahead & (distance < _MAX_DISTANCE) & (cost < best[window])).ravel())
            if not len(at):
                continue
            points = np.concatenate([xy.reshape(-1, 2)[at], ground.at(xy.reshape(-1, 2)[at])[:, None]], 1)
            native = int(trained.sizes[i, 0]), int(trained.sizes[i, 1])
            size = _WIDTH, max(2, round(_WIDTH * native[1] / native[0]))
            intrinsics = scaled_intrinsics(trained.intrinsics[i], native, size)
            pixel, depth = project(points, pose, intrinsics)
            inside = (pixel > 0.5).all(1) & (pixel < np.array(size) - 0.5).all(1) & (depth > 0.1)
            if not inside.any():
                continue
            shown = field.render(trained.select(np.array([i])), lighting, size)
            at, pixel, depth = at[inside], pixel[inside], depth[inside]
            seen = shown.depth[0][tuple(pixel.astype(int).T[::-1])]
            visible = np.abs(seen / depth - 1.0) < _DEPTH_TOLERANCE
            across = pixel[visible].T[::-1] - 0.5
            colors = np.stack([map_coordinates(shown.rgb[0, ..., c], across, order=1) for c in range(3)], -1)
            where = np.unravel_index(at[visible], best[window].shape)
            picture[window][where] = np.clip(colors * 255.0 + 0.5, 0, 255).astype(np.uint8)
            best[window][where] = cost.ravel()[at[visible]]
    return picture
