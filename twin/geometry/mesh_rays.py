"""Ray casting and distance queries on a triangle mesh, on the CPU with Warp."""

# mypy: disable-error-code="index, attr-defined, valid-type, arg-type, call-overload, operator"
# (mypy does not know the types that Warp uses inside kernels)

import numpy as np
from numpy.typing import NDArray

from twin.types import Array
from twin.warp_runtime import wp

_FAR = 1.0e6  # [m] queries find no surface beyond this distance, which no place reaches; roads may be kilometers long


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
def _openness(mesh: wp.uint64, points: wp.array[wp.vec3], rays: wp.array[wp.vec3], reach: float, out: wp.array[float]):
    i = wp.tid()
    free = wp.int32(0)  # declares a variable; Warp would treat a bare literal as a constant
    for k in range(rays.shape[0]):
        if not wp.mesh_query_ray_anyhit(mesh, points[i], rays[k], reach):
            free += 1
    out[i] = float(free) / float(rays.shape[0])


class Surface:
    """A triangle mesh with vertices (n, 3) [m] and faces (m, 3)."""

    def __init__(self, vertices: Array, faces: NDArray) -> None:
        indices: wp.array = wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
        self._mesh = wp.Mesh(vectors(vertices), indices)

    def cast(self, origins: Array, rays: Array) -> Array:
        """Distance to the first hit as a multiple of the ray's length, below 0 for a miss; (k, 3), (k, 3) → (k,)."""
        length = np.linalg.norm(rays, axis=1, keepdims=True)
        return self._launch(_cast, len(origins), vectors(origins), vectors(rays / length)) / length[:, 0]

    def distance(self, points: Array) -> Array:
        """Distance of points (k, 3) from the surface [m], shape (k,)."""
        return self._launch(_nearest, len(points), vectors(points))

    def openness(self, points: Array, rays: Array, reach: float) -> Array:
        """Fraction of the unit rays (r, 3) from each point (k, 3) that hit nothing within `reach` [m], shape (k,)."""
        return self._launch(_openness, len(points), vectors(points), vectors(rays), reach)

    def _launch(self, kernel: wp.Kernel, count: int, *inputs: object) -> Array:
        out = wp.zeros(count, dtype=float, device="cpu")
        wp.launch(kernel, count, inputs=[self._mesh.id, *inputs], outputs=[out], device="cpu")
        return out.numpy().astype(np.float64)


def vectors(points: NDArray) -> wp.array:
    """Points (n, 3) as a Warp array on the CPU; single precision suffices, as scenes are some hundred meters wide."""
    return wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device="cpu")
