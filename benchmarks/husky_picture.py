"""Draws the picture of the Husky with the ray caster of the environments.

python benchmarks/husky_picture.py twin/assets/husky/husky.png
"""

import argparse
from pathlib import Path

import cv2
import mujoco
import numpy as np

from twin.env.mujoco_renderer import RayCaster, mujoco_rays
from twin.geometry.cameras import opencv_to_mujoco, pixel_grid, unproject
from twin.geometry.images import write_image
from twin.geometry.poses import look_at
from twin.mjcf.husky import HUSKY_SCENE_XML

_SIZE, _SUPERSAMPLED = (640, 360), 2
_FOCAL = 700.0  # [px]
_EYE, _TARGET = (1.5, -1.25, 0.95), (0.0, 0.02, 0.2)  # [m]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    model = mujoco.MjModel.from_xml_path(str(HUSKY_SCENE_XML))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    width, height = (_SUPERSAMPLED * side for side in _SIZE)
    shown = {"enabled_geom_groups": [0, 1, 2], "render_skybox": True, "use_shadows": True}
    active = [True] + [False] * (model.ncam - 1)
    caster = RayCaster(model, data, cam_res=(width, height), cam_active=active, enable_backface_culling=False, **shown)
    pose = opencv_to_mujoco(look_at(np.array(_EYE), np.array(_TARGET)))
    positions, rotations = data.cam_xpos.copy(), data.cam_xmat.copy()
    positions[0], rotations[0] = pose[:3, 3], pose[:3, :3].ravel()
    caster.set_poses(cam_xpos=positions, cam_xmat=rotations)
    focal = _FOCAL * _SUPERSAMPLED
    intrinsics = np.array([focal, focal, width / 2, height / 2])
    caster.set_rays(mujoco_rays(unproject(pixel_grid(width, height), intrinsics)))
    rgb = cv2.resize(caster.cast()[0].reshape(height, width, 3), _SIZE, interpolation=cv2.INTER_AREA)
    write_image(out, np.rint(rgb).astype(np.uint8))


if __name__ == "__main__":
    main()
