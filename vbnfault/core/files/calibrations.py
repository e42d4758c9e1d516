"""Read a camera's calibration from files of ROS, Kalibr, OpenCV and COLMAP, as these programs write them.

OpenCV, ROS and Kalibr count pixels from the centre of the first one, COLMAP from its corner, as vbnfault does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..calibration import COEFFICIENTS, Calibration, SizeMissing
from ..errors import InputError, in_file, shown
from .user_files import read_input

KINDS = "a camera_info YAML of ROS, a camchain YAML of Kalibr, a FileStorage of OpenCV, or a cameras.txt of COLMAP"

# Model of ROS → the model here, and the numbers of coefficients that it may have.
_ROS = {
    "plumb_bob": ("opencv", (4, 5)),
    "rational_polynomial": ("opencv", (8, 12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
_KALIBR = {"radtan": "opencv", "equidistant": "fisheye"}
_SINGLE, _DOUBLE = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
_COLMAP: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("opencv", _SINGLE),
    "PINHOLE": ("opencv", _DOUBLE),
    "SIMPLE_RADIAL": ("opencv", (*_SINGLE, "k1")),
    "RADIAL": ("opencv", (*_SINGLE, "k1", "k2")),
    "OPENCV": ("opencv", (*_DOUBLE, *COEFFICIENTS["opencv"][:4])),
    "FULL_OPENCV": ("opencv", (*_DOUBLE, *COEFFICIENTS["opencv"][:8])),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", (*_SINGLE, "k1")),
    "RADIAL_FISHEYE": ("fisheye", (*_SINGLE, "k1", "k2")),
    "OPENCV_FISHEYE": ("fisheye", (*_DOUBLE, *COEFFICIENTS["fisheye"])),
}
# Names that programs give to what an OpenCV file holds, without case and underscores.
_MATRIX = ("cameramatrix", "k", "m", "intrinsics", "intrinsicmatrix", "cammatrix", "mtx")
_DISTORTION = (
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoefficients",
    "distcoeffs",
    "distcoeff",
    "distcoefs",
    "d",
    "distortion",
    "dist",
)
_OPENCV_LENGTHS = (0, 4, 5, 8, 12, 14)


def read_calibration(
    path: str | Path, *, camera: str = "", model: str = "", size_px: tuple[int, int] | None = None
) -> Calibration:
    """Return the calibration of a file, as `Calibration.read` describes it. Raises InputError."""
    data = read_input(path, "calibration")
    with in_file(str(path)):
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            raise InputError(f"is no text; must be {KINDS}") from None
        start = text.lstrip()
        if start.startswith(("%YAML", "<?xml", "<opencv_storage", "{")):
            return _opencv(text, camera, model, size_px)
        if model or size_px:
            raise InputError(
                "model, width_px, height_px: only an OpenCV file may leave them out; leave them out here"
            )
        if _is_colmap(text):
            return _colmap(text, camera)
        return _yaml(text, camera)


# --- COLMAP --------------------------------------------------------------------------------------------------


def _rows(text: str) -> list[list[str]]:
    """Return the words of each line that is no comment."""
    lines = (line.strip() for line in text.splitlines())
    return [line.split() for line in lines if line and not line.startswith("#")]


def _is_colmap(text: str) -> bool:
    """Return whether a text begins with a number and the name of a model in capitals."""
    row = next(iter(_rows(text)), [])
    return len(row) > 3 and row[0].isdigit() and row[1].replace("_", "").isalpha() and row[1].isupper()


def _colmap(text: str, camera: str) -> Calibration:
    """Return a camera of a list of cameras of COLMAP."""
    row = _chosen({row[0]: row for row in _rows(text)}, camera)
    if len(row) < 4:
        raise InputError(f"camera {row[0]}: must have CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters")
    if row[1] not in _COLMAP:
        raise InputError(f"camera {row[0]}: model {shown(row[1])}: must be one of {', '.join(_COLMAP)}")
    model, names = _COLMAP[row[1]]
    values = _numbers(row[4:], f"camera {row[0]}: the parameters of {row[1]}", (len(names),))
    given = dict(zip(names, values, strict=True))
    f = given.pop("f", None)
    fx, fy = (given.pop(name) if f is None else f for name in ("fx", "fy"))
    return Calibration(
        model=model,
        **_size(row[2:4], "WIDTH, HEIGHT"),
        fx=fx,
        fy=fy,
        cx=given.pop("cx"),
        cy=given.pop("cy"),
        coefficients=tuple(given.values()),
    )


# --- YAML of ROS and Kalibr ----------------------------------------------------------------------------------


def _yaml(text: str, camera: str) -> Calibration:
    """Return the calibration of the first document of a YAML file, whose keys tell which program wrote it."""
    import yaml

    try:
        # A message that ROS prints ends with "---", behind which another one may begin.
        table = next(yaml.load_all(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)), None)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        where = getattr(error, "problem_mark", None)
        line = "" if where is None else f" in line {where.line + 1}"
        raise InputError(f"cannot be read as YAML{line}; must be {KINDS}") from None
    if not isinstance(table, Mapping):
        raise InputError(f"is no calibration of a camera; must be {KINDS}")
    cameras = {str(k): v for k, v in table.items() if isinstance(v, Mapping) and "camera_model" in v}
    if "camera_model" in table:
        cameras = {"cam0": table}
    if cameras:
        return _kalibr(_chosen(cameras, camera))
    if {"camera_matrix", "k", "K"} & set(table):
        return _ros(_chosen({str(table.get("camera_name", "camera")): table}, camera))
    raise InputError(f"is no calibration of a camera; must be {KINDS}")


def _kalibr(table: Mapping[str, Any]) -> Calibration:
    """Return a camera of a chain of Kalibr."""
    if table["camera_model"] != "pinhole":
        raise InputError(f"camera_model = {shown(table['camera_model'])}: must be pinhole")
    kind = table.get("distortion_model", "none")
    if kind not in (*_KALIBR, "none"):
        raise InputError(f"distortion_model = {shown(kind)}: must be radtan, equidistant or none")
    fx, fy, cx, cy = _numbers(_at(table, "intrinsics"), "intrinsics", (4,))
    coefficients = () if kind == "none" else _numbers(_at(table, "distortion_coeffs"), "distortion_coeffs", (4,))
    return Calibration.of_centres(
        model=_KALIBR.get(kind, "opencv"),
        **_size(_at(table, "resolution"), "resolution"),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        coefficients=coefficients,
    )


def _ros(table: Mapping[str, Any]) -> Calibration:
    """Return the calibration of a file of `camera_calibration_parsers`, or of a printed message."""

    def named(*names: str) -> tuple[str, Any]:
        name = next((n for n in names if n in table), names[0])
        value = _at(table, name)
        return name, value["data"] if isinstance(value, Mapping) and "data" in value else value

    for name in ("binning_x", "binning_y"):
        if table.get(name, 0) not in (0, 1):
            raise InputError(f"{name} = {shown(table[name])}: must be 0 or 1, the size that was calibrated")
    key, kind = named("distortion_model")
    if kind not in tuple(_ROS):  # a tuple, since YAML may give a list, which has no hash
        raise InputError(f"{key} = {shown(kind)}: must be one of {', '.join(_ROS)}")
    model, counts = _ROS[kind]
    width, height = (named(f"image_{side}", side)[1] for side in ("width", "height"))
    whole = {"x_offset": (0,), "y_offset": (0,), "width": (0, width), "height": (0, height)}
    region = table.get("roi")
    if isinstance(region, Mapping) and any(region.get(k, 0) not in sizes for k, sizes in whole.items()):
        raise InputError("roi: must be empty, the whole image that was calibrated")
    key, matrix = named("camera_matrix", "k", "K")
    values = _of_matrix(np.array(_numbers(matrix, key, (9,))).reshape(3, 3), key)
    key, coefficients = named("distortion_coefficients", "d", "D")
    return Calibration.of_centres(
        model=model,
        **_size([width, height], "image_width, image_height"),
        **values,
        coefficients=_numbers(coefficients, key, (0, *counts)),
    )


# --- OpenCV --------------------------------------------------------------------------------------------------


def _opencv(text: str, camera: str, model: str, size_px: tuple[int, int] | None) -> Calibration:
    """Return the calibration of a FileStorage; `camera` is the ending of its keys, as in M1 and D1."""
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        nodes = {name.lower().replace("_", ""): (name, root.getNode(name)) for name in root.keys()}  # noqa: SIM118
    except (cv2.error, SystemError, UnicodeDecodeError):
        raise InputError(f"cannot be read as a FileStorage of OpenCV; must be {KINDS}") from None

    def named(names: Sequence[str], key: str) -> tuple[str, NDArray[np.float64]]:
        for name in names:
            if name + camera.lower() in nodes:
                return nodes[name + camera.lower()][0], _mat(*nodes[name + camera.lower()])
        more = f" of camera {camera!r}" if camera else ""
        raise InputError(f"has no {key}{more}; it has: {', '.join(n for n, _ in nodes.values()) or 'nothing'}")

    key, matrix = named(_MATRIX, "camera_matrix")
    values = _of_matrix(matrix, key)
    # a rectified camera has a matrix alone, but coefficients under a name of one's own must not be lost
    alone = all(node.size() < 3 for name, node in nodes.values() if name != key)
    coefficients = () if alone else tuple(named(_DISTORTION, "distortion_coefficients")[1].ravel().tolist())
    size: Any = _opencv_size(nodes) if size_px is None else size_px
    flag = nodes.get("fisheyemodel")
    stated = "" if flag is None else ("fisheye" if flag[1].real() else "opencv")
    if stated and model not in ("", stated):
        raise InputError(f"fisheye_model = {int(stated == 'fisheye')}: contradicts model = {model!r}")
    model = model or stated or "opencv"
    counts = (0, 4) if model == "fisheye" else _OPENCV_LENGTHS
    if len(coefficients) not in counts:
        raise InputError(f"distortion_coefficients: has {len(coefficients)} numbers; must be {_or(counts)}")
    return Calibration.of_centres(
        model=model, **_size(size, "image_width, image_height"), **values, coefficients=coefficients
    )


def _opencv_size(nodes: Mapping[str, tuple[str, Any]]) -> tuple[float, float]:
    """Return the size of the image that a FileStorage states. Raises InputError if there is none."""
    for names in (("imagewidth", "imageheight"), ("width", "height")):
        if all(name in nodes for name in names):
            width, height = (nodes[name][1].real() for name in names)
            return width, height
    for name in ("imagesize", "size", "resolution"):
        if name in nodes and nodes[name][1].isSeq() and nodes[name][1].size() == 2:
            return nodes[name][1].at(0).real(), nodes[name][1].at(1).real()
    raise SizeMissing("has no image_width and image_height; give width_px and height_px beside the file")


def _mat(name: str, node: Any) -> NDArray[np.float64]:
    """Return a matrix of an OpenCV file, or a sequence of numbers in its place."""
    try:
        matrix = node.mat() if not node.isSeq() else np.array([node.at(i).real() for i in range(node.size())])
    except (cv2.error, SystemError):
        matrix = None
    if matrix is None or not matrix.size or not np.issubdtype(matrix.dtype, np.number):
        raise InputError(f"{name}: must be a matrix of numbers")
    return np.asarray(matrix, dtype=np.float64)


# --- parts ---------------------------------------------------------------------------------------------------


def _of_matrix(matrix: NDArray[np.float64], key: str) -> dict[str, float]:
    """Return fx, fy, cx, cy and skew of a camera matrix."""
    if matrix.shape != (3, 3):
        raise InputError(f"{key}: must have 3 x 3 numbers, not {' x '.join(map(str, matrix.shape))}")
    if matrix[1, 0] != 0 or (matrix[2] != (0, 0, 1)).any():
        raise InputError(f"{key}: must be [fx, skew, cx; 0, fy, cy; 0, 0, 1]")
    (fx, skew, cx), (_, fy, cy) = matrix[:2].tolist()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": skew}


def _chosen(cameras: Mapping[str, Any], camera: str) -> Any:
    """Return one of several cameras. Raises InputError if it must be named, or is missing."""
    if camera in cameras:
        return cameras[camera]
    names = list(cameras)
    if camera or len(names) > 1:
        shown_names = ", ".join(names[:20]) + (", …" if len(names) > 20 else "")
        wrong = f"camera = {camera!r}: is not in the file" if camera else f"holds {len(names)} cameras"
        raise InputError(f"{wrong}; name one of {shown_names} as camera")
    return cameras[names[0]]


def _at(table: Mapping[str, Any], key: str) -> Any:
    """Return the value of a key. Raises InputError where it is missing."""
    if key not in table:
        raise InputError(f"{key}: is missing")
    return table[key]


def _numbers(values: Any, key: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return numbers. Raises InputError if there are not as many as `counts` allows, or if one is no number."""
    if not isinstance(values, list | tuple) or len(values) not in counts:
        count = f"has {len(values)}" if isinstance(values, list | tuple) else f"is {shown(values)}"
        raise InputError(f"{key}: {count}; must be {_or(counts)} numbers")
    out = []
    for value in values:
        try:
            out.append(float(value if isinstance(value, int | float | str) else "no number"))
        except (ValueError, OverflowError):
            raise InputError(f"{key}: {shown(value)}: must be a number") from None
    return tuple(out)


def _size(values: Any, key: str) -> dict[str, int]:
    """Return the size of the image as keywords. Raises InputError if it is not two whole numbers above 0."""
    numbers = _numbers(list(values) if isinstance(values, tuple) else values, key, (2,))
    for number in numbers:
        if not (np.isfinite(number) and number == round(number) and 1 <= number <= 1_000_000):
            raise InputError(f"{key} = {number:g}: must be a whole number of pixels from 1")
    return {"width_px": int(numbers[0]), "height_px": int(numbers[1])}


def _or(counts: Sequence[int]) -> str:
    """Return numbers as text with "or" before the last one."""
    return " or ".join(str(n) for n in counts)
