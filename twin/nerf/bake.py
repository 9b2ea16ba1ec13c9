"""Bakes a radiance field: samples it into bricks around surfaces, fine-tunes and quantizes the samples.

`kernels/bricks.py` defines the terms. Fine-tuning fits the samples to the training frames; networks and embeddings stay
fixed.
"""

import time
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.cameras import evenly_spaced, pixel_grid
from twin.nerf import network
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import BakedSection, BrickLayout, brick_indices, skip_distances
from twin.nerf.buffers import (
    CameraArrays,
    Workspace,
    in_batches,
    parallel,
    part_count,
    shard_count,
    single_threaded_torch,
    warp_view,
)
from twin.nerf.dataset import TrainingPixels
from twin.nerf.field import QUERY_POINTS, FieldSection, RadianceField
from twin.nerf.kernels import bricks as kernels
from twin.nerf.kernels import volume
from twin.runtime import bar
from twin.warp_runtime import wp

_RAYS = 4096  # rays per step of fine-tuning
_VIEWS = 64  # greatest number of training views, evenly spaced, in which surfaces are searched
_VIEW_WIDTH = 112  # [px] width of these views
_SAMPLES = 24  # samples per ray
_MIN_WEIGHT = 0.004  # a sample with a greater compositing weight lies on a surface
_MIN_CELL = 0.03  # [m] least side of near cells
_COARSENING = 1.15  # least growth of cells per attempt to fit `max_bricks`
_LARGE_CELL = 0.15  # [m] if near cells are larger, _EXTRA_BRICKS times as many bricks are allowed; renders 7 % slower
_EXTRA_BRICKS = 1.39
_FAR_CELL_RATIO = 4.0  # side of far cells / side of near cells
_EMPTY_RAW_DENSITY = -8.0  # raw density outside all bricks
_RAW_RANGE = (-6.0, 12.0)  # raw densities that a byte covers
_CLIPPED_SHARE = 2e-4  # share of feature values clipped at each end of a byte's range
_RATES = (0.05, 0.02)  # learning rates of raw density and features
_PROBES = 1024  # rays for the prior of random lightings, see `lightings.py`


def bake(
    field: RadianceField, pixels: TrainingPixels, seed: int = 0, steps: int = 300, max_bricks: int = 9000
) -> tuple[BakedField, dict[str, Any]]:
    """Bakes a trained field; returns the baked field and a summary.

    Args:
        field: A trained field.
        pixels: The frames that the field was trained on.
        seed: Seed of the fine-tuning batches.
        steps: Fine-tuning steps, at least 1.
        max_bricks: In each section, cells grow until there are at most this many bricks (9,000 are 105 MB), or
            `_EXTRA_BRICKS` times as many if cells would exceed `_LARGE_CELL`, as in a long section.

    Raises:
        InputError: no training camera sees a surface in the field.
    """
    began = time.perf_counter()
    sections, facts = [], []
    for k, frames in enumerate(field.road.frames(pixels.cameras.positions)):
        section, about = _bake_section(field, k, pixels.of_frames(frames), seed + k, steps, max_bricks)
        sections.append(section)
        facts.append(about)
    networks = {
        f"network.{k}": v.detach().cpu().numpy() for k, v in field.parameters.items() if not k.startswith("trunk")
    }
    networks |= _probes(field, pixels, seed)
    baked = BakedField(sections, field.appearance.named(), networks, field.device, field.road)
    return baked, {
        "bricks_near": sum(one["bricks_near"] for one in facts),
        "bricks_far": sum(one["bricks_far"] for one in facts),
        "cell_m": max(one["cell_m"] for one in facts),
        "bytes": baked.bytes,
        "fine_tune_psnr": float(np.mean([one["fine_tune_psnr"] for one in facts])),
        "seconds": time.perf_counter() - began,
    }


def _bake_section(
    field: RadianceField, k: int, pixels: TrainingPixels, seed: int, steps: int, max_bricks: int
) -> tuple[BakedSection, dict[str, Any]]:
    """Bakes section k from the pixels that train it, see `bake`."""
    section = field.sections[k]
    near, far = _surface_positions(section, pixels)
    if not len(near) and not len(far):
        raise InputError(
            "no training camera sees anything in the trained field, so there is nothing to bake; raise nerf.steps; if "
            "nerf.near_plane or nerf.near_half_extent was changed, restore its default"
        )
    layout, slots = _layout(section, near, far, max_bricks)
    if layout.near_side.max() / kernels.CELLS > _LARGE_CELL:
        layout, slots = _layout(section, near, far, round(_EXTRA_BRICKS * max_bricks))
    values = _sample_bricks(section, layout, slots)
    psnr = _FineTuner(field, section, pixels, layout, slots, values, steps, seed).run()
    return BakedSection(layout, _quantized(values, slots, layout)), {
        "bricks_near": len(slots[0]),
        "bricks_far": len(slots[1]),
        "cell_m": float(layout.near_side.max()) / kernels.CELLS,
        "fine_tune_psnr": psnr,
    }


def _surface_positions(
    section: FieldSection, pixels: TrainingPixels
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Grid positions of surface samples seen by the training cameras, (a, 3) in the near box and (b, 3) outside."""
    cameras = CameraArrays(pixels.cameras.camera_to_world, pixels.intrinsics, section.device)
    frames = pixels.frames[evenly_spaced(len(pixels.frames), _VIEWS)]
    spots: list[tuple[NDArray, NDArray]] = [(np.zeros((0, 3), "f4"),) * 2] * len(frames)

    with bar("finding surfaces", len(spots), "view") as progress:

        @torch.no_grad()
        def find(k: int) -> None:
            i = int(frames[k])
            width = min(_VIEW_WIDTH, int(pixels.width[i]))
            height = max(1, round(width * pixels.height[i] / pixels.width[i]))
            pixel = (pixel_grid(width, height) * (pixels.width[i] / width)).reshape(-1, 2)
            n = width * height
            with section.workspace(n, _SAMPLES) as ws:
                ws.camera.fill_(i)
                ws.pixel.copy_(torch.as_tensor(pixel.astype(np.float32)))
                section.cast(ws, cameras, 0, n)
                section.sample(ws, 0, n, 0.02)
                section.query(ws, 0, n * _SAMPLES)
                section.composite(ws, 0, n)
                seen = ws.positions[: n * _SAMPLES][ws.weights.reshape(-1) > _MIN_WEIGHT].cpu().numpy()
            inside = ((seen >= 0.25) & (seen < 0.75)).all(1)
            spots[k] = seen[inside].copy(), seen[~inside].copy()
            progress.update()

        with single_threaded_torch():
            parallel(find, range(len(spots)), section.device)
    return np.concatenate([a for a, _ in spots]), np.concatenate([b for _, b in spots])


def _layout(
    section: FieldSection, near: NDArray, far: NDArray, max_bricks: int
) -> tuple[BrickLayout, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The finest layout with at most `max_bricks` bricks around surfaces, and the near and far bricks, each (s, 3)."""
    half = np.array(section.layout.half)
    cell = _MIN_CELL
    while True:
        near_shape = np.maximum(np.ceil(2 * half / (cell * kernels.CELLS)), 1).astype(int)
        far_shape = np.maximum(np.ceil(4 * half / (cell * _FAR_CELL_RATIO * kernels.CELLS)), 4).astype(int)
        slots = _bricks_around(near * 2.0 - 0.5, near_shape), _bricks_around(far, far_shape)
        # Far bricks wholly inside the near box are dropped, as near bricks cover that space.
        low, high = slots[1] / far_shape, (slots[1] + 1) / far_shape
        slots = slots[0], slots[1][~((low >= 0.25) & (high <= 0.75)).all(1)]
        count = sum(map(len, slots))
        if count <= max_bricks:
            break
        cell *= max(_COARSENING, (count / max_bricks) ** 0.4)
    shapes = [tuple(int(x) for x in shape) for shape in (near_shape, far_shape)]
    layout = BrickLayout(
        *(section.layout.centre, section.layout.half, section.layout.near_plane, section.layout.density_unit),
        *shapes,  # type: ignore[arg-type]
    )
    return layout, slots


def _bricks_around(spots: NDArray, shape: NDArray) -> NDArray[np.int64]:
    """Sorted bricks (s, 3) that contain one of the positions in [0, 1)³ or are less than a cell away from one."""
    marked = np.zeros(shape, bool)
    at = spots * shape
    margin = 1.0 / kernels.CELLS
    for corner in np.ndindex(2, 2, 2):
        index = np.floor(at + margin * (2 * np.array(corner) - 1)).astype(np.int64)
        index = np.clip(index, 0, shape - 1)
        marked[tuple(index.T)] = True
    return np.argwhere(marked)


def _sample_bricks(section: FieldSection, layout: BrickLayout, slots: tuple[NDArray, NDArray]) -> torch.Tensor:
    """Raw densities and features of the field at all brick samples, shape (s, 729, CHANNELS)."""
    grid = np.stack(np.meshgrid(*[np.arange(kernels.CORNERS)] * 3, indexing="ij"), -1).reshape(-1, 3) / kernels.CELLS
    near = (slots[0][:, None] + grid) / np.array(layout.near_shape) * 0.5 + 0.25
    far = (slots[1][:, None] + grid) / np.array(layout.far_shape)
    positions = np.concatenate([near.reshape(-1, 3), far.reshape(-1, 3)]).astype(np.float32).clip(0.0, 1.0 - 1e-6)
    values = torch.empty(len(positions), volume.CHANNELS, device=section.device)

    def query(rows: slice) -> None:
        n = rows.stop - rows.start
        with section.workspace(0, 1, QUERY_POINTS) as ws:
            ws.positions[:n] = torch.as_tensor(positions[rows], device=section.device)
            section.query(ws, 0, n)
            values[rows] = ws.outputs[:n]

    in_batches(query, len(positions), QUERY_POINTS, section.device)
    values[:, 0].clamp_(*_RAW_RANGE)
    return values.view(-1, kernels.SAMPLES, volume.CHANNELS)


class _FineTuner:
    """Fits brick samples to the training frames by gradient descent through the renderer."""

    def __init__(
        self,
        field: RadianceField,
        section: FieldSection,
        pixels: TrainingPixels,
        layout: BrickLayout,
        slots: tuple[NDArray, NDArray],
        values: torch.Tensor,
        steps: int,
        seed: int,
    ):
        self.field, self.section, self.pixels = field, section, pixels
        self.steps, self.values, self.seed = steps, values, seed
        device = field.device
        self.index: Any = kernels.BrickIndex()
        near, far = brick_indices(layout, *slots)
        self.index.near = wp.array(near, dtype=wp.int32, device=device)
        self.index.far = wp.array(far, dtype=wp.int32, device=device)
        self.gradient, self.second = torch.zeros_like(values), torch.zeros(*values.shape[:2], 2, device=device)
        self.w_values, self.w_gradient = warp_view(values, volume.Channels), warp_view(self.gradient, volume.Channels)
        self.w_second = warp_view(self.second, wp.vec2f)
        self.shards, self.parts = shard_count(device), part_count(device)
        self.rays = -(-_RAYS // self.shards) * self.shards
        self.ws = Workspace(section.layout, self.rays, _SAMPLES, device, training=True)
        self.cameras = CameraArrays(pixels.cameras.camera_to_world, pixels.intrinsics, device)

    def run(self) -> float:
        """Tunes the values in place; returns the PSNR [dB] over the last tenth of the batches."""
        rng = np.random.default_rng([self.seed, 5])
        errors: list[torch.Tensor] = []
        with bar("fine-tuning", self.steps, "step") as progress, single_threaded_torch():
            for step in range(self.steps):
                batch = self.pixels.batch(rng, self.shards, 0, self.rays // self.shards, 0)
                self.ws.camera.copy_(torch.from_numpy(batch.frame))
                self.ws.pixel.copy_(torch.from_numpy(batch.pixel))
                self.ws.targets.zero_()
                color = torch.from_numpy(batch.color).to(self.field.device)
                decay = 0.05 ** (step / self.steps)

                backward = partial(self._backward, color=color, step=step)
                squared = parallel(backward, range(self.shards), self.field.device)
                errors.append(torch.stack(squared))
                parallel(partial(self._update, rate=decay, step=step), range(self.parts), self.field.device)
                progress.update()
        last = torch.stack(errors[-max(1, self.steps // 10) :]).tolist()
        return float(-10 * np.log10(np.mean([sum(shards) / self.shards for shards in last])))

    def _backward(self, shard: int, color: torch.Tensor, step: int) -> torch.Tensor:
        f, s, ws = self.field, self.section, self.ws
        count = self.rays // self.shards
        start = shard * count
        rays = slice(start, start + count)
        s.cast(ws, self.cameras, start, count)
        s.sample(ws, start, count, 0.02, seed=self.seed * 1_000_003 + step)
        inputs = [ws.w_positions, self.index, self.w_values, _EMPTY_RAW_DENSITY, start * _SAMPLES]
        wp.launch(kernels.interpolate, count * _SAMPLES, inputs, [ws.w_outputs], device=f.device)
        s.composite(ws, start, count)
        composited = ws.composited[rays].detach().requires_grad_(True)
        harmonics = network.spherical_harmonics(ws.directions[rays])
        features = network.ray_features(f.parameters, composited, harmonics)
        embedding = f.appearance.of_frames(ws.camera[rays].long())
        error = network.head(f.parameters, features, harmonics, embedding) - color[rays]
        loss = torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.1) / self.shards
        (gradient,) = torch.autograd.grad(loss, [composited])
        with torch.no_grad():
            ws.composited_grad[rays] = gradient
            ws.inverse_grad[rays] = 0.0
            s.composite_backward(ws, start, count)
        return (error.detach() ** 2).mean()

    def _update(self, part: int, rate: float, step: int) -> None:
        n, device = self.rays * _SAMPLES, self.field.device
        gradients = [self.ws.w_positions, self.index, self.ws.w_outputs_grad, part, self.parts]
        wp.launch(kernels.interpolate_backward, n, [*gradients, self.w_gradient], device=device)
        rates = volume.Channels(_RATES[0] * rate, *[_RATES[1] * rate] * (volume.CHANNELS - 1))
        adam = [rates, 1.0 / (1.0 - 0.99 ** (step + 1)), self.w_values, self.w_gradient, self.w_second]
        if device == "cpu":
            wp.launch(kernels.adam_step, n, [*gradients, *adam], device=device)
        else:
            wp.launch(kernels.adam_step_everywhere, self.w_values.shape, adam, device=device)


def _probes(field: RadianceField, pixels: TrainingPixels, seed: int) -> dict[str, NDArray]:
    """Random rays through the training frames, as arrays of `lightings.Probes`."""
    rng = np.random.default_rng([seed, 6])
    frame = np.linspace(0, len(pixels.cameras) - 1, _PROBES).round().astype(int)
    pixel = rng.random((_PROBES, 2)) * np.stack([pixels.width, pixels.height], 1)[frame]
    cameras = CameraArrays(pixels.cameras.camera_to_world, pixels.intrinsics, field.device)
    features, harmonics, _, _ = field.trace(cameras, frame, pixel)
    return {"probes.features": features.cpu().numpy(), "probes.harmonics": harmonics.cpu().numpy()}


def _quantized(values: torch.Tensor, slots: tuple[NDArray, NDArray], layout: BrickLayout) -> dict[str, NDArray]:
    """The arrays of a `BakedSection`, with values as bytes. Overwrites `values`."""
    flat = values.view(-1, volume.CHANNELS)
    dense = torch.nonzero(flat[:, 0] > 0.0)[:, 0]
    some = flat[dense[:: max(1, len(dense) // 200_000)] if len(dense) else slice(None, None, 100)].cpu().numpy()
    low, high = np.quantile(some, [_CLIPPED_SHARE, 1.0 - _CLIPPED_SHARE], axis=0).astype(np.float32)
    low[0], high[0] = _RAW_RANGE
    step = (np.maximum(high - low, 1e-6) / 255.0).astype(np.float32)
    flat.sub_(torch.as_tensor(low, device=flat.device)).div_(torch.as_tensor(step, device=flat.device))
    codes = flat.round_().clamp_(0, 255).to(torch.uint8).view(values.shape).cpu().numpy()
    arrays: dict[str, NDArray] = {
        "near": slots[0].astype(np.int32),
        "far": slots[1].astype(np.int32),
        "features": codes,
        "low": low,
        "step": step,
    }
    return arrays | skip_distances(layout, arrays)
