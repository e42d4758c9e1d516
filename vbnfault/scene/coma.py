"""Define the table `[coma]` of a scene file: the dust around an active body."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..core.tables import Table, pair_within

# The most jets, given ones and random ones each. A jet costs some milliseconds a sample.
_MOST_JETS = 64
_MOST_ROWS = 1000
# Full width at half maximum. Narrower jets would be missed between the directions that are computed.
_WIDTH_DEG = (3.0, 120.0)
_STRENGTH = (0.0, 1000.0)

PhaseAngle = Annotated[float, Field(ge=0, le=180)]


class PhaseFunctionTable(Table):
    """Give a phase function of dust: values at phase angles, scaled to 1 at 0°. Their logarithm is interpolated."""

    phase_deg: tuple[PhaseAngle, ...] = Field(
        min_length=2, max_length=_MOST_ROWS, description="increasing phase angles, from 0 to 180"
    )
    value: tuple[Annotated[float, Field(gt=0, le=1e9)], ...] = Field(
        min_length=2, max_length=_MOST_ROWS, description="scattered light at each phase angle, in any unit"
    )

    @model_validator(mode="after")
    def _paired(self) -> PhaseFunctionTable:
        if len(self.phase_deg) != len(self.value):
            raise ValueError(
                f"phase_deg has {len(self.phase_deg)} and value {len(self.value)} values: must be as many"
            )
        if self.phase_deg[0] != 0 or self.phase_deg[-1] != 180:
            raise ValueError(
                f"phase_deg = {self.phase_deg[0]:g} to {self.phase_deg[-1]:g}: must be from 0 to 180, where the "
                "Sun stands behind the camera and before it"
            )
        if any(a >= b for a, b in itertools.pairwise(self.phase_deg)):
            raise ValueError(f"phase_deg = {list(self.phase_deg)}: must increase")
        return self


class JetTable(Table):
    """Describe a jet: dust that leaves the body around one direction from its centre of mass."""

    latitude_deg: float = Field(ge=-90, le=90, description="planetocentric latitude of the axis")
    longitude_deg: float = Field(ge=-360, le=360, description="east longitude of the axis")
    width_deg: float = Field(
        15.0, ge=_WIDTH_DEG[0], le=_WIDTH_DEG[1], description="full width at half of the density on the axis"
    )
    strength: float = Field(
        0.1,
        ge=_STRENGTH[0],
        le=_STRENGTH[1],
        description="dust of the jet over that of the coma without jets, while the Sun stands over its axis. It "
        "falls with the cosine of the Sun's zenith angle there, and is 0 at night",
    )


class ComaTable(Table):
    """Put optically thin dust around the body, which flows out freely: its density falls with the distance squared.

    Without this table there is no dust. Its light is part of the scene: of the radiance, the exposure and the image
    without faults.
    """

    afrho_cm: float = Field(
        gt=0,
        le=1e7,
        description="A(0°)fρ of the coma without jets, at 550 nm and at reference_au (A'Hearn et al. 1984)",
    )
    reference_au: float = Field(1.0, ge=0.01, le=1000, description="distance from the Sun that afrho_cm holds at")
    distance_exponent: float = Field(
        4.15,
        ge=0,
        le=20,
        description="afrho_cm falls with this power of the Sun's distance; 4.1 to 4.2: 67P after its perihelion of "
        "2015 (Boehnhardt et al. 2016)",
    )
    phase_function: Literal["halley_marcus", "marcus"] | PhaseFunctionTable = Field(
        "halley_marcus",
        description="of the dust: Schleicher's composite of 2010, or Marcus 2007, or a table of values",
    )
    reddening_per_100nm: float = Field(
        0.09,
        ge=-0.3,
        le=1,
        description="slope of the dust's reflectance over that at 550 nm; 0.09: 67P (Boehnhardt et al. 2016)",
    )
    grain_albedo: float = Field(
        0.04,
        ge=0.005,
        le=1,
        description="geometric albedo of the grains: the optical depth goes with Afρ over it; 0.04: assumed, as of "
        "dark ground without its opposition surge",
    )
    affects_ground: bool = Field(
        True,
        description="whether the dust dims the light of the ground and of the Sun on it, and lights the ground",
    )
    sunlit_fraction: float = Field(
        0.7,
        ge=0,
        le=1,
        description="fraction of the dust that leaves towards the Sun, as the square of 1 + cos of the Sun's "
        "zenith angle; the rest leaves evenly in all directions; form and default are assumed",
    )
    jets: tuple[JetTable, ...] = Field((), max_length=_MOST_JETS, description="jets at given places")
    random_jets: int = Field(
        0, ge=0, le=_MOST_JETS, description="number of further jets, the same for all samples of a dataset.seed"
    )
    random_jet_width_deg: pair_within(*_WIDTH_DEG) = Field(  # type: ignore[valid-type]
        (8.0, 25.0), description="bounds of their widths"
    )
    random_jet_strength: pair_within(*_STRENGTH) = Field(  # type: ignore[valid-type]
        (0.02, 0.15), description="bounds of their strengths"
    )
