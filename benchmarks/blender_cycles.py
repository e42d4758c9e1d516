"""Render the same image with Blender Cycles: same mesh, pose, Sun and sample count, direct light or one bounce.

Blender is optional and runs in its own process. Its wheel (`pip install bpy`, Blender 5.0, Python 3.11) requires
numpy < 2, and vbnfault requires numpy >= 2.1, so the two cannot share an environment. Make another environment,

    python3.11 -m venv blender && blender/bin/pip install bpy

and set VBNFAULT_BPY_PYTHON to its interpreter. The wheel needs these Debian packages, which most desktop
installations include: libx11-6 libxfixes3 libxi6 libxrender1 libxkbcommon0 libsm6 libice6 libgl1.

This file holds both sides: imported, it starts and controls the Blender process; run by Blender's interpreter, it
renders. That interpreter has no vbnfault, so the imports at the top are numpy and the standard library only. The
file cannot be called cycles.py, because Blender has a module of that name.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

VARIABLE = "VBNFAULT_BPY_PYTHON"
_ANSWER = "vbnfault:"  # start of our lines among those that Blender prints


class Unavailable(Exception):
    """There is no interpreter with Blender; the message says what to do."""


def interpreter() -> str:
    """Return the path of an interpreter that can `import bpy`. Raises Unavailable."""
    chosen = os.environ.get(VARIABLE, sys.executable)
    try:
        tried = subprocess.run([chosen, "-c", "import bpy"], capture_output=True, text=True, check=False)
    except OSError as error:
        raise Unavailable(f"{VARIABLE} = {chosen!r} cannot be started: {error.strerror}") from None
    if tried.returncode == 0:
        return chosen
    why = (tried.stderr.strip().splitlines() or ["it ended without a message"])[-1]
    raise Unavailable(
        f"Blender is optional and missing: {chosen} cannot import bpy ({why}); "
        f"set {VARIABLE} to an interpreter that can (see benchmarks/blender_cycles.py)"
    )


class Cycles:
    """A Blender process that holds one scene; a context manager.

    Parameters
    ----------
    python
        Result of `interpreter`.
    vertices_m, faces
        Mesh in L, float32[n, 3] and int32[m, 3].
    flat
        Faces without smooth shading, bool[m].
    position_L_m, L_from_C, sun_direction_L, sun_angular_radius_rad
        As in `vbnfault.render.description`.
    bounces
        Number of diffuse bounces; 0 is direct light only.
    poses
        Position and L_from_C at the beginning and at the end of the exposure, for an image with motion blur.
    """

    def __init__(
        self,
        python: str,
        *,
        vertices_m: np.ndarray,
        faces: np.ndarray,
        flat: np.ndarray,
        position_L_m: np.ndarray,
        L_from_C: np.ndarray,
        fov_deg: float,
        size_px: int,
        samples_per_pixel: int,
        sun_direction_L: np.ndarray,
        sun_angular_radius_rad: float,
        threads: int,
        bounces: int = 0,
        poses: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    ) -> None:
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        for name, array in (("vertices", vertices_m), ("faces", faces), ("flat", flat)):
            np.save(folder / f"{name}.npy", array)
        numbers = {
            "position": position_L_m.tolist(),
            "L_from_C": L_from_C.tolist(),
            "fov_deg": fov_deg,
            "size_px": size_px,
            "samples": samples_per_pixel,
            "sun": sun_direction_L.tolist(),
            "sun_angle_rad": 2 * sun_angular_radius_rad,
            "threads": threads,
            "bounces": bounces,
            "poses": [(position.tolist(), axes.tolist()) for position, axes in poses],
        }
        (folder / "scene.json").write_text(json.dumps(numbers))
        with (folder / "stderr.txt").open("w") as stderr:
            self._process = subprocess.Popen(
                [python, __file__, str(folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
            )
        self._listen()

    def __enter__(self) -> Cycles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._folder.cleanup()

    def render(self) -> float:
        """Render once and return the duration in s; only the first call builds the BVH."""
        return float(self._ask("render"))

    def picture(self) -> np.ndarray:
        """Return the last render, linear grey, float32[y, x], top row first."""
        return np.load(self._ask("picture"))

    def _ask(self, command: str) -> str:
        """Send a command to Blender and return its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()
        return self._listen()

    def _listen(self) -> str:
        """Return Blender's next answer; raise RuntimeError if it has ended."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(_ANSWER):
                return line.removeprefix(_ANSWER).strip()
        said = Path(self._folder.name, "stderr.txt").read_text()[-2000:]
        raise RuntimeError(f"Blender ended with exit code {self._process.wait()}: {said}")


# --- inside Blender ----------------------------------------------------------------------------------------


def _set_up(folder: Path) -> Any:
    """Make the Blender scene from the files in `folder` and return it."""
    import bpy
    from mathutils import Matrix, Vector

    numbers = json.loads((folder / "scene.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene

    vertices, faces, flat = (np.load(folder / f"{n}.npy") for n in ("vertices", "faces", "flat"))
    mesh = bpy.data.meshes.new("terrain")
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", ~flat)
    mesh.update(calc_edges=True)
    grey = bpy.data.materials.new("grey")
    grey.use_nodes = True
    nodes = grey.node_tree.nodes
    nodes.clear()
    diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    diffuse.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
    diffuse.inputs["Roughness"].default_value = 0.0
    grey.node_tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    mesh.materials.append(grey)
    scene.collection.objects.link(bpy.data.objects.new("terrain", mesh))

    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle = "HORIZONTAL", np.radians(numbers["fov_deg"])
    lens.clip_start, lens.clip_end = 0.1, 1e5
    camera = bpy.data.objects.new("camera", lens)
    camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(camera)
    scene.camera = camera
    given = numbers["poses"] or [(numbers["position"], numbers["L_from_C"])]
    for position, axes in given:
        pose = np.eye(4)
        pose[:3, :3] = np.array(axes) * [1, -1, -1]  # Blender's camera has y up and looks along -z
        pose[:3, 3] = position
        camera.matrix_world = Matrix(pose.tolist())
        if numbers["poses"]:  # the shutter is open from half a frame before to half a frame after the frame 1
            for name in ("location", "rotation_quaternion"):
                camera.keyframe_insert(name, frame=0.5 if position is given[0][0] else 1.5)
    if numbers["poses"]:
        for layer in camera.animation_data.action.layers:
            for curve in layer.strips[0].channelbag(camera.animation_data.action_slot).fcurves:
                for key in curve.keyframe_points:
                    key.interpolation = "LINEAR"
        scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
        scene.render.motion_blur_position = "CENTER"
        scene.frame_set(1)

    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.angle, lamp.energy = numbers["sun_angle_rad"], 1.0
    sun = bpy.data.objects.new("sun", lamp)
    sun.rotation_mode = "QUATERNION"
    sun.rotation_quaternion = Vector(numbers["sun"]).to_track_quat("Z", "Y")  # a lamp shines along its -z
    scene.collection.objects.link(sun)

    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = numbers["size_px"]
    scene.render.resolution_percentage = 100
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", numbers["threads"]
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "32"
    scene.view_settings.view_transform = "Raw"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = numbers["samples"]
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces = cycles.diffuse_bounces = numbers["bounces"]
    cycles.glossy_bounces = cycles.transmission_bounces = 0
    cycles.volume_bounces = cycles.transparent_max_bounces = 0
    cycles.pixel_filter_type = "BOX"
    cycles.use_light_tree = False  # useless with one lamp
    cycles.caustics_reflective = cycles.caustics_refractive = False
    return scene


def _serve(folder: Path) -> None:
    """Answer the commands on standard input until it closes."""
    import time

    import bpy

    def answer(text: Any) -> None:
        print(f"\n{_ANSWER}{text}", flush=True)

    scene = _set_up(folder)
    picture = folder / "cycles.exr"
    answer("ready")
    for line in sys.stdin:
        if line.strip() == "render":
            start = time.perf_counter()
            bpy.ops.render.render(write_still=False)
            answer(time.perf_counter() - start)
        else:
            bpy.data.images["Render Result"].save_render(str(picture), scene=scene)
            image = bpy.data.images.load(str(picture))
            image.colorspace_settings.name = "Non-Color"
            size = scene.render.resolution_x
            pixels = np.empty(size * size * 4, dtype=np.float32)
            image.pixels.foreach_get(pixels)
            bpy.data.images.remove(image)
            out = folder / "cycles.npy"
            np.save(out, pixels.reshape(size, size, 4)[::-1, :, 0])  # Blender's first row is the lowest
            answer(out)


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
