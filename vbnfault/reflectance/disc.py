"""Define reflectances with one shape for all wavelengths: a disc function times `body.reflectance`."""

from __future__ import annotations

import math
from typing import Any, Literal

from .contract import LEAST_COSINE, DiscReflectance

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
