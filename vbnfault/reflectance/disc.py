"""Define reflectances with one shape for all wavelengths: a disc function times `body.reflectance`."""

from __future__ import annotations

from typing import Any, Literal

from .contract import LEAST_COSINE, DiscReflectance


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


def _seeliger(m: Any, cos_i: Any, cos_e: Any) -> Any:
    """Return 2 cos i / (cos i + cos e)."""
    return 2 * cos_i / m.maximum(cos_i + cos_e, LEAST_COSINE)
