"""Time the detector's chain with every effect on; `test_speed` uses the same chain.

    python benchmarks/detector_chain.py

Prints milliseconds for each kind of sensor and demosaic method, at 1024×1024 pixels, as medians of five images.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from vbnfault.camera import Camera
from vbnfault.core.quantities import Electrons
from vbnfault.detector import MosaicDetector, load_sensor
from vbnfault.detector.charge import TrapSpecies
from vbnfault.detector.sensor import Sensor
from vbnfault.faults import MOSAIC_STEPS, Fault, FaultContext, from_dict
from vbnfault.lens import ThinLens

KINDS = ("full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos")
DEMOSAICS = ("malvar", "menon")
EXPOSURE_S = 0.02
# Every fault class inside the mosaic; effects of the charge transfer come from the sensor below.
FAULTS = (
    "broken_pixels/hot_pixels",
    "cosmic_rays",
    "blooming",
    "banding",
    "adc",
    "broken_lines/readout",
    "transmission",
)


def busy_sensor(architecture: str, demosaic: str) -> Sensor:
    """Return a packaged sensor with every effect of its architecture switched on."""
    sensor = load_sensor("generic_cmos" if architecture == "cmos" else "generic_ccd")
    individual = replace(
        sensor.individual,
        **dict.fromkeys(("prnu_row", "prnu_column", "prnu_low"), 0.002),
        **dict.fromkeys(("dsnu_row_e", "dsnu_column_e"), 2.0),
        dark_nonuniformity=0.2,
        years=5.0,
        dose_TeV_g=0.05,
        hot_clustered_fraction=0.1,
        dead_fraction=1e-5,
        stuck_fraction=1e-5,
        rts_fraction=1e-3,
        trap_fraction=1e-4,
    )
    readout = replace(
        sensor.readout,
        nodes=4,
        node_gains=(1.0, 1.01, 0.99, 1.02),
        node_offsets_dn=(0.0, 3.0, -2.0, 1.0),
        row_noise_e_rms=1.0,
        row_pattern_e_rms=2.0,
        column_pattern_e_rms=2.0,
        banding_amplitude_e=3.0,
        banding_frequency_hz=1e4,
        inl_quadratic_dn=4.0,
        inl_cubic_dn=1.0,
        dnl_lsb_rms=0.05,
        missing_codes=(1000, 2000),
    )
    transfer = sensor.transfer
    if architecture != "cmos":
        parallel, serial = (
            tuple(TrapSpecies(density_per_px=0.5, release_time_s=t * period) for t in (0.5, 2.0, 8.0))
            for period in (transfer.row_readout_s, transfer.pixel_transfer_s)
        )
        transfer = replace(
            transfer,
            row_transfer_s=1e-6,
            row_clear_s=1e-6,
            leak=1e-3,
            shutter_transmission=1e-3,
            antiblooming=0.5,
            parallel_traps=parallel,
            serial_traps=serial,
        )
    return replace(
        sensor,
        architecture=architecture,
        individual=individual,
        readout=readout,
        transfer=transfer,
        demosaic=demosaic,
        correct_defects=True,
    )


@dataclass(frozen=True, eq=False)
class Chain:
    """One scene and one sensor: `expose` takes images with noise, every effect and the demosaic."""

    context: FaultContext
    light: Electrons
    faults: Mapping[str, tuple[Fault, dict[str, Any]]]

    @classmethod
    def of(cls, architecture: str, demosaic: str, light: np.ndarray) -> Chain:
        """Return the chain for `light`, float32[y, x, colour], in fractions of white."""
        sensor = busy_sensor(architecture, demosaic)
        height, width = light.shape[:2]
        detector = MosaicDetector(sensor=sensor, seed=1, width_px=width, height_px=height)
        lens = ThinLens(focal_length_mm=10.0, f_number=4.0)
        camera = Camera(
            lens=lens,
            detector=detector,
            architecture=architecture,
            readout_direction="up",
            exposure_s=EXPOSURE_S,
        )
        context, rng = FaultContext(camera=camera), np.random.default_rng(0)
        faults = {}
        for entry in FAULTS:
            name, _, model = entry.partition("/")
            fault = from_dict(name, {"model": model} if model else {}, source="benchmark")
            faults[name] = fault, fault.draw(context, rng)
        white = detector.white_e
        return cls(context, Electrons(array=(light * white).astype(np.float32), white_e=white), faults)

    def expose(self, number: int = 0) -> np.ndarray:
        """Take one image, uint8[y, x, channel]; draw its noise, tracks and defects anew."""
        context = replace(self.context)  # a copy, so that nothing is cached from the image before
        acts = {
            step: [fault.act_at(step, p, context) for fault, p in self.faults.values() if step in fault.steps]
            for step in MOSAIC_STEPS
        }
        detector = self.context.camera.detector
        noise = detector.draw_noise(context.shape, lambda name: np.random.default_rng([number, *name.encode()]))
        return detector.develop(self.light, EXPOSURE_S, noise, acts).array


def speckled(size_px: int) -> np.ndarray:
    """Return a scene of high contrast, partly beyond the full well, float32[y, x, 3] in fractions of white."""
    grains = np.random.default_rng(0).gamma(0.5, 1.0, (size_px, size_px, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(grains, (0, 0), 3)
    smooth *= 0.4 / smooth.mean()
    at = size_px // 3
    smooth[at : at + size_px // 50, at : at + size_px // 25] *= 6
    return smooth


def main() -> None:
    """Print the durations."""
    light = speckled(1024)
    for architecture in KINDS:
        for demosaic in DEMOSAICS:
            chain, seconds = Chain.of(architecture, demosaic, light), []
            for number in range(6):
                start = time.perf_counter()
                chain.expose(number)
                seconds.append(time.perf_counter() - start)
            print(f"{architecture:<20}{demosaic:<8}{1e3 * float(np.median(seconds[1:])):7.0f} ms", flush=True)


if __name__ == "__main__":
    main()
