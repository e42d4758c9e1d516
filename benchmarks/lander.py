"""Make the lander that ships with vbnfault: an OBJ file in the camera's axes B, in metres.

    python benchmarks/lander.py

writes `scenes/spacecraft/lander.obj`, whose objects are the parts and whose materials those of `world.spacecraft`.
"""

from __future__ import annotations

import numpy as np
import trimesh

from vbnfault.core.files.resources import data_dir

Part = tuple[str, trimesh.Trimesh, str]  # name, mesh, material

# Size and position of the bus in metres. Its front panel lies 6 cm behind the pupil, which looks out of a short
# barrel.
_BUS_SIZE_M = (1.2, 1.0, 1.2)
_BUS_CENTRE_M = (0.0, 0.0, -0.66)
_BARREL_RADIUS_M = 0.05
_ARRAY_HINGE_Z_M = -0.7

_CORNERS = {
    "front_left": (-1.0, 1.0),
    "front_right": (1.0, 1.0),
    "back_left": (-1.0, -1.0),
    "back_right": (1.0, -1.0),
}


def _bus() -> list[Part]:
    """Return the bus with radiator, camera barrel and engine."""
    # the bell opens downwards and has a wall of 1 cm
    bell = [(0.0, 0.0), (0.06, 0.0), (0.21, 0.3), (0.2, 0.3), (0.05, 0.01), (0.0, 0.01)]
    return [
        ("bus/body", _box(_BUS_CENTRE_M, _BUS_SIZE_M), "gold_mli"),
        ("bus/radiator", _box((0.0, -0.25, -0.055), (0.9, 0.35, 0.02)), "white_paint"),
        ("bus/camera_barrel", _rod((0, 0, -0.08), (0, 0, -0.01), _BARREL_RADIUS_M, 32), "black_paint"),
        ("bus/engine", _revolved(bell, (0.0, 0.48, -0.66), (0, 1, 0)), "black_paint"),
    ]


def _solar_array(side: str, sign: float) -> list[Part]:
    """Return the solar array of a side; `sign` is that of its x coordinates. Its cells face up (-y)."""
    name, z = f"solar_array_{side}", _ARRAY_HINGE_Z_M
    yoke = _rod((sign * 0.58, 0, z), (sign * 0.96, 0, z), 0.025)
    panel = _box((sign * 1.95, 0, z), (2.0, 0.02, 0.9))
    cells = _box((sign * 1.95, -0.011, z), (1.96, 0.006, 0.86))  # a thin sheet on the panel
    return [
        (f"{name}/yoke", yoke, "aluminium"),
        (f"{name}/panel", panel, "black_paint"),
        (f"{name}/cells", cells, "solar_cell"),
    ]


def _leg(corner: str, x: float, z: float) -> list[Part]:
    """Return the leg at a corner of the bus; `x` and `z` are the signs of the corner's coordinates."""
    # the front pads stand forward, so that they show in the lower corners of a wide field
    pad = (0.8 * x, 0.95, 1.5) if z > 0 else (0.95 * x, 0.95, -1.75)
    hip = (0.58 * x, 0.46, -0.12 if z > 0 else -1.2)
    middle = tuple(0.45 * h + 0.55 * p for h, p in zip(hip, pad, strict=True))
    strut = _rod(hip, (pad[0], pad[1] - 0.02, pad[2]), 0.025)
    brace = _rod((0.3 * x, 0.48, hip[2]), middle, 0.015)
    footpad = _rod((pad[0], pad[1] - 0.04, pad[2]), pad, 0.14, 32)
    return [
        (f"leg_{corner}/strut", strut, "aluminium"),
        (f"leg_{corner}/brace", brace, "aluminium"),
        (f"leg_{corner}/footpad", footpad, "black_mli"),
    ]


def _antenna() -> list[Part]:
    """Return the antenna: a fixed mast, and the dish with its feed."""
    mast = _rod((0.0, -0.48, -0.95), (0.0, -0.75, -0.95), 0.03)
    radius = np.linspace(0.0, 0.45, 10)
    bowl = [(float(r), float(r**2)) for r in radius]  # focal length 0.25 m
    wall = [*bowl, *((r, h + 0.01) for r, h in reversed(bowl))]
    up_and_back = (0.0, -1.0, -0.35)
    axis = np.array(up_and_back) / np.linalg.norm(up_and_back)
    feed = np.array((0.0, -0.74, -0.95)) + np.outer((0.005, 0.26), axis)
    return [
        ("antenna_mast", mast, "aluminium"),
        ("antenna/dish", _revolved(wall, (0.0, -0.74, -0.95), up_and_back), "white_paint"),
        ("antenna/feed", _rod(tuple(feed[0]), tuple(feed[1]), 0.02), "black_paint"),
    ]


def _box(centre: tuple[float, ...], size: tuple[float, ...]) -> trimesh.Trimesh:
    """Return a box along the axes."""
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))


def _rod(start: tuple[float, ...], end: tuple[float, ...], radius: float, sections: int = 20) -> trimesh.Trimesh:
    """Return a cylinder between two points."""
    return trimesh.creation.cylinder(radius, segment=np.array([start, end]), sections=sections)


def _revolved(
    profile: list[tuple[float, float]], apex: tuple[float, ...], towards: tuple[float, ...]
) -> trimesh.Trimesh:
    """Return the surface of a profile (radius, height) turned about the axis from `apex` along `towards`."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=32)
    mesh.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), np.array(towards) / np.linalg.norm(towards)))
    return mesh.apply_translation(apex)


def lander() -> str:
    """Return the text of the OBJ file."""
    arrays = [part for side, sign in (("left", -1.0), ("right", 1.0)) for part in _solar_array(side, sign)]
    legs = [part for name, (x, z) in _CORNERS.items() for part in _leg(name, x, z)]
    rows = ["# The spacecraft that ships with vbnfault, in the camera's axes B, in metres: benchmarks/lander.py"]
    first = 1
    for name, mesh, material in [*_bus(), *arrays, *legs, *_antenna()]:
        rows += [f"o {name}", f"usemtl {material}"]
        rows += [" ".join(["v", *(repr(float(x)) for x in point)]) for point in mesh.vertices]
        rows += [" ".join(["f", *(str(corner + first) for corner in face)]) for face in mesh.faces]
        first += len(mesh.vertices)
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    (data_dir("scenes") / "spacecraft" / "lander.obj").write_text(lander())
