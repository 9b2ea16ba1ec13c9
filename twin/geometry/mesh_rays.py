"""A triangle mesh that rays and distances are asked of, on the CPU."""

# mypy: disable-error-code="index, attr-defined"
# (inside kernels, Warp's own types hold, which mypy does not know)

import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.types import Array

wp.config.log_level = wp.LOG_ERROR  # compiling is announced by our own bars


_FAR = 1.0e3  # [m]


@wp.kernel
def _cast(mesh: wp.uint64, origins: wp.array[wp.vec3], rays: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], rays[i], _FAR)
    out[i] = -1.0
    if hit.result:
        out[i] = hit.t


@wp.kernel
def _nearest(mesh: wp.uint64, points: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    hit = wp.mesh_query_point_no_sign(mesh, points[i], _FAR)
    out[i] = _FAR
    if hit.result:
        out[i] = wp.length(points[i] - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v))


@wp.kernel
def _open(mesh: wp.uint64, points: wp.array[wp.vec3], rays: wp.array[wp.vec3], reach: float, out: wp.array[float]):
    i = wp.tid()
    free = wp.int32(0)  # a variable to Warp, where a bare literal would be a constant
    for k in range(rays.shape[0]):
        if not wp.mesh_query_ray_anyhit(mesh, points[i], rays[k], reach):
            free += 1
    out[i] = float(free) / float(rays.shape[0])


class Surface:
    """A mesh of vertices (n, 3) [m] and faces (m, 3)."""

    def __init__(self, vertices: Array, faces: NDArray) -> None:
        indices: wp.array = wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
        self._mesh = wp.Mesh(_vectors(vertices), indices)

    def cast(self, origins: Array, rays: Array) -> Array:
        """Where rays first hit, in units of their length (−1: nowhere); shapes (k, 3), (k, 3) → (k,)."""
        return self._ask(_cast, len(origins), _vectors(origins), _vectors(_unit(rays))) / np.linalg.norm(rays, axis=1)

    def distance(self, points: Array) -> Array:
        """Distance of points (k, 3) from the surface [m], shape (k,)."""
        return self._ask(_nearest, len(points), _vectors(points))

    def openness(self, points: Array, rays: Array, reach: float) -> Array:
        """Share of the unit rays (r, 3) from each point (k, 3) that go free for `reach` [m], shape (k,)."""
        return self._ask(_open, len(points), _vectors(points), _vectors(rays), reach)

    def _ask(self, kernel: wp.Kernel, count: int, *inputs: object) -> Array:
        out = wp.zeros(count, dtype=float, device="cpu")
        wp.launch(kernel, count, inputs=[self._mesh.id, *inputs], outputs=[out], device="cpu")
        return out.numpy().astype(np.float64)


def _vectors(points: Array) -> wp.array:
    return wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")


def _unit(rays: Array) -> Array:
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
