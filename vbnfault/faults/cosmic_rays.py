"""Simulate cosmic rays: tracks of charged particles through the sensitive layer, as in a solar particle event.

In quiet time the flux at L2 is 4.67 protons per cm² s (CREME96), hardly a track in an exposure of milliseconds. In
an event, a sensor receives the particles that its housing lets through. In the event of 14 July 2000, some 400
protons above 100 MeV came per cm² s sr (5e3 per cm² s over all directions), and 24 000 above 10 MeV, which a few mm
of aluminium stop (recalled).

A minimum-ionising particle frees some 80 electrons per µm in silicon. Slower particles free more, by Bethe's
formula: a proton of 50 MeV some 480. The spread of a track's charge grows in proportion, because both go as 1/β²
apart from the logarithm.

Besides particles that cross the layer, a sensor sees electrons that these free in the housing, and which stop in
the layer: faint, short tracks. Of `ending_fraction` of the tracks only a part u⁸ of length and charge is left, u
uniform, at any depth. The power is fitted to the spots in the sky of 32 frames of Rosetta's navigation camera: as
many have 200 to 400 electrons as 400 to 800.

The charge is added after the shot noise, because it does not depend on the light. It is added before wells overflow
and traps capture charge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..detector.cosmic import LEAST_MEV_CM2_G, CosmicRayModel, CosmicRays, stopping_power_MeV_cm2_g
from ..detector.noise import poisson_above_0
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, number

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_LEAST_READOUT_S = 0.05  # assumed
_ASSUMED_DEPTH_UM = 3.0  # for a sensor whose file has none
_ENDING_POWER = 8.0  # of a uniform variate: the part of a track that ends in the layer, see above
_TRACKS_AT_ONCE = 256  # limits the memory of the diffusion


@dataclass(frozen=True, kw_only=True)
class Tracks(Fault):
    """Add straight tracks, Poisson in number but at least one, with directions by the cosine law
    (`detector.cosmic`).
    """

    fault = "cosmic_rays"
    model = "tracks"
    default = True
    after = "smear"
    step = "charge"
    severity = Severity(key="flux_per_cm2_s", low=1.0, high=1e6)
    needs_mosaic = True
    per_exposure = True

    flux_per_cm2_s: Interval = bounds(
        5.0,
        5e3,
        limits=(0.01, 1e7),
        unit="1/(cm² s)",
        doc="of protons from all directions that reach the sensor, drawn evenly in its logarithm; in quiet time "
        "4.67, 23 in frames of Rosetta's, thousands in a storm of the Sun",
    )
    energy_MeV: Interval = bounds(
        50.0, 1000.0, limits=(1, 1e5), unit="MeV", doc="kinetic energies: slower protons leave more charge"
    )
    spectral_index: float = number(
        2.0, limits=(0, 10), doc="their spectrum falls with the energy to this power; assumed"
    )
    ending_fraction: float = number(
        0.0, limits=(0, 1), doc="fraction of the tracks that end in the layer and leave only a part of their charge"
    )
    readout_s: float | None = number(
        None,
        limits=(0, 3600),
        unit="s",
        doc="for which charge waits and is hit too; default: the readout of all rows, at least 0.05 (assumed)",
    )
    thickness_um: float | None = number(
        None,
        limits=(0.1, 500),
        unit="µm",
        doc="of the layer whose charge is collected; default: the depleted depth",
    )
    diffusion_um: float = number(
        1.0, limits=(0, 20), unit="µm", doc="σ of charge from the far face when it is collected; assumed"
    )
    least_diffusion_um: float = number(
        0.0,
        limits=(0, 20),
        unit="µm",
        doc="σ of charge from all depths, besides: where no field draws it",
    )
    most_tracks: int = number(
        4000, limits=(1, 20_000), integer=True, doc="in one picture: what a larger draw has more is left out"
    )
    least_dn: float = number(
        1.0,
        limits=(0.001, 255),
        unit="DN of 255",
        doc="pixels that gain less, before a stretch, are left as they are",
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the layer, the mean and drawn number of tracks, and the tracks.

        Each track has the keys of `CosmicRays.params` and its energy in MeV.
        """
        sensor = context.camera.mosaic.sensor
        wait_s = max(sensor.transfer.row_readout_s * context.shape[0], _LEAST_READOUT_S)
        depth_um = sensor.individual.depletion_depth_um or _ASSUMED_DEPTH_UM
        params: Params = {
            "flux_per_cm2_s": float(self.flux_per_cm2_s.power_law(rng.random(1), 0.0)[0]),
            "time_s": float(context.camera.exposure_s + (wait_s if self.readout_s is None else self.readout_s)),
            "thickness_um": float(depth_um if self.thickness_um is None else self.thickness_um),
            "diffusion_um": float(self.diffusion_um),
            "least_diffusion_um": float(self.least_diffusion_um),
            "least_dn": float(self.least_dn),
        }
        model = _model(params, context)
        mean = model.expected_count(context.shape, params["time_s"])
        count = min(int(poisson_above_0(mean, rng.random())), int(self.most_tracks))
        params["mean_count"], params["count"] = float(mean), count
        energy = np.round(self.energy_MeV.power_law(rng.random(count), self.spectral_index - 1), 2)
        tracks = _tracks(model, context.shape, count, energy, self.ending_fraction, rng).params
        params["tracks"] = [track | {"energy_MeV": e} for track, e in zip(tracks, energy.tolist(), strict=True)]
        return params

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the collected electrons plus those of the tracks."""
        return quantity.with_array(quantity.array + context.once(_charge, params))

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels of the image that the tracks' charge can change by demosaicing, bool[y, x]."""
        return context.camera.mosaic.footprint(context.once(_charge, params) > 0)


def _model(params: Params, context: FaultContext) -> CosmicRayModel:
    """Return the model of the tracks with the drawn parameters."""
    return CosmicRayModel(
        pixel_pitch_um=context.camera.detector.pixel_pitch_um,
        thickness_um=params["thickness_um"],
        flux_per_cm2_s=params["flux_per_cm2_s"],
        diffusion_um=params["diffusion_um"],
        least_diffusion_um=params["least_diffusion_um"],
    )


def _tracks(
    model: CosmicRayModel,
    shape: tuple[int, int],
    count: int,
    energy_MeV: F64,
    ending_fraction: float,
    rng: np.random.Generator,
) -> CosmicRays:
    """Return the first `count` tracks of a draw that has at least that many, some of which end in the layer.

    This is correct because tracks are independent of each other.
    """
    time_s = (count + 10 * np.sqrt(count) + 10) / model.expected_count(shape, 1.0)
    while len(rays := model.draw(shape, time_s, rng)) < count:
        pass
    columns = {name: column[:count] for name, column in vars(rays).items()}
    columns["electrons"] = columns["electrons"] * (stopping_power_MeV_cm2_g(energy_MeV) / LEAST_MEV_CM2_G)
    if ending_fraction > 0:
        ends, part, place = rng.random((3, count))
        left = np.where(ends < ending_fraction, part**_ENDING_POWER, 1.0)
        columns["electrons"], columns["length_um"] = columns["electrons"] * left, columns["length_um"] * left
        reach_um = columns["length_um"] * np.cos(np.radians(columns["theta_deg"]))
        columns["depth_um"] = place * np.maximum(model.thickness_um - reach_um, 0)
    # rounded, because thousands of tracks must stay short as text; seeds are integers and stay exact
    return CosmicRays(**{name: np.round(column, 3) for name, column in columns.items()})


def _charge(params: Params, context: FaultContext) -> F32:
    """Return the electrons that the pixels gain, float32[y, x]; 0 where they amount to less than `least_dn`."""
    model, tracks = _model(params, context), params["tracks"]
    out = np.zeros(context.shape[0] * context.shape[1], dtype=np.float32)
    for start in range(0, len(tracks), _TRACKS_AT_ONCE):
        some = CosmicRays.from_params(tracks[start : start + _TRACKS_AT_ONCE])
        index, electrons = model.deposit(some, context.shape)
        out[index] += electrons
    out[out < context.camera.mosaic.step_e * params["least_dn"]] = 0
    return out.reshape(context.shape)
