"""Stage `field`: trains a radiance field on frames with known poses, bakes it, adds detail, and evaluates it.

Training takes `nerf.steps` steps, without a time limit. On a CPU, the same input gives the same field bit for bit.
Each step also penalizes density at *free points*: random points near the camera path, where space must be empty.
"""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from twin.config import NerfConfig, SceneConfig
from twin.errors import InputError
from twin.files import read_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.images import write_image
from twin.nerf import network
from twin.nerf.bake import bake
from twin.nerf.buffers import (
    CameraArrays,
    Workspace,
    near_distance,
    parallel,
    resolve_device,
    section_layout,
    shard_count,
    single_threaded_torch,
    warp_view,
)
from twin.nerf.dataset import (
    DepthSupervision,
    RayBatch,
    TrainingPixels,
    constant_height,
    free_segments,
    join_depths,
    random_free_points,
)
from twin.nerf.detail import fit_detail
from twin.nerf.evaluate import cross_lighting, evaluate
from twin.nerf.field import FieldSection, RadianceField, untrained_field
from twin.nerf.kernels import hashgrid, volume
from twin.nerf.poles import Poles, find_poles, pole_depths
from twin.nerf.pose_refinement import PoseRefinement
from twin.nerf.road import divide_road
from twin.nerf.stereo import stereo_depths
from twin.nerf.transients import LeftObject, cell_depths, left_objects, mover_masks, object_masks
from twin.nerf.transients import picture as excluded_picture
from twin.runtime import bar, return_memory
from twin.scene import SceneDir
from twin.warp_runtime import wp

# ---- losses; those of distortion and depth are in `kernels/volume.py`

_EDGE_SHARPNESS = 10.0  # a color contrast of 1/10 divides the plane loss by e
_MAX_BEND = 0.5  # upper limit of the relative second difference of inverse depth: a larger one is a depth edge
_HORIZON_SINE = 0.03  # a ray is neither above nor below the horizon if its sine of elevation is between ± this
# Weights of the loss terms beside the color error.
_DISTORTION = 0.005
_DEPTH, _DEPTH_REACH = 0.25, 0.5  # with 1.0, errors of stereo blur the field: −0.3 dB, near the camera −0.6 to −0.8 dB
_PLANE = 0.01
_FREE = 1e-3
_SKY, _GROUND = 1e-2, 1e-2
_RESIDUAL = 1e-3


def plane_loss(inverse_depth: torch.Tensor, color: torch.Tensor) -> torch.Tensor:
    """Edge-aware planarity loss of triples of rays, from inverse z-depths (3k,) [1/m] and colors (3k, 3).

    The inverse z-depth of a plane is affine in the pixel, so its second difference is zero. On the road, which has
    little texture, the loss carries the few known depths to the pixels between them.
    """
    d = inverse_depth.view(-1, 3)
    c = color.view(-1, 3, 3)
    contrast = (c[:, 0] - c[:, 1]).abs().sum(-1) + (c[:, 2] - c[:, 1]).abs().sum(-1)
    bend = (d[:, 0] + d[:, 2] - 2.0 * d[:, 1]).abs() / (d.detach().mean(1) + 1e-3)
    return (torch.exp(-_EDGE_SHARPNESS * contrast) * bend.clamp(max=_MAX_BEND)).mean()


def horizon_loss(opacity: torch.Tensor, up: torch.Tensor) -> torch.Tensor:
    """Mean cost of opacity above the horizon and of transparency below it.

    Without this loss, surfaces would appear in the sky, since a uniform color fits at any distance. Arguments are the
    opacity (n,) of rays and the vertical component `up` (n,) of their directions.
    """
    above, below = (up > _HORIZON_SINE).float(), (up < -_HORIZON_SINE).float()
    return (_SKY * above * opacity + _GROUND * below * (1.0 - opacity)).mean()


# ---- training

_TRIPLE_SHARE = 0.3  # share of the rays that come in triples, for the plane loss
_FREE_POINTS = 1024  # free points per step
_NETWORK_RATE = 1e-2  # initial learning rate of networks and embeddings
_FINAL_RATE = 0.03  # final learning rates, as a share of the initial ones
_RISE, _FALL = 0.3, 0.1  # step of an opacity grid cell toward a more or a less opaque sample [share of the difference]
_LOG_OFFSET = 0.05  # added to distances in the distortion loss's logarithm [share of the near box's longest half side]
_WARM_UP = 20  # steps of rising learning rate, per section
_MOVERS_SHARE = 0.3  # share of the steps after which the field is good enough to find movers (`transients.py`)
_EXPLORATION_SHARE = 0.15  # share of the steps, the first ones, in which sampling narrows and cameras are not refined


class Trainer:
    """Trains a field: call `step()` until `done`, then `finish()`."""

    def __init__(
        self,
        cameras: Cameras,
        points: SparsePoints,
        config: NerfConfig,
        seed: int,
        device: str,
        camera_height: float = 0.0,
    ):
        self.config, self.seed, self.device = config, seed, device
        self.pixels = TrainingPixels(cameras, points, config.max_width, camera_height)
        train = self.pixels.cameras
        self.road = divide_road(cameras.positions, config.section_length)
        self.frames = self.road.frames(train.positions)
        """Indices of the training frames of each section."""
        self.stereo: dict[str, Any] | None = None
        """Summary of the stereo depths; None without `nerf.stereo`."""
        if config.stereo:
            self.pixels.stereo, self.stereo = stereo_depths(self.pixels, seed, device)
        self.excluded: list[NDArray[np.bool_]] = []
        """One mask per training frame, true on transients; an empty list before the first call of `_exclude`."""
        self.moving = 0.0
        """Fraction of the training pixels that show movers."""
        self.left: list[LeftObject] = left_objects(self.pixels) if config.transients else []
        # The field must never learn the colors of these objects: some lightings have no pixels that would correct them.
        if self.left:
            self._exclude(object_masks(self.pixels, self.left))
        self.poles = find_poles(self.pixels, camera_height) if config.poles and camera_height > 0.0 else Poles.none()
        lightings = tuple(dict.fromkeys(train.lightings))
        frame_lighting = np.array([lightings.index(name) for name in train.lightings])
        known, focal = self.pixels.points.distance, float(np.median(self.pixels.intrinsics[:, 0]))
        layouts = [
            section_layout(cameras.camera_to_world[frames], config, known, focal)
            for frames in self.road.frames(cameras.positions)
        ]
        self.pixels.points = join_depths([self.pixels.points, pole_depths(self.pixels, self.poles)])
        self.parts = [self.pixels.of_frames(frames) for frames in self.frames]
        """Pixels of each section."""
        self.field = untrained_field(layouts, lightings, train.names, frame_lighting, seed, device, self.road)
        self.rng = np.random.default_rng([seed, 2])
        self.shards = shard_count(device)
        self.free_points = _FREE_POINTS // self.shards
        """Free points per shard and step."""
        self.rays = -(-config.rays // self.shards) * self.shards
        per_shard = self.rays // self.shards
        self.supervised, self.triples = int(per_shard * config.sightings), int(per_shard * _TRIPLE_SHARE) // 3
        """Per shard, the number of rays with depth, and of triples of rays."""
        self._next: tuple[RayBatch, torch.Tensor | None] | None = None
        """The next step's rays and free points, if they are drawn."""
        self.ws = Workspace(layouts[0], self.rays, config.samples, device, _FREE_POINTS, training=True)
        self.free = self.road.segments(free_segments(train, config.near_plane))
        """Segments of each section, see `free_segments`."""
        self.refinement: PoseRefinement | None = None
        """Camera corrections; None without `nerf.refine_cameras`."""
        if config.refine_cameras:
            near = near_distance(layouts[0].scale, known)
            self.refinement = PoseRefinement(train.camera_to_world, self.pixels.intrinsics, near, self.ws)
            self.arrays = self.refinement.arrays
        else:
            self.arrays = CameraArrays(train.camera_to_world, self.pixels.intrinsics, device)

        f = self.field
        self.torch_parameters = {**f.parameters, "vectors": f.appearance.vectors, "residuals": f.appearance.residuals}
        for name, tensor in self.torch_parameters.items():
            if not name.startswith("trunk"):
                tensor.requires_grad_(True)
        # A frame has gradients only in the steps of its sections. Adam's steps are larger for such rare gradients, by
        # the square root of the number of sections.
        self.frame_rate = 1.0 / math.sqrt(self.road.count)
        shared = [tensor for name, tensor in self.torch_parameters.items() if name != "residuals"]
        groups = [{"params": shared, "factor": 1.0}, {"params": [f.appearance.residuals], "factor": self.frame_rate}]
        self.optimizer = torch.optim.Adam(groups, lr=_NETWORK_RATE, betas=(0.9, 0.99), eps=1e-12)
        self.moments = [
            [warp_view(torch.zeros_like(section.table), hashgrid.Feature) for _ in range(3)] for section in f.sections
        ]
        """For each section, the hash table's gradient, and Adam's first and second moment of it."""
        self.steps = config.steps * self.road.count
        """Number of steps; the sections take turns."""
        self.movers_step = int(_MOVERS_SHARE * self.steps)
        """Number of steps after which movers are searched."""
        self.steps_done = 0

    @property
    def done(self) -> bool:
        return self.steps_done >= self.steps

    def rate(self) -> float:
        """Current learning rate, as a share of the initial one."""
        warm = min(1.0, (self.steps_done + 1) / (_WARM_UP * self.road.count))
        return warm * math.exp(math.log(_FINAL_RATE) * self.steps_done / self.steps)

    def step(self) -> torch.Tensor:
        """Runs one training step; returns the mean squared error of the colors of each shard, on the device.

        Reading them at once would stop a GPU until the host has prepared the next step.
        """
        if self.config.transients and self.steps_done == self.movers_step:
            movers = mover_masks(self.pixels, cell_depths(self.pixels, self.field, self.arrays))
            self.moving = sum(float(mask.sum()) for mask in movers) / len(self.pixels.colors)
            self._exclude(movers)
        ws, device = self.ws, self.device
        section = self.steps_done % self.road.count
        batch, free = self._next or self._draw(self.steps_done)
        ws.camera.copy_(torch.from_numpy(batch.frame))
        ws.pixel.copy_(torch.from_numpy(batch.pixel))
        ws.targets.copy_(torch.from_numpy(batch.distance))
        color = torch.from_numpy(batch.color).to(device)
        if free is not None:
            ws.positions[self.rays * ws.samples :].copy_(free)

        results = parallel(
            lambda shard: self._shard(section, shard, color, free is not None), range(self.shards), device
        )
        self._update(section, [r[1] for r in results])
        self.steps_done += 1
        return torch.stack([r[0] for r in results])

    def _draw(self, step: int) -> tuple[RayBatch, torch.Tensor | None]:
        """The rays and free points of a step."""
        section = step % self.road.count
        singles = self.rays // self.shards - self.supervised - 3 * self.triples
        batch = self.parts[section].batch(self.rng, self.shards, self.triples, singles, self.supervised)
        return batch, self._free_points(section, _FREE_POINTS)

    def _shard(
        self, section: int, shard: int, color: torch.Tensor, free: bool
    ) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Runs a shard; returns its mean squared error, and its gradients in the order of `torch_parameters`."""
        f, s, ws, shards = self.field, self.field.sections[section], self.ws, self.shards
        count = self.rays // shards
        start = shard * count
        rays = slice(start, start + count)
        samples = slice(start * ws.samples, (start + count) * ws.samples)
        first_free = self.rays * ws.samples + shard * self.free_points
        explore = max(0.0, 1.0 - self.steps_done / (_EXPLORATION_SHARE * self.steps + 1))

        s.cast(ws, self.arrays, start, count)
        s.sample(ws, start, count, 0.1 + explore, target_mass=0.3, seed=self.seed * 1_000_003 + self.steps_done)
        s.query(ws, samples.start, count * ws.samples)
        s.composite(ws, start, count)

        composited = ws.composited[rays].detach().requires_grad_(True)
        frame = ws.camera[rays].long()
        residuals = f.appearance.residuals
        harmonics = network.spherical_harmonics(ws.directions[rays])
        features = network.ray_features(f.parameters, composited, harmonics)
        rgb = network.head(f.parameters, features, harmonics, f.appearance.of_frames(frame))
        error = rgb - color[rays]
        # Terms are divided by the number of shards: the losses of all shards then sum to the mean over the batch.
        loss = torch.nn.functional.smooth_l1_loss(rgb, color[rays], beta=0.1) / shards
        loss = loss + _RESIDUAL * (residuals[frame] ** 2).mean() / shards
        loss = loss + horizon_loss(composited[:, 0], ws.directions[rays, 2]) / shards
        inverse_depth = (ws.inverse_distance[rays] / ws.cosines[rays]).requires_grad_(True)
        if self.triples:
            in_triples = slice(3 * self.triples)
            loss = loss + _PLANE / shards * plane_loss(inverse_depth[in_triples], color[rays][in_triples])
        learned = [t for n, t in self.torch_parameters.items() if not n.startswith("trunk")]
        gradients = torch.autograd.grad(loss, [composited, inverse_depth, *learned], allow_unused=True)
        with torch.no_grad():
            ws.composited_grad[rays] = gradients[0]
            if gradients[1] is not None:
                ws.inverse_grad[rays] = gradients[1] / ws.cosines[rays]
            s.composite_backward(
                *(ws, start, count, _DISTORTION / self.rays, _DEPTH / self.rays, _DEPTH_REACH),
                _LOG_OFFSET * s.layout.scale,
            )
            first, second = self._trunk_backward(samples)
            if self._refines:
                self.refinement.backward(s, start, count)  # type: ignore[union-attr]
            if free:
                more = self._free_backward(s, first_free)
                first, second = first + more[0], second + more[1]
            inputs = [ws.w_outputs, s.layout.density_unit, samples.start]
            wp.launch(volume.sample_densities, count * ws.samples, inputs, [ws.w_densities], device=self.device)
            return (error.detach() ** 2).mean(), [first, second, *gradients[2:]]

    def _exclude(self, masks: list[NDArray[np.bool_]]) -> None:
        """Excludes marked pixels from training, in addition to earlier ones."""
        self.pixels.exclude(masks)
        self.parts = [self.pixels.of_frames(frames) for frames in self.frames]
        before = self.excluded or [np.zeros_like(mask) for mask in masks]
        self.excluded = [one | other for one, other in zip(before, masks, strict=True)]

    @property
    def _refines(self) -> bool:
        """True if this step refines cameras: not at first, while the field is less accurate than the cameras."""
        return self.refinement is not None and self.steps_done >= _EXPLORATION_SHARE * self.steps

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

    def _free_backward(self, section: FieldSection, start: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradients of the loss `_FREE` · mean(log(1 + σ·scale)) over free points of density σ.

        With respect to raw density, the gradient saturates at high density.
        """
        ws, layout = self.ws, section.layout
        section.query(ws, start, self.free_points)
        rows = slice(start, start + self.free_points)
        density = torch.exp(ws.outputs[rows, 0].clamp(max=volume.RAW_LIMIT)) * layout.density_unit
        depth = density * layout.scale
        ws.outputs_grad[rows, 0] = _FREE / _FREE_POINTS * depth / (1.0 + depth)
        return self._trunk_backward(rows)

    def _update(self, section: int, gradients: list[list[torch.Tensor]]) -> None:
        """Takes a step of all optimizers, updates the opacity grids, and draws the next step's rays.

        These are independent tasks. On a CPU they run in parallel: hash levels and two halves of the grids' cells are
        one task each, those that take longest first.
        """
        rate, levels = self.rate(), self.config.levels
        each, parts = (1, 2) if self.device == "cpu" else (levels, 1)
        tasks: list[Callable[[], None]] = [self._draw_next]
        tasks += [partial(self._update_levels, section, k, each, rate) for k in reversed(range(0, levels, each))]
        tasks += [partial(self._update_grids, section, part, parts) for part in range(parts)]
        tasks.append(partial(self._update_networks, gradients, rate))
        parallel(lambda task: task(), tasks, self.device)

    def _draw_next(self) -> None:
        """Draws the next step's rays, unless that step excludes pixels first."""
        following = self.steps_done + 1
        waits = self.config.transients and following == self.movers_step
        self._next = None if waits or following >= self.steps else self._draw(following)

    def _update_networks(self, gradients: list[list[torch.Tensor]], rate: float) -> None:
        """Steps of the networks, the embeddings and the cameras; `gradients` are those of each shard."""
        for tensor, *of_shards in zip(self.torch_parameters.values(), *gradients, strict=True):
            tensor.grad = torch.stack(of_shards).sum(0) if len(of_shards) > 1 else of_shards[0]
        for group in self.optimizer.param_groups:
            group["lr"] = _NETWORK_RATE * rate * group["factor"]
        self.optimizer.step()
        if self._refines:
            self.refinement.step(rate * self.frame_rate)  # type: ignore[union-attr]

    def _update_levels(self, section: int, first: int, count: int, rate: float) -> None:
        """Accumulates the gradients of `count` hash levels from `first` on, and takes an Adam step on them."""
        s, ws, moments = self.field.sections[section], self.ws, self.moments[section]
        t = self.steps_done // self.road.count + 1
        gradients = [ws.w_positions, s.w_levels, first, ws.w_features_grad, moments[0]]
        wp.launch(hashgrid.encode_backward, (count, ws.features.shape[0]), gradients, device=self.device)
        rates = [self.config.learning_rate * rate / (1.0 - 0.9**t), 1.0 / (1.0 - 0.99**t)]
        tables = [s.w_table, *moments]
        wp.launch(hashgrid.adam_step, (count, s.table.shape[1]), [first, *rates, *tables], device=self.device)

    def _update_grids(self, section: int, part: int, parts: int) -> None:
        """Updates one of `parts` parts of the cells of a section's opacity grids."""
        s, ws = self.field.sections[section], self.ws
        inputs = [ws.w_positions, ws.w_densities, _RISE, _FALL, part, parts, s.w_grids]
        wp.launch(volume.update_grids, self.rays * ws.samples, inputs, device=self.device)

    def _free_points(self, section: int, n: int) -> torch.Tensor | None:
        """Grid positions of random free points of a section, shape (n, 3); None without free segments."""
        free = self.free[section]
        if not len(free):
            return None
        points = random_free_points(self.rng, free, n, self.config.near_plane)
        return torch.from_numpy(self.field.sections[section].layout.grid_positions(points))

    def finish(self) -> RadianceField:
        """The trained field, detached from autograd."""
        for tensor in self.torch_parameters.values():
            tensor.requires_grad_(False)
        return self.field


def train_field(
    cameras: Cameras,
    points: SparsePoints,
    config: NerfConfig,
    seed: int = 0,
    camera_height: float = 0.0,
    device: str | None = None,
) -> tuple[RadianceField, dict[str, Any], Cameras, list[NDArray[np.bool_]], Poles, DepthSupervision]:
    """Trains a field.

    Returns it, training metrics, cameras (refined if configured), `Trainer.excluded`, poles, and stereo depths.

    `camera_height` [m] is the constant height of the camera above the ground, 0 if it is not constant; for `device` see
    `buffers.resolve_device`. Raises InputError if training diverges.
    """
    device = resolve_device(device)
    trainer = Trainer(cameras, points, config, seed, device, camera_height=camera_height)
    curve: list[list[float]] = []
    began = time.perf_counter()
    mean = 0.0
    pending: list[torch.Tensor] = []
    with bar("training", trainer.steps, "step") as progress, single_threaded_torch():
        while not trainer.done:
            pending.append(trainer.step())
            report = trainer.steps_done % 20 == 0 or trainer.done
            # Reading a result stops a GPU, so it is done seldom, but always before the field is used to find movers.
            if device == "cpu" or report or trainer.steps_done == trainer.movers_step:
                for k, shards in enumerate(torch.stack(pending).tolist(), trainer.steps_done - len(pending) + 1):
                    error = sum(shards) / len(shards)
                    if not math.isfinite(error):
                        raise InputError(f"training diverged at step {k}; lower nerf.learning_rate")
                    mean = error if k == 1 else 0.98 * mean + 0.02 * error
                pending.clear()
            if report:
                progress.set_postfix_str(f"PSNR {-10 * math.log10(mean):.2f} dB", refresh=False)
                curve.append([trainer.steps_done, round(-10 * math.log10(mean), 3)])
            progress.update()
    seconds = time.perf_counter() - began
    field, moved = trainer.finish(), None
    if trainer.refinement:
        cameras, moved = trainer.refinement.refined_cameras(cameras)
    in_torch = sum(t.numel() for t in trainer.torch_parameters.values())
    return (
        field,
        {
            "steps": trainer.steps,
            "sections": trainer.road.count,
            "seconds_train": round(seconds, 2),
            "rays_per_second": round(trainer.steps * trainer.rays / seconds, 1),
            "train_psnr": curve[-1][1],
            "parameters": int(sum(section.table.numel() for section in field.sections) + in_torch),
            "sightings_points": len(trainer.pixels.points.frame),
            "sightings_path": len(trainer.pixels.path.frame),
            "stereo": trainer.stereo,
            "poles": len(trainer.poles),
            "cameras_moved": moved,
            "transients": {"moving_share": round(trainer.moving, 4), "objects": [one.to_json() for one in trainer.left]}
            if config.transients
            else None,
            "curve": curve,
        },
        cameras,
        trainer.excluded,
        trainer.poles,
        trainer.pixels.stereo,
    )


# ---- stage

_TIMING_KEYS = ("seconds", "seconds_train", "rays_per_second")


def without_timings(metrics: dict[str, Any]) -> dict[str, Any]:
    """Metrics without timings: a rebuild then gives equal files, and lightings fitted to the field stay valid."""
    return {
        name: without_timings(value) if isinstance(value, dict) else value
        for name, value in metrics.items()
        if name not in _TIMING_KEYS
    }


def run(scene: SceneDir, config: SceneConfig, out: Path, device: str | None = None) -> dict[str, Any]:
    """Runs stage `field`: trains and bakes a field, adds detail, evaluates it on held-out frames, and saves it.

    Saves both the trained and the baked field, the poles, and a picture of excluded pixels; returns the metrics. Raises
    InputError without a training frame, on an unreadable frame, on an unavailable device, or if training diverges.
    """
    cameras = Cameras.load(scene.stage("metric"))
    points = SparsePoints.load(scene.stage("metric"))
    height = constant_height(read_json(scene.stage("metric") / "metric.json")) if config.mjcf.route else 0.0
    # A capture around an object has no road to divide.
    nerf = config.nerf if config.mjcf.route else replace(config.nerf, section_length=0.0)
    field, metrics, cameras, excluded, poles, stereo = train_field(cameras, points, nerf, config.seed, height, device)
    return_memory()
    pixels = TrainingPixels(cameras, points, config.nerf.max_width)
    if any(mask.any() for mask in excluded):
        pixels.exclude(excluded)
        write_image(out / "excluded.jpg", excluded_picture(pixels, excluded))
    baked, metrics["bake"] = bake(field, pixels, config.seed, config.nerf.bake_steps, config.nerf.max_bricks)
    return_memory()
    if config.nerf.detail_passes > 0.0:
        metrics["detail"] = fit_detail(baked, field.appearance, pixels, stereo, config.seed, config.nerf.detail_passes)
    metrics |= evaluate(field, cameras, config.nerf.max_width, baked=baked)
    metrics["cross_lighting"] = cross_lighting(baked, cameras)
    about = {
        "scene": config.name,
        "seed": config.seed,
        "nerf": asdict(config.nerf),
        "versions": {name: metadata.version(name) for name in ("twin", "torch", "warp-lang", "numpy")},
        "metrics": without_timings(metrics),
    }
    field.save(out, about)
    poles.save(out)
    baked.save(out, about)
    return metrics
