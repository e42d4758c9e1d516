"""Define reflectances with one shape for all wavelengths: a disc function times `body.reflectance`.

Two of them give a sphere a published phase curve: the H, G system, and a table of magnitudes. Their disc function
is that of Lommel and Seeliger. A phase function f(α) multiplies it, so that the light of a smooth sphere, summed
over its disc, follows the wanted curve Φ: f = Φ / Φ_LS, where Φ_LS is the curve of the disc function alone
(Muinonen & Lumme 2015, A&A 584, A23, write the H, G1, G2 system in this way). The geometric albedo of a sphere is
then `body.reflectance`.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from .contract import (
    DECAY_PER_MAG,
    DEG_PER_HALF,
    LEAST_COSINE,
    DiscReflectance,
    ScaledReflectance,
    Triple,
    tan_half_phase,
)

_PI = math.pi
_RAD_PER_DEG = _PI / 180
_LEAST_SINE = 1e-4  # of the phase angle, from which the longitude follows
_MOST_TANGENT = 1e3  # of the longitude
_MOST_PHASE_RAD = 3.1


class Lambert(DiscReflectance):
    """Reflect equally in all directions: D = cos i."""

    model: Literal["lambert"] = "lambert"

    def disc(self, m: Any, cos_i: Any, cos_e: Any, phase_deg: Any) -> Any:
        """Return cos i."""
        return cos_i


class LommelSeeliger(DiscReflectance):
    """Scatter once in a dark medium: D = 2 cos i / (cos i + cos e)."""

    model: Literal["lommel_seeliger"] = "lommel_seeliger"

    def disc(self, m: Any, cos_i: Any, cos_e: Any, phase_deg: Any) -> Any:
        """Return 2 cos i / (cos i + cos e)."""
        return _seeliger(m, cos_i, cos_e)


class McEwen(DiscReflectance):
    """Mix Lommel-Seeliger and Lambert by phase angle: D = 2 L cos i / (cos i + cos e) + (1 - L) cos i.

    This is the lunar-Lambert function of McEwen (1991, Icarus 92, 298), with L(α) = 1 - 0.019 α + 2.42e-4 α² -
    1.46e-6 α³, α in degrees, at least 0 (McEwen 1996, LPSC 27).
    """

    model: Literal["mcewen"] = "mcewen"

    def disc(self, m: Any, cos_i: Any, cos_e: Any, phase_deg: Any) -> Any:
        """Return the lunar-Lambert function."""
        a = phase_deg
        fraction = m.maximum(1 + a * (-0.019 + a * (2.42e-4 - a * 1.46e-6)), 0)
        return fraction * _seeliger(m, cos_i, cos_e) + (1 - fraction) * cos_i


class Akimov(DiscReflectance):
    """Reflect as a surface that is extremely rough at all scales: Akimov's disc function without parameters.

    D = cos(α/2) cos(π (γ - α/2) / (π - α)) cos(β)^(α / (π - α)) / cos(γ), with the photometric latitude β and
    longitude γ: cos i = cos β cos(α - γ), cos e = cos β cos γ (Shkuratov et al. 2011, Planet. Space Sci. 59, 1326).
    At full phase the disc is evenly bright; else brightness falls smoothly to 0 at the terminator.
    """

    model: Literal["akimov"] = "akimov"

    def disc(self, m: Any, cos_i: Any, cos_e: Any, phase_deg: Any) -> Any:
        """Return Akimov's disc function."""
        phase = m.minimum(_RAD_PER_DEG * phase_deg, _MOST_PHASE_RAD)
        sine = m.maximum(m.cos(phase - 0.5 * _PI), _LEAST_SINE)
        tangent = (cos_i / m.maximum(cos_e, LEAST_COSINE) - m.cos(phase)) / sine
        tangent = m.maximum(m.minimum(tangent, _MOST_TANGENT), -_MOST_TANGENT)
        secant = m.sqrt(1 + tangent * tangent)
        along = (m.atan(tangent) - 0.5 * phase) * (_PI / (_PI - phase))
        equator = m.maximum(m.cos(m.maximum(along, -0.5 * _PI)), 0) * secant
        log_latitude = m.log(m.maximum(m.minimum(cos_e * secant, 1), LEAST_COSINE))
        bent = m.exp(log_latitude * (phase / (_PI - phase)))
        return m.select(cos_i > 0, m.cos(0.5 * phase) * equator * bent, 0)


def _seeliger(m: Any, cos_i: Any, cos_e: Any) -> Any:
    """Return 2 cos i / (cos i + cos e)."""
    return 2 * cos_i / m.maximum(cos_i + cos_e, LEAST_COSINE)


# --- phase curves of spheres ------------------------------------------------------------------------------------

# f keeps its value at 150° beyond that phase angle. There Φ_LS falls towards 0 at 180° and Φ is hardly measured.
_LAST_DEG = 150.0
_LAST_TANGENT = float(np.tan(np.radians(_LAST_DEG / 2)))
_LEAST_TANGENT = 1e-6  # keeps the logarithm finite at opposition
_MOST_ROWS = 1000
_LEAST_MAGNITUDE = -1.0


class SphereCurve(ScaledReflectance, ABC):
    """Reflect as Lommel-Seeliger with the phase function that gives a sphere the curve `curve`."""

    @abstractmethod
    def curve(self, m: Any, tan_half: Any) -> Any:
        """Return the flux Φ of a sphere relative to that at zero phase, from tan(α/2), up to 150° of phase."""

    def term(self, m: Any, light: Triple, view: Triple) -> Any:
        """Return the Lommel-Seeliger term times Φ / Φ_LS; A is the geometric albedo of a sphere."""
        tan_half = m.minimum(m.maximum(tan_half_phase(m, light, view), _LEAST_TANGENT), _LAST_TANGENT)
        cos_i, cos_e = m.maximum(light[2], 0), m.maximum(view[2], LEAST_COSINE)
        phase = self.curve(m, tan_half) / lommel_seeliger_curve(m, tan_half)
        return 2 * cos_i / (cos_i + cos_e) * phase


def lommel_seeliger_curve(m: Any, tan_half: Any) -> Any:
    """Return the flux of a Lommel-Seeliger sphere relative to zero phase: 1 - sin(α/2) tan(α/2) ln cot(α/4).

    `tan_half` is tan(α/2) > 0 (Lester, McCall & Tatum 1979, J. Roy. Astron. Soc. Canada 73, 233).
    """
    secant = m.sqrt(1 + tan_half * tan_half)
    return 1 - tan_half * tan_half / secant * m.log((secant + 1) / tan_half)


class HG(SphereCurve):
    """Give a sphere the phase curve of the H, G system of asteroids (Bowell et al. 1989, Asteroids II, 524)."""

    model: Literal["hg"] = "hg"
    slope_parameter: float = Field(0.15, ge=-0.25, le=1, description="G; usual: 0.09 if dark, 0.23 if stony")

    def curve(self, m: Any, tan_half: Any) -> Any:
        """Return (1 - G) Φ1 + G Φ2, with Φ = w exp(-a tan^b(α/2)) … of Bowell et al. 1989, eq. A4."""
        # Φ joins a linear-exponential and a curve of small phase angles by a weight exp(-90.56 tan²(α/2))
        log = m.log(tan_half)
        sine = 2 * tan_half / (1 + tan_half * tan_half)
        weight = m.exp(-90.56 * tan_half * tan_half)
        parts = []
        for a, b, c in ((3.332, 0.631, 0.986), (1.862, 1.218, 0.238)):
            near = 1 - c * sine / (0.119 + 1.341 * sine - 0.754 * sine * sine)
            far = m.exp(-a * m.exp(b * log))
            parts.append(weight * near + (1 - weight) * far)
        return (1 - self.slope_parameter) * parts[0] + self.slope_parameter * parts[1]


Phase = Annotated[float, Field(ge=0, le=_LAST_DEG)]
Magnitude = Annotated[float, Field(ge=_LEAST_MAGNITUDE, le=30)]


class PhaseCurve(SphereCurve):
    """Give a sphere a phase curve of its own: magnitudes at phase angles."""

    model: Literal["phase_curve"] = "phase_curve"
    phase_deg: tuple[Phase, ...] = Field(
        (0.0, 150.0),
        min_length=2,
        max_length=_MOST_ROWS,
        description="increasing phase angles, from 0. Beyond the last one the last slope continues to 150°; from "
        "there on, the ground has the phase function of 150°",
    )
    magnitude: tuple[Magnitude, ...] = Field(
        (0.0, 6.0),
        min_length=2,
        max_length=_MOST_ROWS,
        description="magnitudes of a sphere at these angles, fainter than at 0, where it is 0; linear in between. "
        "Default: 0.04 mag/°",
    )

    @model_validator(mode="after")
    def _paired(self) -> PhaseCurve:
        if len(self.phase_deg) != len(self.magnitude):
            raise ValueError(
                f"phase_deg has {len(self.phase_deg)} and magnitude {len(self.magnitude)} values: must be as many"
            )
        if self.phase_deg[0] != 0 or self.magnitude[0] != 0:
            raise ValueError(
                f"phase_deg[0] = {self.phase_deg[0]:g}, magnitude[0] = {self.magnitude[0]:g}: must both be 0"
            )
        if any(a >= b for a, b in itertools.pairwise(self.phase_deg)):
            raise ValueError(f"phase_deg = {list(self.phase_deg)}: must increase")
        slope = (self.magnitude[-1] - self.magnitude[-2]) / (self.phase_deg[-1] - self.phase_deg[-2])
        at_the_end = self.magnitude[-1] + slope * (_LAST_DEG - self.phase_deg[-1])
        if at_the_end < _LEAST_MAGNITUDE:
            raise ValueError(
                f"magnitude[-1] = {self.magnitude[-1]:g}: the last slope continues to {at_the_end:.3g} at "
                f"{_LAST_DEG:g} deg; must be at least {_LEAST_MAGNITUDE:g} there"
            )
        return self

    def curve(self, m: Any, tan_half: Any) -> Any:
        """Return 10^(-0.4 magnitude), with magnitudes interpolated linearly in the phase angle."""
        phase_deg = DEG_PER_HALF * m.atan(tan_half)
        magnitude, last = 0.0 * phase_deg, len(self.phase_deg) - 2
        for k in range(last + 1):
            low, high = self.phase_deg[k : k + 2]
            slope = (self.magnitude[k + 1] - self.magnitude[k]) / (high - low)
            within = m.maximum(phase_deg - low, 0)
            magnitude = magnitude + slope * (within if k == last else m.minimum(within, high - low))
        return m.exp(-DECAY_PER_MAG * magnitude)
