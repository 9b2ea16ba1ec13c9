"""Benchmark of the compositor: obstacles in the twin against the same obstacles in the true world.

    python benchmarks/overlay.py --scene BUILT_SCENE_WITH_TRUTH [--json FILE] [--pictures FOLDER]

The scene was filmed without obstacles. At several places along the route, each obstacle is composited into the twin and
rendered in the true world (the generated place that was filmed), in the same colors. Both are rendered from the same
pose of the robot's front camera at 160×90, with the film's camera response and without noise. PSNR is over the pixels
that show the obstacle in the truth. *Unshaded* is the composite with plain colors, without shading. The visual and the
collision geometry are also compared, along a drive on the route, see `twin/report/visual_vs_collision.py`.
"""

import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from record import record_parser, save

from twin.config import ObstacleConfig
from twin.env.compositor import Compositor
from twin.env.obstacles import ObstacleModel, add_obstacle_geoms, add_obstacles, place
from twin.env.physics import camera_pose
from twin.geometry.cameras import Cameras, opencv_to_mujoco, pixel_grid, unproject
from twin.geometry.polyline import arc_lengths, heading_at, point_at
from twin.geometry.poses import Similarity, pose_of
from twin.loading import load_scene
from twin.mjcf.world import World
from twin.reality import true_world as reality
from twin.reality.filming import sensor_image
from twin.reality.sky import apply_haze
from twin.reality.truth import Truth, align_poses, matched_poses

SIZE = (160, 90)
KINDS = ("cone", "box", "bollard", "car", "pedestrian", "cyclist", "husky")
PLACES = tuple(  # station, lateral [m], yaw [°], distance [m] from the robot along the route
    (float(s), lateral, yaw, ahead)
    for s, lateral, yaw, ahead in (
        *((7.0, 0.3, 20.0, 3.0), (13.0, -0.7, -70.0, 5.0), (19.0, 0.9, 130.0, 4.0), (25.0, 0.0, 0.0, 6.5)),
        *((32.0, -0.4, 45.0, 4.0), (39.0, 0.8, -20.0, 3.5), (47.0, -0.9, 160.0, 5.0), (55.0, 0.2, -110.0, 4.5)),
    )
)
TARGETS = {
    "overlay.obstacle_psnr.sun": ("≥", 18.0),
    "overlay.obstacle_psnr.overcast": ("≥", 18.0),
    "overlay.obstacle_psnr.night": ("≥", 18.0),
    "overlay.gain_over_unshaded.night": ("≥", 6.0),
    "overlay.mask_iou": ("≥", 0.9),
    "seen_touched.median_m": ("≤", 0.05),
    "seen_touched.corridor_leak_m": ("≤", 0.2),
    "seen_touched.corridor_ghost_m": ("≤", 0.2),
}


class TrueWorld:
    """The true world under one lighting, with one movable obstacle of every kind."""

    def __init__(self, truth: Truth, lighting: str, intrinsics: np.ndarray) -> None:
        spec = reality.world_spec(lighting, truth.place)
        for kind in KINDS:
            body = spec.worldbody.add_body(name=f"added_{kind}", mocap=True, pos=(0, 0, -100.0))
            add_obstacle_geoms(ObstacleModel(spec, body, group=1, solid=False), kind)
        height = SIZE[1]
        spec.camera("film").fovy = float(np.rad2deg(2 * np.arctan(height / 2 / intrinsics[1])))
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.light = replace(truth.place.lightings[lighting], noise=0.0)
        self._ground, self._rays = truth.ground_height, unproject(pixel_grid(*SIZE), intrinsics)
        shadows = any(shadow for _, _, shadow in self.light.suns)
        with wp.ScopedDevice("cpu"):
            self.device_model = mujoco_warp.put_model(self.model)
            self.device = mujoco_warp.put_data(self.model, self.data)
            # The first context is as in `twin.reality.filming.Renderer`; the second samples pixel centers, for depth.
            self.contexts = [
                mujoco_warp.create_render_context(
                    self.model,
                    cam_res=SIZE,
                    render_rgb=True,
                    render_depth=True,
                    use_shadows=shadows,
                    enabled_geom_groups=[0, 1],
                    render_skybox=True,
                    enable_backface_culling=False,
                    shadow_light_fraction=0.0,
                    samples_per_pixel=samples,
                    enable_specular=False,
                )
                for samples in (2, 1)
            ]

    def render(self, camera_to_world: np.ndarray, kind: str | None, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Film colors (h, w, 3) and z-depth [m] at pixel centers, with an obstacle of a kind at a pose (4, 4)."""
        for name in KINDS:
            mocap = self.model.body(f"added_{name}").mocapid[0]
            self.data.mocap_pos[mocap] = pose[:3, 3] if name == kind else (0, 0, -100.0)
            mujoco.mju_mat2Quat(self.data.mocap_quat[mocap], pose[:3, :3].ravel())
        mujoco.mj_kinematics(self.model, self.data)
        camera = opencv_to_mujoco(camera_to_world)
        with wp.ScopedDevice("cpu"):
            self.device.geom_xpos.assign(self.data.geom_xpos[None].astype(np.float32))
            self.device.geom_xmat.assign(self.data.geom_xmat.reshape(1, -1, 3, 3).astype(np.float32))
            self.device.cam_xpos.assign(camera[None, None, :3, 3].astype(np.float32))
            self.device.cam_xmat.assign(camera[None, None, :3, :3].astype(np.float32))
            for context in self.contexts:
                mujoco_warp.refit_bvh(self.device_model, self.device, context)
                mujoco_warp.render(self.device_model, self.device, context)
            packed = self.contexts[0].rgb_data.numpy()[0].reshape(SIZE[::-1])
            depth = self.contexts[1].depth_data.numpy()[0].reshape(SIZE[::-1]).copy()
        light = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.float32) / 255.0
        ground = float(self._ground(camera_to_world[:2, 3]))
        light = apply_haze(light, depth, self._rays, camera_to_world, self.light, ground)
        return sensor_image(np.random.default_rng(0), light, self.light, 1.0) / 255.0, np.where(depth > 0.0, depth, 1e4)


def robot_at(world: World, model: mujoco.MjModel, data: mujoco.MjData, station: float) -> np.ndarray:
    """Places the robot on the route, at rest; returns camera_to_world of its front camera."""
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    turn = float(heading_at(world.route, station) - world.spawn[3])
    rest = data.qpos[3:7].copy()
    about_z = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    mujoco.mju_mulQuat(data.qpos[3:7], about_z, rest)
    data.qpos[:2] = point_at(world.route[:, :2], station)
    data.qpos[2] += float(point_at(world.route, station)[2] - point_at(world.route, world.start)[2])
    mujoco.mj_forward(model, data)
    return camera_pose(data, model.camera("front").id)


def round_trip(scene_path: Path, pictures: Path | None = None, kinds: tuple[str, ...] = KINDS) -> dict[str, Any]:
    """Compares composited obstacles with the truth.

    Returns:
        Figures by name: `overlay.obstacle_psnr.<lighting>`, `overlay.unshaded_psnr.<lighting>` [dB],
        `overlay.gain_over_unshaded.<lighting>` [dB], `overlay.psnr_of.<kind>` [dB], `overlay.mask_iou` and
        `overlay.mask_iou.<lighting>`; `overlay.shadow_rms.<lighting>`, rms error of the shadow factor over pixels
        beside the obstacle that its shadow dims by more than 5 % in the twin or in the truth;
        `overlay.no_shadow_rms.<lighting>`, the error that a twin without shadows would have;
        `overlay.places.<lighting>`, number of placements.
    """
    scene = load_scene(scene_path)
    world, field = scene.world(), scene.field()
    truth = Truth.load(scene.scene.truth)
    cameras: Cameras = scene.cameras()
    to_truth: Similarity = align_poses(cameras.camera_to_world, matched_poses(truth, cameras))
    spec = mujoco.MjSpec.from_file(str(world.model_path))
    pool = tuple(ObstacleConfig(kind, kind) for kind in kinds)
    add_obstacles(spec, pool, world)
    model = spec.compile()
    data = mujoco.MjData(model)
    compositors = {"shaded": Compositor(model, field, SIZE), "unshaded": Compositor(model, field, SIZE, shaded=False)}
    errors: dict[str, list[np.ndarray]] = defaultdict(list)
    ious: dict[str, list[tuple[int, int]]] = defaultdict(list)
    length = float(arc_lengths(world.route)[-1])
    for lighting in (name for name in field.lightings if name in truth.place.lightings):
        true_world = TrueWorld(truth, lighting, world.intrinsics)
        rows = []
        for kind in kinds:
            for station, lateral, yaw, ahead in PLACES:
                if station > length:
                    continue
                if kind == "car":  # a car needs more room
                    lateral, ahead = lateral + 1.8, ahead + 3.0
                placed = (ObstacleConfig(kind, kind, station, lateral, yaw),)
                eye = robot_at(world, model, data, max(world.start, station - ahead))
                place((), data, 0.0)
                mujoco.mj_forward(model, data)
                empty = compositors["shaded"].render([data], lighting)
                place(placed, data, 0.0)
                mujoco.mj_forward(model, data)
                body = data.body(f"obstacle_{kind}")
                pose = pose_of(body.xmat.reshape(3, 3), body.xpos)
                true_eye, true_pose = to_truth.poses(eye), to_truth.poses(pose)
                empty_truth, empty_truth_depth = true_world.render(true_eye, None, true_pose)
                truth_rgb, depth = true_world.render(true_eye, kind, true_pose)
                seen = depth < empty_truth_depth - 1e-3
                if seen.sum() < 20:
                    continue
                composites = {}
                for name, compositor in compositors.items():
                    out = compositor.render([data], lighting)
                    composites[name] = out.rgb[0]
                    error = ((out.rgb[0] - truth_rgb)[seen] ** 2).ravel()
                    errors[f"{name}.{lighting}"].append(error)
                    if name == "shaded":
                        dimmed = [
                            luminance(a) / np.maximum(luminance(b), 0.02)
                            for a, b in ((truth_rgb, empty_truth), (out.rgb[0], empty.rgb[0]))
                        ]
                        ground = (
                            ~seen & (out.depth[0] > empty.depth[0] - 1e-3) & ((dimmed[0] < 0.95) | (dimmed[1] < 0.95))
                        )
                        errors[f"shadow.{lighting}"].append((dimmed[1] - dimmed[0])[ground])
                        errors[f"no_shadow.{lighting}"].append((1.0 - dimmed[0])[ground])
                        errors[f"kind.{kind}"].append(error)
                        mine = out.depth[0] < empty.depth[0] - 1e-3
                        ious[lighting].append((int((mine & seen).sum()), int((mine | seen).sum())))
                rows.append(
                    (
                        kind,
                        np.concatenate([truth_rgb, composites["shaded"], composites["unshaded"]], 1),
                        error_db(errors[f"shaded.{lighting}"][-1:]),
                    )
                )
        if pictures:
            save_pictures(pictures, lighting, rows)
    figures: dict[str, Any] = {}
    for lighting in ious:
        shaded, unshaded = error_db(errors[f"shaded.{lighting}"]), error_db(errors[f"unshaded.{lighting}"])
        figures[f"overlay.obstacle_psnr.{lighting}"] = shaded
        figures[f"overlay.unshaded_psnr.{lighting}"] = unshaded
        figures[f"overlay.gain_over_unshaded.{lighting}"] = shaded - unshaded
        intersection, union = np.sum(ious[lighting], 0)
        figures[f"overlay.mask_iou.{lighting}"] = float(intersection / union)
        # The true world's sky is ambient light without occlusion: only its sun casts shadows.
        casts = any(shadow for _, _, shadow in truth.place.lightings[lighting].suns)
        for name in ("shadow", "no_shadow") if casts else ():
            off = np.concatenate(errors[f"{name}.{lighting}"])
            figures[f"overlay.{name}_rms.{lighting}"] = float(np.sqrt((off**2).mean()))
        figures[f"overlay.places.{lighting}"] = len(ious[lighting])
    for kind in kinds:
        if errors[f"kind.{kind}"]:
            figures[f"overlay.psnr_of.{kind}"] = error_db(errors[f"kind.{kind}"])
    intersection, union = np.sum([pair for pairs in ious.values() for pair in pairs], 0)
    figures["overlay.mask_iou"] = float(intersection / union)
    return figures


def visual_vs_collision(scene_path: Path) -> dict[str, Any]:
    """Figures `seen_touched.*` of `twin.report.visual_vs_collision`, for a scripted drive along the route."""
    from twin.assets.ground import Ground
    from twin.env.drivers import follow_route
    from twin.env.physics import HuskyPhysics
    from twin.mjcf.scene_xml import Parts
    from twin.report.visual_vs_collision import compare_geometry, render_views, view_poses

    scene = load_scene(scene_path)
    world, field, mesh = scene.world(), scene.field(), scene.scene.stage("mesh")
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot))
    views = render_views(field, world, view_poses(drive.camera_to_world), field.lightings[0])
    found = compare_geometry(views, world, scene.cameras(), Ground.load(mesh), Parts.load(mesh / "parts.npz"))
    return {f"seen_touched.{name}": value for name, value in found.items() if name != "along"}


def luminance(rgb: np.ndarray) -> np.ndarray:
    return rgb @ np.array([0.299, 0.587, 0.114])


def error_db(errors: list[np.ndarray]) -> float:
    """PSNR [dB] of squared errors, over all pixels of the arrays."""
    return float(-10.0 * np.log10(max(np.concatenate(errors).mean(), 1e-12)))


def save_pictures(folder: Path, lighting: str, rows: list[tuple[str, np.ndarray, float]]) -> None:
    """Writes truth, composite and unshaded composite side by side, one row per placement."""
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    for kind in dict.fromkeys(name for name, _, _ in rows):
        stack = np.concatenate([row for name, row, _ in rows if name == kind])
        picture = (np.clip(stack, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
        big = cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
        for k, (_, _, score) in enumerate(row for row in rows if row[0] == kind):
            cv2.putText(big, f"{score:.1f} dB", (650, 360 * k + 30), 0, 0.8, (255, 255, 0), 2)
        cv2.imwrite(str(folder / f"{lighting}_{kind}.jpg"), big[..., ::-1])


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--scene", type=Path, required=True, help="a built scene with its truth, such as scenes/demo")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="folder for comparison images")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    options = parser.parse_args()
    figures = round_trip(options.scene, options.pictures, tuple(options.kinds)) | visual_vs_collision(options.scene)
    for name, value in figures.items():
        sense, target = TARGETS.get(name, ("", 0.0))
        print(f"{name:40} {value:10.4g}  {f'{sense} {target:g}' if sense else ''}".rstrip())
    return save(options.json, figures, options.replace_record)


if __name__ == "__main__":
    sys.exit(main())
