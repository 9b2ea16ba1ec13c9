"""Renders pictures of one place with Blender's Cycles, in a process of its own.

`bpy` needs another version of numpy than `twin`, so this file imports nothing of `twin` and runs in an environment that
has `bpy` alone: `python worker.py SCENE.npz`, with a scene written by `cycles_renderer.py`. It reads camera poses from
standard input, 16 float64 each (camera_to_world, OpenCV axes, row by row), and writes to standard output, for each
pose, a picture of height × width × 3 float32: linear RGB, first row on top.
"""

import os
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np

_SUN_ANGLE = np.deg2rad(0.53)  # apparent diameter of the sun
_BOUNCES = 2  # reflections of light between surfaces
_LAMP_RADIUS = 0.12  # [m] of the lamps' spheres of light
_SENSOR_WIDTH = 100.0  # [mm] arbitrary, but Blender raises focal lengths below 1 mm to 1 mm


def build(scene_file: str) -> bpy.types.Scene:
    """Loads the scene into Blender: meshes with textures, sky, sun, lamps, camera, settings of the renderer."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with np.load(scene_file) as file:
        given = {name: file[name] for name in file.files}
    for texture, emission in {(int(t), float(e)) for t, e in zip(given["textures"], given["emissions"], strict=True)}:
        chosen = (given["textures"] == texture) & (given["emissions"] == emission)
        image = given[f"texture_{texture}"]
        name = f"surface_{texture}_{emission:g}"
        material = _material(name, image, emission)
        _add_mesh(name, given["corners"][chosen], given["normals"][chosen], given["uvs"][chosen], material)
    scene = bpy.context.scene
    _add_sky(scene, given["sky"], given["sky_gain"])
    for direction, color in zip(given["sun_directions"], given["sun_colors"], strict=True):
        light = bpy.data.lights.new("sun", "SUN")
        light.angle = _SUN_ANGLE
        light.energy, light.color = np.pi, color  # a surface that faces a sun of energy π has its albedo as radiance
        _aim(_add(light), direction)
    for position, intensity in zip(given["lamp_positions"], given["lamp_intensities"], strict=True):
        light = bpy.data.lights.new("lamp", "POINT")
        light.shadow_soft_size = _LAMP_RADIUS
        light.energy, light.color = 4.0 * np.pi, intensity  # Cycles divides the power of a point by 4π
        _add(light).location = position
    _set_camera(scene, given["intrinsics"], given["size"])
    scene.render.engine = "CYCLES"
    scene.render.threads_mode, scene.render.threads = "FIXED", int(given["threads"])
    scene.render.use_persistent_data = True  # keeps the hierarchy of bounding volumes between pictures
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", int(given["samples"]), 0
    cycles.use_adaptive_sampling = False
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.denoising_quality, cycles.denoising_prefilter = "FAST", "NONE"  # two thirds of the time of the defaults
    cycles.max_bounces = cycles.diffuse_bounces = _BOUNCES
    cycles.sample_clamp_indirect = 4.0
    return scene


def _add(data: object) -> bpy.types.Object:
    item = bpy.data.objects.new(data.name, data)
    bpy.context.scene.collection.objects.link(item)
    return item


def _aim(item: bpy.types.Object, direction: np.ndarray) -> None:
    """Turns a light, which shines along its −z axis, into a direction."""
    from mathutils import Vector

    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = Vector(direction.tolist()).to_track_quat("-Z", "Y")


def _image(name: str, pixels: np.ndarray) -> bpy.types.Image:
    """An image of linear values (h, w, 3); Blender's first row is the lowest."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True, is_data=True)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels[::-1]
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    return image


def _material(name: str, texture: np.ndarray, emission: float) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    look_up = tree.nodes.new("ShaderNodeTexImage")
    look_up.image, look_up.extension = _image(name, texture.astype(np.float32) / 255.0), "EXTEND"
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    tree.links.new(look_up.outputs["Color"], diffuse.inputs["Color"])
    surface = diffuse.outputs[0]
    if emission > 0.0:
        glow, both = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeAddShader")
        glow.inputs["Strength"].default_value = emission
        tree.links.new(look_up.outputs["Color"], glow.inputs["Color"])
        tree.links.new(surface, both.inputs[0])
        tree.links.new(glow.outputs[0], both.inputs[1])
        surface = both.outputs[0]
    out = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(surface, out.inputs["Surface"])
    return material


def _add_mesh(name: str, corners: np.ndarray, normals: np.ndarray, uvs: np.ndarray, material: object) -> None:
    """Adds triangles that share no vertices: corners and normals (m, 3, 3), uvs (m, 3, 2) with rows from the top."""
    count = len(corners)
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners.reshape(-1, 3), [], np.arange(3 * count).reshape(-1, 3))
    layer = mesh.uv_layers.new(name="uv")
    flipped = uvs.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]
    layer.data.foreach_set("uv", flipped.astype(np.float32).ravel())
    mesh.normals_split_custom_set(normals.reshape(-1, 3).tolist())
    mesh.materials.append(material)
    _add(mesh)


def _add_sky(scene: bpy.types.Scene, sky: np.ndarray, gain: np.ndarray) -> None:
    """The camera sees the sky's picture (equirectangular); surfaces are lit by this picture times `gain` (3,)."""
    world = bpy.data.worlds.new("sky")
    scene.world = world
    world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    look_up = tree.nodes.new("ShaderNodeTexEnvironment")
    look_up.image = _image("sky", sky)
    scaled = tree.nodes.new("ShaderNodeVectorMath")
    scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = gain.tolist()
    tree.links.new(look_up.outputs["Color"], scaled.inputs[0])
    seen, lit = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeBackground")
    tree.links.new(look_up.outputs["Color"], seen.inputs["Color"])
    tree.links.new(scaled.outputs[0], lit.inputs["Color"])
    path, both = tree.nodes.new("ShaderNodeLightPath"), tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(path.outputs["Is Camera Ray"], both.inputs[0])
    tree.links.new(lit.outputs[0], both.inputs[1])
    tree.links.new(seen.outputs[0], both.inputs[2])
    out = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(both.outputs[0], out.inputs["Surface"])


def _set_camera(scene: bpy.types.Scene, intrinsics: np.ndarray, size: np.ndarray) -> None:
    """A pinhole camera: fx, fy, cx, cy [px] with fx = fy, and width, height [px]."""
    (fx, fy, cx, cy), (width, height) = intrinsics.tolist(), size.tolist()
    if abs(fx - fy) > 1e-6 * fx:
        raise SystemExit(f"fx = {fx:g}, fy = {fy:g}; this camera has square pixels, so they must be equal")
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.sensor_width = "HORIZONTAL", _SENSOR_WIDTH
    camera.lens = _SENSOR_WIDTH * fx / width
    camera.shift_x, camera.shift_y = 0.5 - cx / width, (cy - 0.5 * height) / width
    camera.clip_start, camera.clip_end = 0.02, 10_000.0
    scene.camera = _add(camera)
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100


def render(scene: bpy.types.Scene, camera_to_world: np.ndarray, folder: Path) -> np.ndarray:
    """A picture (h, w, 3) from a pose (4, 4) with OpenCV axes."""
    from mathutils import Matrix

    pose = camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # Blender's camera looks along −z with y up
    scene.camera.matrix_world = Matrix(pose.tolist())
    scene.render.filepath = str(folder / "picture.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


def main() -> None:
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Blender prints to standard output, which carries the pictures
    scene = build(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        while len(pose := sys.stdin.buffer.read(128)) == 128:
            picture = render(scene, np.frombuffer(pose).reshape(4, 4), Path(folder))
            out.write(np.ascontiguousarray(picture).tobytes())
            out.flush()


if __name__ == "__main__":
    main()
