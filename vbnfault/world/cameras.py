"""Build the camera that a scene describes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from ..camera import Camera, focal_length_mm
from ..core.errors import InputError, under_key
from ..core.files import file_contents
from ..detector import Detector, MosaicDetector, Sensor, ThreeColourDetector, amplified, binned, load_sensor
from ..lens import (
    Halo,
    RealLens,
    ThinLens,
    closed_to,
    coating,
    load_lens,
    paraxial_properties,
    scaled_to_focal_length,
)
from ..scene.config import Scene
from ..scene.instrument import THIN_LENS, CameraTable, PointSpreadTable
from ..scene.keyed_random import rng
from .ephemeris import wavelengths_nm

# A dark part of the frame that is smaller than this is not worth a warning.
_DARK_FRACTION = 1e-3


def base_camera(
    scene: Scene,
    *,
    architecture: int = 0,
    readout_direction: int = 0,
    individual: int = 0,
    generic: type[ThreeColourDetector] = ThreeColourDetector,
) -> Camera:
    """Return the scene's camera before an exposure is set. The integers are indices into its lists of options.

    `generic` is the kind of detector of a scene that names none.
    """
    c = scene.camera
    direction = c.readout_directions[readout_direction]
    if c.detector:
        sensor = mosaic_sensor(c)
        detector: Detector = _detector_of(scene, sensor, individual, direction)
        pitch_um, which = sensor.pixel_pitch_um, sensor.architecture
    else:
        which = c.architectures[architecture]
        detector = _generic(c, which, generic)
        pitch_um = detector.pixel_pitch_um
    return Camera(
        lens=real_lens(c, pitch_um) if c.lens else _thin_lens(c, pitch_um),
        detector=detector,
        architecture=which,
        readout_direction=direction,
        gain=c.gain,
    )


def _generic(c: CameraTable, architecture: str, kind: type[ThreeColourDetector]) -> ThreeColourDetector:
    """Return the detector of a camera table that names none; a CCD reads the sum of binned pixels once."""
    pixels, readouts = c.binning**2, 1 if architecture != "cmos" else c.binning
    return kind(
        width_px=c.width_px,
        height_px=c.height_px,
        pixel_pitch_um=c.pixel_pitch_um * c.binning,
        full_well_e=c.full_well_e * pixels,
        read_noise_e_rms=c.read_noise_e_rms * readouts,
        dark_current_e_s=c.dark_current_e_s * pixels,
        adc_bits=c.adc_bits,
        bias_dn=c.bias_dn,
        gain=c.gain,
        response=c.response,
        quantum_efficiency_peak=c.quantum_efficiency_peak,
    )


@file_contents.cached_with_contents(maxsize=4)
def mosaic_sensor(c: CameraTable) -> Sensor:
    """Return the sensor that a camera names, with the camera's own temperature, display, binning and gain.

    Raises InputError.
    """
    with under_key("camera.detector"):
        sensor = amplified(binned(load_sensor(c.detector), c.binning), c.gain)
    own: dict[str, Any] = {"temperature_K": c.detector_temperature_K, "stretch": c.stretch, "black": c.black}
    return replace(sensor, **{key: value for key, value in own.items() if value is not None})


def _detector_of(scene: Scene, sensor: Sensor, individual: int, direction: str) -> MosaicDetector:
    """Return the detector of one device. Raises InputError if a channel receives no light of the scene's bands."""
    # a mosaic detector is read along its columns only
    towards = direction if direction in ("up", "down") else "up"
    seed = int(rng(scene.dataset.seed, individual, "detector", "device").integers(2**31))
    if sensor.measured is not None and scene.camera.individuals > 1:
        raise InputError(
            f"camera.individuals = {scene.camera.individuals}: must be 1, since the sensor file's defects are of "
            "one device"
        )
    with under_key("camera.detector"):
        made = MosaicDetector(
            sensor=sensor,
            seed=seed,
            width_px=scene.camera.width_px,
            height_px=scene.camera.height_px,
            direction=towards,
        )
    for channel, row in zip(made.channels, made.electron_rate_weights(wavelengths_nm(scene)), strict=True):
        if not row.any():
            low, high = scene.render.band_min_nm, scene.render.band_max_nm
            raise InputError(
                f"render.band_min_nm = {low:g}, band_max_nm = {high:g}: the {channel} pixels of camera.detector = "
                f"{scene.camera.detector!r} see no such light"
            )
    return made


def _focus_distance_m(c: CameraTable) -> float:
    """Return the focus distance in m, infinite by default."""
    return float("inf") if c.focus_distance_m is None else c.focus_distance_m


def _thin_lens(c: CameraTable, pixel_pitch_um: float) -> ThinLens:
    """Return the thin lens of a camera table."""
    calibration = c.frame_calibration
    if calibration is None:
        focal_mm = focal_length_mm(c.fov_deg, c.width_px, pixel_pitch_um)
    else:
        focal_mm = calibration.focal_length_px * pixel_pitch_um * 1e-3
    return ThinLens(
        focal_length_mm=focal_mm,
        f_number=THIN_LENS["f_number"] if c.f_number is None else c.f_number,
        transmission=THIN_LENS["transmission"] if c.transmission is None else c.transmission,
        focus_distance_m=_focus_distance_m(c),
        halo=_halo(c.point_spread),
        pixel_rad=c.pixel_rad,
        calibration=calibration,
    )


def _halo(table: PointSpreadTable | None) -> Halo | None:
    """Return the point spread of a thin lens, None without a table."""
    if table is None:
        return None
    return Halo(
        core_rad=1e-6 * table.core_urad,
        core_y_rad=None if table.core_y_urad is None else 1e-6 * table.core_y_urad,
        halo_fraction=table.halo_fraction,
        halo_rad=1e-6 * table.halo_urad,
        halo_index=table.halo_index,
        wing_fraction=table.wing_fraction,
        wing_rad=1e-6 * table.wing_urad,
        wing_index=table.wing_index,
    )


@file_contents.cached_with_contents(maxsize=4)
def real_lens(c: CameraTable, pixel_pitch_um: float) -> RealLens:
    """Return the prescription that a camera names, scaled to its focal length and stopped down to its f-number.

    Raises InputError for a file that is not a lens, and for an f-number that the lens does not reach.
    """
    with under_key("camera.lens"):
        prescription = load_lens(c.lens)
    if c.lens_coating:
        if c.lens_coating not in coating.NAMES:
            known = ", ".join(coating.NAMES)
            raise InputError(f"camera.lens_coating = {c.lens_coating!r}: must be one of {known}")
        prescription = prescription.coated(c.lens_coating)
    efl_mm = focal_length_mm(c.fov_deg, c.width_px, pixel_pitch_um)
    if not math.isclose(efl_mm, paraxial_properties(prescription).efl_mm, rel_tol=1e-9):
        prescription = scaled_to_focal_length(prescription, efl_mm)
    if c.f_number is not None:
        prescription = closed_to(prescription, c.f_number, "camera.f_number")
    return RealLens(
        prescription=prescription,
        width_px=c.width_px,
        height_px=c.height_px,
        pixel_pitch_um=pixel_pitch_um,
        focus=c.focus,
        focus_distance_m=_focus_distance_m(c),
    )


def dark_corners(scene: Scene) -> str:
    """Return one sentence if the frame is wider than the field of the scene's lens, or ""."""
    lens = base_camera(scene).lens.real
    if lens is None or 1 - lens.coverage.lit_fraction < _DARK_FRACTION:
        return ""
    field = lens.coverage
    return (
        f"camera.fov_deg = {scene.camera.fov_deg:g}: {lens.name} passes light up to {field.field_deg:.1f} deg from "
        f"the axis, but the frame's corners lie at {field.corner_deg:.1f} deg, so {1 - field.lit_fraction:.1%} of "
        "the frame is dark; lower fov_deg or choose a wider camera.lens"
    )


def scaled_lens(scene: Scene) -> str:
    """Return one sentence if the scene's field of view scales its lens by more than 1 %, or ""."""
    lens = base_camera(scene).lens.real
    if lens is None or abs(lens.prescription.scale - 1) < 0.01:
        return ""
    return (
        f"camera.fov_deg = {scene.camera.fov_deg:.4g}: scales {lens.name} by {lens.prescription.scale:.3g} to "
        f"f = {lens.focal_length_mm:.4g} mm; its coatings, roughness and particles keep their size; without "
        "fov_deg and focal_length_mm the lens stays as it is"
    )
