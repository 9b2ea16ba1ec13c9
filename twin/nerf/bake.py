"""From a radiance field to bricks: sampled where a camera saw matter, fine-tuned on the training frames, put in bytes.

Vocabulary as in `kernels/bricks.py`. The networks and embeddings stay as they were trained; only the samples are tuned.
"""

import time
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from twin.errors import InputError
from twin.nerf import network
from twin.nerf.baked import BakedField
from twin.nerf.brick_layout import BrickLayout, brick_indices, leaps
from twin.nerf.buffers import CameraArrays, Workspace, parallel, single_threaded_torch, view
from twin.nerf.dataset import TrainingPixels
from twin.nerf.field import RadianceField
from twin.nerf.kernels import bricks as kernels
from twin.nerf.kernels import composite as volume
from twin.runtime import bar

_SHARDS = 4
_RAYS = 4096  # per step of fine-tuning
_VIEWS = 64  # that tell where matter is, at most, spread evenly
_LOOK = 112  # [px] width of the looks that tell where matter is
_SAMPLES = 24
_SEEN = 0.004  # weight from which a place counts as matter
_FINEST = 0.03  # [m] side of the near cells at best
_COARSENING = 1.15
_COARSE, _MORE = 0.15, 1.39  # [m] side of near cells from which there may be so many times the bricks: 7 % of speed
_FAR_COARSER = 4.0  # cells of the far grid over those of the near one
_NOTHING = -8.0  # raw density where no brick is
_RAW_RANGE = (-6.0, 12.0)  # of raw density, that bytes cover
_TAIL = 2e-4  # share of the features' values beyond what bytes cover
_RATES = (0.05, 0.02)  # of raw density and features
_BATCH = 65536
_PROBES = 1024  # rays that random lightings are judged on, see `appearance_prior.py`


def bake(
    field: RadianceField, pixels: TrainingPixels, seed: int = 0, steps: int = 300, most_bricks: int = 9000
) -> tuple[BakedField, dict[str, Any]]:
    """A baked field and what there is to say of it.

    Args:
        field: A trained field.
        pixels: The frames it was trained on.
        seed: Of the fine-tuning's batches.
        steps: Of fine-tuning, at least 1.
        most_bricks: Cells grow until there are no more bricks than this, 9,000 being 105 MB; no more than 1.39 times
            as many where cells would come out larger than 15 cm, as those of a long road do.

    Raises:
        InputError: no camera sees anything in the field.
    """
    began = time.perf_counter()
    near, far = _matter(field, pixels)
    if not len(near) and not len(far):
        raise InputError(
            "no training camera sees anything in the trained field, so there is nothing to bake; raise nerf.steps, or "
            "lower nerf.near_plane or set nerf.near_half_extent = 0 where these were changed"
        )
    layout, slots = _layout(field, near, far, most_bricks)
    if layout.near_side.max() / kernels.CELLS > _COARSE:
        layout, slots = _layout(field, near, far, round(_MORE * most_bricks))
    values = _sample(field, layout, slots)
    tuner = _Tuner(field, pixels, layout, slots, values, steps, seed)
    error = tuner.run()
    del tuner
    arrays = _in_bytes(values, slots, field, layout) | _probes(field, pixels, seed)
    baked = BakedField(layout, field.appearance.named(), arrays, field.where, field.about)
    return baked, {
        "bricks_near": len(slots[0]),
        "bricks_far": len(slots[1]),
        "cell_m": float(layout.near_side.max()) / kernels.CELLS,
        "bytes": baked.bytes,
        "fine_tune_psnr": error,
        "seconds": time.perf_counter() - began,
    }


def _matter(field: RadianceField, pixels: TrainingPixels) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Grid positions of samples in and outside the near box that the training cameras see matter at."""
    cameras = CameraArrays(pixels.cameras.camera_to_world, pixels.intrinsics, field.where)
    frames = np.unique(np.linspace(0, len(pixels.cameras) - 1, _VIEWS).round().astype(int))
    spots: list[tuple[NDArray, NDArray]] = [(np.zeros((0, 3), "f4"),) * 2] * len(frames)

    with bar("looking for matter", len(spots), "view") as progress:

        @torch.no_grad()
        def look(k: int) -> None:
            i = int(frames[k])
            width = min(_LOOK, int(pixels.width[i]))
            height = max(1, round(width * pixels.height[i] / pixels.width[i]))
            v, u = (np.mgrid[:height, :width] + 0.5) * (pixels.width[i] / width)
            n = width * height
            ws = field._borrow(n, _SAMPLES, 0)
            ws.camera.fill_(i)
            ws.pixel.copy_(torch.as_tensor(np.stack([u.ravel(), v.ravel()], -1).astype(np.float32)))
            field.cast(ws, cameras, 0, n)
            field.sample(ws, 0, n, 0.02)
            field.query(ws, 0, n * _SAMPLES)
            field.composite(ws, 0, n)
            seen = ws.positions[: n * _SAMPLES][ws.weights.reshape(-1) > _SEEN].cpu().numpy()
            inside = ((seen >= 0.25) & (seen < 0.75)).all(1)
            spots[k] = seen[inside].copy(), seen[~inside].copy()
            field._spare.append(ws)
            progress.update()

        with single_threaded_torch():
            parallel(look, range(len(spots)), field.where)
    return np.concatenate([a for a, _ in spots]), np.concatenate([b for _, b in spots])


def _layout(
    field: RadianceField, near: NDArray, far: NDArray, most: int
) -> tuple[BrickLayout, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The finest layout whose bricks around matter are few enough, and where these are."""
    half = np.array(field.layout.half)
    cell = _FINEST
    while True:
        near_shape = np.maximum(np.ceil(2 * half / (cell * kernels.CELLS)), 1).astype(int)
        far_shape = np.maximum(np.ceil(4 * half / (cell * _FAR_COARSER * kernels.CELLS)), 4).astype(int)
        slots = _bricks_around(near * 2.0 - 0.5, near_shape), _bricks_around(far, far_shape)
        # The far grid leaves to the near one what lies wholly inside the near box.
        low, high = slots[1] / far_shape, (slots[1] + 1) / far_shape
        slots = slots[0], slots[1][~((low >= 0.25) & (high <= 0.75)).all(1)]
        count = sum(map(len, slots))
        if count <= most:
            break
        cell *= max(_COARSENING, (count / most) ** 0.4)
    shapes = [tuple(int(x) for x in shape) for shape in (near_shape, far_shape)]
    layout = BrickLayout(
        *(field.layout.centre, field.layout.half, field.layout.near_plane, field.layout.density_unit),
        *shapes,  # type: ignore[arg-type]
    )
    return layout, slots


def _bricks_around(spots: NDArray, shape: NDArray) -> NDArray[np.int64]:
    """Bricks (s, 3) that spots in [0, 1)³ fall into, or miss by less than a cell; sorted."""
    marked = np.zeros(shape, bool)
    at = spots * shape
    margin = 1.0 / kernels.CELLS
    for corner in np.ndindex(2, 2, 2):
        index = np.floor(at + margin * (2 * np.array(corner) - 1)).astype(np.int64)
        index = np.clip(index, 0, shape - 1)
        marked[tuple(index.T)] = True
    return np.argwhere(marked)


def _sample(field: RadianceField, layout: BrickLayout, slots: tuple[NDArray, NDArray]) -> torch.Tensor:
    """The field's raw densities and features at the samples of all slots, shape (s, 729, CHANNELS)."""
    grid = np.stack(np.meshgrid(*[np.arange(kernels.CORNERS)] * 3, indexing="ij"), -1).reshape(-1, 3) / kernels.CELLS
    near = (slots[0][:, None] + grid) / np.array(layout.near_shape) * 0.5 + 0.25
    far = (slots[1][:, None] + grid) / np.array(layout.far_shape)
    places = np.concatenate([near.reshape(-1, 3), far.reshape(-1, 3)]).astype(np.float32).clip(0.0, 1.0 - 1e-6)
    values = torch.empty(len(places), volume.CHANNELS, device=field.where)

    @torch.no_grad()
    def one(start: int) -> None:
        ws = field._borrow(0, 1, _BATCH)
        n = min(_BATCH, len(places) - start)
        ws.positions[:n] = torch.as_tensor(places[start : start + n], device=field.where)
        field.query(ws, 0, n)
        values[start : start + n] = ws.outputs[:n]
        field._spare.append(ws)

    with single_threaded_torch():
        parallel(one, range(0, len(places), _BATCH), field.where)
    values[:, 0].clamp_(*_RAW_RANGE)
    return values.view(-1, kernels.SAMPLES, volume.CHANNELS)


class _Tuner:
    """Fine-tuning: rays through the training frames, back into the samples."""

    def __init__(
        self,
        field: RadianceField,
        pixels: TrainingPixels,
        layout: BrickLayout,
        slots: tuple[NDArray, NDArray],
        values: torch.Tensor,
        steps: int,
        seed: int,
    ):
        self.field, self.pixels, self.steps, self.values, self.seed = field, pixels, steps, values, seed
        where = field.where
        near, far = brick_indices(layout, *slots)
        self.index: list[Any] = [
            wp.array(near, dtype=wp.int32, device=where),
            wp.array(far, dtype=wp.int32, device=where),
        ]
        self.gradient, self.second = torch.zeros_like(values), torch.zeros(*values.shape[:2], 2, device=where)
        self.w_values, self.w_gradient = view(values, volume.Channels), view(self.gradient, volume.Channels)
        self.w_second = view(self.second, wp.vec2f)
        self.rays = -(-_RAYS // _SHARDS) * _SHARDS
        self.ws = Workspace(field.layout, self.rays, _SAMPLES, where, training=True)
        self.cameras = CameraArrays(pixels.cameras.camera_to_world, pixels.intrinsics, where)

    def run(self) -> float:
        """Tunes the values in place; the PSNR [dB] on the last tenth of the batches."""
        rng = np.random.default_rng([self.seed, 5])
        errors = []
        steps = self.steps
        parts = _SHARDS
        with bar("fine-tuning", steps, "step") as progress, single_threaded_torch():
            for step in range(steps):
                batch = self.pixels.batch(rng, _SHARDS, 0, self.rays // _SHARDS, 0)
                self.ws.camera.copy_(torch.from_numpy(batch.frame))
                self.ws.pixel.copy_(torch.from_numpy(batch.pixel))
                self.ws.targets.zero_()
                colour = torch.from_numpy(batch.colour).to(self.field.where)
                decay = 0.05 ** (step / steps)

                def go(shard: int, colour: torch.Tensor = colour, step: int = step) -> float:
                    return self._shard(shard, colour, step)

                def update(part: int, decay: float = decay, step: int = step) -> None:
                    self._update(part, parts, decay, step)

                errors.append(sum(parallel(go, range(_SHARDS), self.field.where)) / _SHARDS)
                parallel(update, range(parts), self.field.where)
                progress.update()
        return float(-10 * np.log10(np.mean(errors[-max(1, steps // 10) :])))

    def _shard(self, shard: int, colour: torch.Tensor, step: int) -> float:
        f, ws = self.field, self.ws
        count = self.rays // _SHARDS
        start = shard * count
        rays, samples = slice(start, start + count), slice(start * _SAMPLES, (start + count) * _SAMPLES)
        f.cast(ws, self.cameras, start, count)
        f.sample(ws, start, count, 0.02, seed=self.seed * 1_000_003 + step)
        wp.launch(
            kernels.interpolate,
            count * _SAMPLES,
            [ws.w_positions, *self.index, self.w_values, _NOTHING, samples.start],
            [ws.w_outputs],
            device=f.where,
        )
        f.composite(ws, start, count)
        composited = ws.composited[rays].detach().requires_grad_(True)
        harmonics = network.spherical_harmonics(ws.directions[rays])
        features = network.ray_features(f.parameters, composited, harmonics)
        embedding = f.appearance.of_frames(ws.camera[rays].long())
        error = network.head(f.parameters, features, harmonics, embedding) - colour[rays]
        loss = torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.1) / _SHARDS
        (gradient,) = torch.autograd.grad(loss, [composited])
        with torch.no_grad():
            ws.composited_grad[rays] = gradient
            ws.inverse_grad[rays] = 0.0
            wp.launch(
                volume.composite_backward,
                count,
                [
                    *(ws.w_ray_outputs, ws.w_edges, ws.w_distances, ws.w_lengths, ws.w_weights, ws.w_targets),
                    *(ws.w_composited_grad, ws.w_inverse_grad, f.layout.density_unit, 0.0, 0.0, 1.0, 1.0, start),
                ],
                [ws.w_ray_outputs_grad],
                device=f.where,
            )
        return float((error.detach() ** 2).mean())

    def _update(self, part: int, parts: int, rate: float, step: int) -> None:
        w_outputs_grad = view(self.ws.outputs_grad, volume.Channels)
        wp.launch(
            kernels.interpolate_backward,
            self.rays * _SAMPLES,
            [self.ws.w_positions, *self.index, w_outputs_grad, part, parts, self.w_gradient],
            device=self.field.where,
        )
        t = step + 1
        wp.launch(
            kernels.adam_step,
            self.rays * _SAMPLES,
            [
                *(self.ws.w_positions, *self.index, w_outputs_grad, part, parts),
                volume.Channels(_RATES[0] * rate, *[_RATES[1] * rate] * (volume.CHANNELS - 1)),
                *(1.0 / (1.0 - 0.99**t), self.w_values, self.w_gradient, self.w_second),
            ],
            device=self.field.where,
        )


def _probes(field: RadianceField, pixels: TrainingPixels, seed: int) -> dict[str, NDArray]:
    """Rays spread over the training frames, as `plausible.Probes` takes them."""
    rng = np.random.default_rng([seed, 6])
    frame = np.linspace(0, len(pixels.cameras) - 1, _PROBES).round().astype(int)
    pixel = rng.random((_PROBES, 2)) * np.stack([pixels.width, pixels.height], 1)[frame]
    cameras = CameraArrays(pixels.cameras.camera_to_world, pixels.intrinsics, field.where)
    features, harmonics, _, _ = field.trace(cameras, frame, pixel)
    return {"probes.features": features.cpu().numpy(), "probes.harmonics": harmonics.cpu().numpy()}


def _in_bytes(
    values: torch.Tensor, slots: tuple[NDArray, NDArray], field: RadianceField, layout: BrickLayout
) -> dict[str, NDArray]:
    """Arrays as `BakedField` takes them. The values are used up."""
    flat = values.view(-1, volume.CHANNELS)
    matter = torch.nonzero(flat[:, 0] > 0.0)[:, 0]
    some = flat[matter[:: max(1, len(matter) // 200_000)] if len(matter) else slice(None, None, 100)].cpu().numpy()
    low, high = np.quantile(some, [_TAIL, 1.0 - _TAIL], axis=0).astype(np.float32)
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
    parameters = {k: v for k, v in field.parameters.items() if not k.startswith("trunk")}
    arrays |= {f"network.{k}": v.detach().cpu().numpy() for k, v in parameters.items()}
    return arrays | leaps(layout, arrays)
