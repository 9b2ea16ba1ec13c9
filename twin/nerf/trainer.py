"""Stage `field`: metric cameras → a trained radiance field, the same baked for rendering, and how good both are."""

import math
import time
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from twin.config import NerfConfig, SceneConfig
from twin.errors import InputError
from twin.files import read_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.nerf import network
from twin.nerf.appearance import initial_appearance
from twin.nerf.bake import bake
from twin.nerf.buffers import (
    COARSEST,
    CameraArrays,
    Layout,
    Space,
    Workspace,
    device,
    parallel,
    single_threaded_torch,
    space_of_cameras,
)
from twin.nerf.dataset import TrainingPixels
from twin.nerf.evaluate import cross_lighting, evaluate
from twin.nerf.field import RadianceField, untrained
from twin.nerf.kernels import composite as volume
from twin.nerf.kernels import hashgrid, sampler
from twin.nerf.pose_refinement import Refinement
from twin.nerf.stereo import stereo_depths
from twin.runtime import bar
from twin.scene import SceneDir

# ---- What a field is trained to besides the colours of the pictures: how much each part counts, and what needs no kernel.
#
# Distortion and depth are in `kernels/composite.py`, with the gradient of volume rendering.


_EDGE = 10.0  # a contrast of 1/10 makes bending count e times less
_MOST_BEND = 0.5  # beyond this it is an edge of depth, whatever the colours say
_HORIZON = 0.03  # rays this near to level are neither above nor below the horizon [sine]


@dataclass(frozen=True)
class LossWeights:
    """How much each part of the loss counts."""

    distortion: float = 0.005
    depth: float = 1.0
    depth_reach: float = 0.5
    plane: float = 0.01
    free: float = 1e-3
    sky: float = 1e-2
    ground: float = 1e-2
    residual: float = 1e-3


def bending(inverse_depth: torch.Tensor, colour: torch.Tensor) -> torch.Tensor:
    """How far triples of rays are from seeing a plane, where their colours give no reason for an edge.

    The inverse z-depth of a plane is affine in the pixel, so its second difference vanishes on any plane; relative to
    the inverse depth itself it has no unit. The road has little texture, so this is what spreads the few known depths.

    Args:
        inverse_depth: Expected inverse z-depth [1/m], shape (3k,), triple after triple.
        colour: Shape (3k, 3).
    """
    d = inverse_depth.view(-1, 3)
    c = colour.view(-1, 3, 3)
    contrast = (c[:, 0] - c[:, 1]).abs().sum(-1) + (c[:, 2] - c[:, 1]).abs().sum(-1)
    bend = (d[:, 0] + d[:, 2] - 2.0 * d[:, 1]).abs() / (d.detach().mean(1) + 1e-3)
    return (torch.exp(-_EDGE * contrast) * bend.clamp(max=_MOST_BEND)).mean()


def horizon_loss(opacity: torch.Tensor, up: torch.Tensor, sky: float, ground: float) -> torch.Tensor:
    """Above the horizon what may be open is open (a plain sky fits at any distance); below it something is solid.

    Args:
        opacity: Of rays, shape (n,).
        up: Vertical component of their unit directions, shape (n,).
        sky: Cost of an opaque ray above the horizon.
        ground: Cost of an open ray below it.
    """
    above, below = (up > _HORIZON).float(), (up < -_HORIZON).float()
    return (sky * above * opacity + ground * below * (1.0 - opacity)).mean()


# ---- Training: from posed frames to a radiance field.
#
# A *step* takes a batch of rays through the field and back. Its length is fixed (`nerf.steps`) and no clock decides
# anything, so that on a CPU the same input gives the same field bit by bit. Every batch also holds *free points*: random
# points around the filmed path, where a camera was and so nothing can be.


_SHARDS = 4
_CELL_PIXELS = 2.0  # side of the finest cell [px of a training frame, at the near end of what was seen]
_GROWTH_RANGE = (1.3, 2.2)
_HIDDEN = 64
_TRIPLES = 0.3  # share of the rays that come in threes, to see whether surfaces are plane
_FREE_POINTS = 256  # per shard and step
_NETWORK_RATE = 1e-2  # learning rate of the networks and embeddings at the start
_FINAL_RATE = 0.03  # learning rates end at this share
_RISE, _FALL = 0.3, 0.1  # how fast a cell of the stop grids follows what is found in it
_LOG_OFFSET = 0.05  # of the distortion's logarithmic distance [share of the near box's longest half side]
_WARM_UP = 20  # steps of rising learning rate
_EXPLORE = 0.15  # share of the steps over which sampling narrows down


class Trainer:
    """A field under training. `step()` until `done`, then `finish()`."""

    def __init__(
        self,
        cameras: Cameras,
        points: SparsePoints,
        config: NerfConfig,
        seed: int,
        where: str,
        weights: LossWeights | None = None,
        camera_height: float = 0.0,
    ):
        self.config, self.seed, self.where = config, seed, where
        self.weights = weights or LossWeights()
        self.pixels = TrainingPixels(cameras, points, config.max_width, camera_height)
        self.stereo: dict[str, Any] | None = None
        """What there is to say of the sightings by stereo; None where they are switched off."""
        if config.stereo:
            self.pixels.stereo, self.stereo = stereo_depths(self.pixels, seed, where)
        train = self.pixels.cameras
        self.lightings = tuple(dict.fromkeys(train.lightings))
        frame_lighting = np.array([self.lightings.index(name) for name in train.lightings])
        space = space_of_cameras(cameras.camera_to_world, config.near_half_extent)
        layout = Layout(
            space.centre,
            space.half,
            near_plane=config.near_plane,
            levels=config.levels,
            growth=self._growth(space),
            log2_table=config.log2_table,
            hidden=_HIDDEN,
            appearance_dim=config.appearance_dim,
        )
        appearance = initial_appearance(self.lightings, train.names, frame_lighting, config.appearance_dim, seed)
        self.field = untrained(layout, appearance, seed, where)
        self.rng = np.random.default_rng([seed, 2])
        self.rays = -(-config.rays // _SHARDS) * _SHARDS
        self.ws = Workspace(layout, self.rays, config.samples, where, _SHARDS * _FREE_POINTS, training=True)
        self.free = free_segments(train, config.near_plane)
        self.refinement: Refinement | None = None
        """How the frames move; None where they do not."""
        if config.refine_cameras:
            near = self._near(space)
            self.refinement = Refinement(train.camera_to_world, self.pixels.intrinsics, near, self.ws)
            self.arrays = self.refinement.arrays
        else:
            self.arrays = CameraArrays(train.camera_to_world, self.pixels.intrinsics, where)

        f = self.field
        self.small = {**f.parameters, "vectors": f.appearance.vectors, "residuals": f.appearance.residuals}
        for name, tensor in self.small.items():
            if not name.startswith("trunk"):
                tensor.requires_grad_(True)
        self.optimiser = torch.optim.Adam(list(self.small.values()), lr=_NETWORK_RATE, betas=(0.9, 0.99), eps=1e-12)
        self.table_grad = torch.zeros_like(f.table)
        self.first, self.second = torch.zeros_like(f.table), torch.zeros_like(f.table)
        feature = hashgrid.Feature
        self.w_table_grad = wp.from_torch(self.table_grad, dtype=feature)
        self.w_first, self.w_second = (
            wp.from_torch(self.first, dtype=feature),
            wp.from_torch(self.second, dtype=feature),
        )
        self.steps_done = 0

    def _growth(self, space: Space) -> float:
        """Ratio of one level's cells to the next finer one's, such that the finest suits the frames."""
        cell = _CELL_PIXELS * self._near(space) / float(np.median(self.pixels.intrinsics[:, 0]))
        ratio = 4.0 * space.scale / cell / COARSEST
        return float(np.clip(ratio ** (1.0 / max(1, self.config.levels - 1)), *_GROWTH_RANGE))

    def _near(self, space: Space) -> float:
        """How far what is near is from the cameras [m]."""
        seen = self.pixels.points.distance
        return float(np.quantile(seen, 0.05)) if len(seen) else 0.25 * space.scale

    @property
    def done(self) -> bool:
        return self.steps_done >= self.config.steps

    def rate(self) -> float:
        """Learning rate now, as a share of that at the start."""
        warm = min(1.0, (self.steps_done + 1) / _WARM_UP)
        return warm * math.exp(math.log(_FINAL_RATE) * self.steps_done / self.config.steps)

    def step(self) -> float:
        """One step; returns the mean squared error of its colours."""
        ws, where = self.ws, self.where
        per_shard = self.rays // _SHARDS
        sightings = int(per_shard * self.config.sightings)
        triples = int(per_shard * _TRIPLES) // 3
        batch = self.pixels.batch(self.rng, _SHARDS, triples, per_shard - sightings - 3 * triples, sightings)
        ws.camera.copy_(torch.from_numpy(batch.frame))
        ws.pixel.copy_(torch.from_numpy(batch.pixel))
        ws.targets.copy_(torch.from_numpy(batch.distance))
        colour = torch.from_numpy(batch.colour).to(where)
        free = self._free_points(_SHARDS * _FREE_POINTS)
        if free is not None:
            ws.positions[self.rays * ws.samples :].copy_(free)

        results = parallel(lambda shard: self._shard(shard, colour, triples, free is not None), range(_SHARDS), where)
        rate = self.rate()
        parallel(lambda task: self._update(task, rate), range(self.config.levels + 2), where)
        for tensor, *gradients in zip(self.small.values(), *(r[1] for r in results), strict=True):
            tensor.grad = torch.stack(gradients).sum(0) if len(gradients) > 1 else gradients[0]
        for group in self.optimiser.param_groups:
            group["lr"] = _NETWORK_RATE * rate
        self.optimiser.step()
        if self._refines:
            self.refinement.step(rate)  # type: ignore[union-attr]
        self.steps_done += 1
        return sum(r[0] for r in results) / _SHARDS

    def _shard(self, shard: int, colour: torch.Tensor, triples: int, free: bool) -> tuple[float, list[torch.Tensor]]:
        """Forward and back through one shard: its error, and the gradients of the small tensors in their order."""
        f, ws, w = self.field, self.ws, self.weights
        count = self.rays // _SHARDS
        start = shard * count
        rays = slice(start, start + count)
        samples = slice(start * ws.samples, (start + count) * ws.samples)
        first_free = self.rays * ws.samples + shard * _FREE_POINTS
        explore = max(0.0, 1.0 - self.steps_done / (_EXPLORE * self.config.steps + 1))

        f.cast(ws, self.arrays, start, count)
        f.sample(ws, start, count, 0.1 + explore, target_mass=0.3, seed=self.seed * 1_000_003 + self.steps_done)
        f.query(ws, samples.start, samples.stop - samples.start)
        f.composite(ws, start, count)

        composited = ws.composited[rays].detach().requires_grad_(True)
        frame = ws.camera[rays].long()
        residuals = f.appearance.residuals
        harmonics = network.spherical_harmonics(ws.directions[rays])
        features = network.ray_features(f.parameters, composited, harmonics)
        rgb = network.head(f.parameters, features, harmonics, f.appearance.of_frames(frame))
        error = rgb - colour[rays]
        # The shards' losses add up to a mean over the batch.
        loss = torch.nn.functional.smooth_l1_loss(rgb, colour[rays], beta=0.1) / _SHARDS
        loss = loss + w.residual * (residuals[frame] ** 2).mean() / _SHARDS
        loss = loss + horizon_loss(composited[:, 0], ws.directions[rays, 2], w.sky, w.ground) / _SHARDS
        inverse_depth = (ws.inverse_distance[rays] / ws.cosines[rays]).requires_grad_(True)
        if triples and w.plane > 0.0:
            loss = loss + w.plane / _SHARDS * bending(inverse_depth[: 3 * triples], colour[rays][: 3 * triples])
        learned = [t for n, t in self.small.items() if not n.startswith("trunk")]
        gradients = torch.autograd.grad(loss, [composited, inverse_depth, *learned], allow_unused=True)
        with torch.no_grad():
            ws.composited_grad[rays] = gradients[0]
            if gradients[1] is not None:
                ws.inverse_grad[rays] = gradients[1] / ws.cosines[rays]
            wp.launch(
                volume.composite_backward,
                count,
                [
                    *(ws.w_ray_outputs, ws.w_edges, ws.w_distances, ws.w_lengths, ws.w_weights, ws.w_targets),
                    *(ws.w_composited_grad, ws.w_inverse_grad, f.layout.density_unit),
                    *(w.distortion / self.rays, w.depth / self.rays, w.depth_reach),
                    *(_LOG_OFFSET * f.layout.space.scale, start),
                ],
                [ws.w_ray_outputs_grad],
                device=self.where,
            )
            first, second = self._trunk_backward(samples)
            if self._refines:
                self.refinement.backward(f, start, count)  # type: ignore[union-attr]
            if free:
                more = self._free_backward(first_free)
                first, second = first + more[0], second + more[1]
            wp.launch(
                volume.densities_of,
                samples.stop - samples.start,
                [ws.w_outputs, f.layout.density_unit, samples.start],
                [ws.w_densities],
                device=self.where,
            )
            return float((error**2).mean()), [first, second, *gradients[2:]]

    @property
    def _refines(self) -> bool:
        """Whether cameras move yet: at first the field knows less than they do."""
        return self.refinement is not None and self.steps_done >= _EXPLORE * self.config.steps

    def _trunk_backward(self, rows: slice) -> tuple[torch.Tensor, torch.Tensor]:
        ws = self.ws
        return network.trunk_backward(
            self.field.parameters,
            ws.features[rows],
            ws.hidden[rows],
            ws.outputs_grad[rows],
            ws.hidden_grad[rows],
            ws.features_grad[rows],
        )

    def _free_backward(self, start: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient of free · mean(log(1 + σ·scale)) over the free points: gentle where much is wrong."""
        f, ws = self.field, self.ws
        f.query(ws, start, _FREE_POINTS)
        rows = slice(start, start + _FREE_POINTS)
        depth = (
            torch.exp(ws.outputs[rows, 0].clamp(max=volume.RAW_LIMIT)) * f.layout.density_unit * f.layout.space.scale
        )
        ws.outputs_grad[rows, 0] = self.weights.free / (_SHARDS * _FREE_POINTS) * depth / (1.0 + depth)
        return self._trunk_backward(rows)

    def _update(self, task: int, rate: float) -> None:
        """Task by task: each level's scatter and Adam step; and the two halves of the density grid."""
        f, ws = self.field, self.ws
        levels = self.config.levels
        if task >= levels:
            wp.launch(
                sampler.update_grids,
                self.rays * ws.samples,
                [
                    *(ws.w_positions, ws.w_densities, f.stop.near_cell, f.stop.far_cell),
                    *(_RISE, _FALL, task - levels, 2, f.w_near_grid, f.w_far_grid),
                ],
                device=self.where,
            )
            return
        t = self.steps_done + 1
        wp.launch(
            hashgrid.encode_backward,
            (1, ws.features.shape[0]),
            [ws.w_positions, f.w_cells, f.w_shapes, f.mask, task, ws.w_features_grad, self.w_table_grad],
            device=self.where,
        )
        wp.launch(
            hashgrid.adam_step,
            (1, f.table.shape[1]),
            [
                *(task, self.config.learning_rate * rate / (1.0 - 0.9**t), 1.0 / (1.0 - 0.99**t)),
                *(f.w_table, self.w_table_grad, self.w_first, self.w_second),
            ],
            device=self.where,
        )

    def _free_points(self, n: int) -> torch.Tensor | None:
        """Grid positions of random points no camera can have been inside of, shape (n, 3)."""
        if not len(self.free):
            return None
        pick = self.free[self.rng.integers(len(self.free), size=n)]
        offset = self.rng.normal(size=(n, 3))
        offset *= (self.config.near_plane * self.rng.random((n, 1)) ** (1 / 3)) / np.linalg.norm(offset, axis=1)[
            :, None
        ]
        x = pick[:, 0] + (pick[:, 1] - pick[:, 0]) * self.rng.random((n, 1)) + offset
        layout = self.field.layout
        u = (x - np.array(layout.centre)) / np.array(layout.half)  # camera positions lie in the near box
        return torch.as_tensor((u * 0.25 + 0.5).clip(0.0, 1.0 - 1e-6).astype(np.float32), device=self.where)

    def finish(self) -> RadianceField:
        """The trained field, no longer part of any graph."""
        for tensor in self.small.values():
            tensor.requires_grad_(False)
        return self.field


def free_segments(cameras: Cameras, near_plane: float) -> NDArray[np.float64]:
    """Straight pieces of the filmed path, shape (k, 2, 3) [m]: around them (within the near plane) nothing is.

    A step much longer than its source's usual one is a jump between photos and no path; its ends still count.
    """
    pieces = [np.repeat(cameras.positions[:, None], 2, 1)] if near_plane > 0 else []
    for source in dict.fromkeys(cameras.sources):
        p = cameras.positions[np.array([s == source for s in cameras.sources])]
        if len(p) > 2 and near_plane > 0:
            length = np.linalg.norm(np.diff(p, axis=0), axis=1)
            keep = length < 3.0 * np.median(length)
            pieces.append(np.stack([p[:-1], p[1:]], 1)[keep])
    return np.concatenate(pieces) if pieces else np.zeros((0, 2, 3))


def train_field(
    cameras: Cameras, points: SparsePoints, config: NerfConfig, seed: int = 0, camera_height: float = 0.0
) -> tuple[RadianceField, dict[str, Any], Cameras]:
    """Trains a field; it, what there is to say of the training, and the cameras that it fits.

    `camera_height` [m] is that of a camera carried at constant height over the ground, 0 where it was not.
    """
    where = device()
    trainer = Trainer(cameras, points, config, seed, where, camera_height=camera_height)
    curve: list[list[float]] = []
    began = time.perf_counter()
    mean = 0.0
    with bar("training", config.steps, "step") as progress, single_threaded_torch():
        while not trainer.done:
            error = trainer.step()
            if not math.isfinite(error):
                raise InputError(f"training diverged at step {trainer.steps_done}; lower nerf.learning_rate")
            mean = error if trainer.steps_done == 1 else 0.98 * mean + 0.02 * error
            if trainer.steps_done % 20 == 0 or trainer.done:
                progress.set_postfix_str(f"PSNR {-10 * math.log10(mean):.2f} dB", refresh=False)
                curve.append([trainer.steps_done, round(-10 * math.log10(mean), 3)])
            progress.update()
    seconds = time.perf_counter() - began
    field, moved = trainer.finish(), None
    if trainer.refinement:
        cameras, moved = trainer.refinement.refined(cameras)
    small = sum(t.numel() for t in trainer.small.values())
    return (
        field,
        {
            "steps": config.steps,
            "seconds_train": round(seconds, 2),
            "rays_per_second": round(config.steps * trainer.rays / seconds, 1),
            "train_psnr": curve[-1][1],
            "parameters": int(field.table.numel() + small),
            "sightings_points": len(trainer.pixels.points.frame),
            "sightings_path": len(trainer.pixels.path.frame),
            "stereo": trainer.stereo,
            "cameras_moved": moved,
            "curve": curve,
        },
        cameras,
    )


_TIMES = ("seconds", "seconds_train", "rays_per_second")
_HEIGHT_SPREAD = 0.1  # a camera height that varies by more than this share is not constant


def constant_height(metric: dict[str, Any]) -> float:
    """The camera's height above the ground [m], if the metric stage found it to be known and constant; else 0."""
    height, spread = metric.get("camera_height_median_m"), metric.get("local_height_spread_m")
    if not height or not (metric.get("road_reliable") or metric.get("scale_source") == "camera_height"):
        return 0.0
    return 0.0 if spread is not None and spread > _HEIGHT_SPREAD * height else float(height)


def untimed(metrics: dict[str, Any]) -> dict[str, Any]:
    """Metrics without how long it took: the same field is the same file, and what was fitted to it stays valid."""
    return {
        name: untimed(value) if isinstance(value, dict) else value
        for name, value in metrics.items()
        if name not in _TIMES
    }


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Stage `field`: trains on the metric cameras, scores the held-out frames, saves the field.

    Raises:
        InputError: nothing to train on, an unreadable frame, or a device that is not there.
    """
    cameras = Cameras.load(scene.stage("metric"))
    points = SparsePoints.load(scene.stage("metric"))
    height = constant_height(read_json(scene.stage("metric") / "metric.json")) if config.mjcf.route else 0.0
    field, metrics, cameras = train_field(cameras, points, config.nerf, config.seed, height)
    pixels = TrainingPixels(cameras, points, config.nerf.max_width)
    baked, metrics["bake"] = bake(field, pixels, config.seed, config.nerf.bake_steps, config.nerf.max_bricks)
    metrics |= evaluate(field, cameras, config.nerf.max_width, baked=baked)
    metrics["cross_lighting"] = cross_lighting(baked, cameras)
    field.about = {
        "scene": config.name,
        "seed": config.seed,
        "nerf": asdict(config.nerf),
        "versions": {name: metadata.version(name) for name in ("twin", "torch", "warp-lang", "numpy")},
        "metrics": untimed(metrics),
    }
    field.save(out)
    baked.about = field.about
    baked.save(out)
    return metrics
