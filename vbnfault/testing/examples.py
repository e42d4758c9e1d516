"""Make cameras, contexts and random quantities on which a fault can be tried; name the example that breaks it."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..camera import Camera, focal_length_mm
from ..core.quantities import (
    ARCHITECTURES,
    READOUT_DIRECTIONS,
    RGBI,
    Charge,
    Electrons,
    Offset,
    Quantity,
    RawMosaic,
)
from ..detector import MosaicDetector as _Mosaic
from ..detector import ThreeColourDetector, load_sensor
from ..faults import FaultContext
from ..lens import ThinLens

# Width and height in pixels: higher than wide, square, wider than high.
SHAPES = ((96, 64), (200, 200), (60, 130))
CCDS = tuple(name for name in ARCHITECTURES if name != "cmos")


def make_context(
    width_px: int = 1024,
    height_px: int | None = None,
    *,
    sun_xy_px: tuple[float, float] | None = None,
    sun_visible_fraction: float = 1.0,
    fov_deg: float = 40.0,
    architecture: str = "full_frame_ccd",
    readout_direction: str = "right",
    exposure_s: float = 1e-3,
) -> FaultContext:
    """Return a context with a thin lens and a detector without a mosaic.

    Parameters
    ----------
    width_px, height_px
        Size of the image; square by default.
    sun_xy_px
        Pixel position of the Sun, within the image or beside it; None: the Sun's position is unknown.
    sun_visible_fraction
        Fraction of the Sun's disc that is not covered, in [0, 1].
    fov_deg
        Field of view across the width.
    architecture, readout_direction, exposure_s
        Fields of `Camera`.
    """
    detector = ThreeColourDetector(width_px=width_px, height_px=height_px or width_px)
    focal = focal_length_mm(fov_deg, width_px, detector.pixel_pitch_um)
    return FaultContext(
        camera=Camera(
            lens=ThinLens(focal_length_mm=focal, f_number=4.0),
            detector=detector,
            architecture=architecture,
            readout_direction=readout_direction,
            exposure_s=exposure_s,
        ),
        sun_xy_px=None if sun_xy_px is None else np.array(sun_xy_px),
        sun_visible_fraction=None if sun_xy_px is None else sun_visible_fraction,
    )


def with_mosaic(context: FaultContext, **sensor: Any) -> FaultContext:
    """Return the context with a packaged sensor that has a mosaic: a CCD if the camera's architecture is one.

    `sensor` changes fields of `Sensor`.
    """
    camera = context.camera
    made = load_sensor("generic_ccd" if camera.is_ccd else "generic_cmos")
    if camera.architecture == "frame_transfer_ccd":
        made = replace(made, transfer=replace(made.transfer, row_transfer_s=1e-6))
    changes: dict[str, Any] = {"architecture": camera.architecture, **sensor}
    made = replace(made, **changes)
    height, width = context.shape
    direction = camera.readout_direction if camera.readout_direction in ("up", "down") else "up"
    detector = _Mosaic(sensor=made, seed=3, width_px=width, height_px=height, direction=direction)
    return replace(context, camera=replace(camera, detector=detector))


def draw_context(rng: np.random.Generator, *, architectures: Sequence[str] = ARCHITECTURES) -> FaultContext:
    """Return a random small context; the Sun is unknown, in the image, or beside it."""
    width, height = SHAPES[rng.integers(len(SHAPES))]
    suns = (None, (width / 2, height / 2), (0.3 * width, 0.2 * height), (-0.4 * width, 1.7 * height))
    return make_context(
        width,
        height,
        sun_xy_px=suns[int(rng.integers(len(suns)))],
        sun_visible_fraction=(0.0, 0.5, 1.0)[rng.integers(3)],
        architecture=architectures[int(rng.integers(len(architectures)))],
        readout_direction=READOUT_DIRECTIONS[rng.integers(len(READOUT_DIRECTIONS))],
    )


def random_quantity(step: str, context: FaultContext, seed: int = 0) -> Quantity:
    """Return the quantity of a fault's step with random values over all that it may be."""
    rng = np.random.default_rng(seed)
    if step == "electrons":
        white_e = context.camera.detector.white_e
        relative = rng.uniform(0, 2, (*context.shape, len(white_e))).astype(np.float32)
        return Electrons(array=relative * white_e, white_e=white_e)
    if step == "rgbi":
        image = rng.integers(0, 256, (*context.shape, 4), dtype=np.uint8)
        image[::7, ::5] = 0
        image[::5, ::7] = 255
        return RGBI(array=image)
    readout = context.camera.mosaic.sensor.readout
    if step == "raw":
        return RawMosaic(array=rng.integers(0, readout.top_dn + 1, context.shape, dtype=np.uint16))
    if step == "offsets":
        return Offset(array=rng.normal(0, 100, context.shape).astype(np.float32))
    return Charge(array=rng.uniform(0, 2 * readout.full_well_e, context.shape).astype(np.float32))


@contextlib.contextmanager
def naming(title: str, example: str) -> Iterator[None]:
    """Turn every error of a block into an AssertionError that names the class and the example that breaks it."""
    try:
        yield
    except Exception as error:
        text = str(error) if isinstance(error, AssertionError) else f"raised {type(error).__name__}: {error}"
        raise AssertionError(f"{title}: {text} ({example})") from error


def pickled(value: Any) -> Any:
    """Return a value as another process gets it. Raises AssertionError if it cannot be pickled."""
    try:
        return pickle.loads(pickle.dumps(value))
    except (pickle.PicklingError, AttributeError) as error:
        raise AssertionError(f"cannot be pickled: {error}; define its class at the top of a module") from None
