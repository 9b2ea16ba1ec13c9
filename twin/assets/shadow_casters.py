"""Surfaces of a scene that cast shadows: its visual mesh and, above and around it, depth rendered from the field.

The mesh ends 2 m above `mesh.max_height` and at `mesh.margin` beside the route, but houses and trees beyond it cast
shadows, too. So the depth of the field at filmed poses is turned into triangles, which connect neighboring pixels of
about the same depth. They are less accurate than the mesh, hence *rough*.
"""

import numpy as np
from numpy.typing import NDArray

from twin.assets.ground import Ground
from twin.assets.views import Views, render_views
from twin.files import load_arrays
from twin.geometry.cameras import Cameras
from twin.geometry.shadow_map import ShadowCasters
from twin.nerf.rendering import RenderableField
from twin.scene import SceneDir, require_stage
from twin.types import Array

_VIEWS, _WIDTH = 40, 96  # number of rendered poses, and their width [px]
_REACH = 45.0  # [m] greatest depth
_MAX_DEPTH_RATIO = 1.15  # between the depths of a triangle's corners; with a larger one, it connects different surfaces
_LEAST_HEIGHT = 1.0  # [m] lowest height above the ground outside the mesh's box
_OVERLAP = 0.5  # [m] by which the triangles begin below the top of the mesh's box, and within its sides


def shadow_casters(scene: SceneDir, field: RenderableField) -> ShadowCasters:
    """The surfaces of a scene that cast shadows. Raises InputError if its mesh is not built or damaged."""
    stage = require_stage(scene, "mesh")
    data = load_arrays(stage / "visual.npz")
    vertices, faces = data["vertices"].astype(np.float64), data["faces"].astype(np.int64)
    views = render_views(field, Cameras.load(scene.stage("metric")), _VIEWS, _WIDTH, _REACH)
    return ShadowCasters(vertices, faces, *rough_triangles(views, Ground.load(stage), vertices))


def rough_triangles(views: Views, ground: Ground, mesh_vertices: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (v, 3) [m] and faces (f, 3) of the surfaces in views that lie above or outside the mesh's box."""
    top = float((mesh_vertices[:, 2] - ground.at(mesh_vertices[:, :2])).max(initial=0.0)) - _OVERLAP
    low, high = mesh_vertices[:, :2].min(0) + _OVERLAP, mesh_vertices[:, :2].max(0) - _OVERLAP
    all_vertices, all_faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for i in range(len(views)):
        depth, points = views.depth[i], views.points(i)
        number = np.arange(depth.size).reshape(depth.shape)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        corners = depth.ravel()[faces]
        faces = faces[
            (corners.min(1) > 0.0)
            & (corners.max(1) < _REACH)
            & (corners.max(1) < _MAX_DEPTH_RATIO * np.maximum(corners.min(1), 1e-3))
        ]
        middle = points.reshape(-1, 3)[faces].mean(1)
        height = middle[:, 2] - ground.at(middle[:, :2])
        inside = ((middle[:, :2] > low) & (middle[:, :2] < high)).all(1)
        faces = faces[height > np.where(inside, top, _LEAST_HEIGHT)]
        used, index = np.unique(faces, return_inverse=True)
        all_vertices.append(points.reshape(-1, 3)[used])
        all_faces.append(index.reshape(-1, 3) + count)
        count += len(used)
    return np.concatenate(all_vertices), np.concatenate(all_faces)
