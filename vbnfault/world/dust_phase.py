"""Provide phase functions of cometary dust: scattered light over that at 0° of phase."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..scene.coma import PhaseFunctionTable

F64 = NDArray[np.float64]

# Schleicher's composite dust phase function ("Halley-Marcus", D. Schleicher, Lowell Observatory, May 2010,
# asteroid.lowell.edu/comet/dustphase.html, used by Schleicher & Bair 2011, AJ 141, 177): every degree from 0° to
# 180°. Below some 42° it is the curve of 1P/Halley (Schleicher, Millis & Birch 1998, Icarus 132, 397), above it
# that of Marcus 2007. The published table has these digits, and so has `phase_HalleyMarcus` of the package sbpy.
_HALLEY_MARCUS = """
1.0 .9596 .9217 .8859 .8522 .8205 .7906 .7624 .7358 .7107 .6871 .6647 .6436 .6237 .6049
.5872 .5704 .5546 .5396 .5255 .5122 .4996 .4877 .4765 .4659 .4559 .4465 .4377 .4293 .4215
.4142 .4073 .4009 .3949 .3893 .3840 .3792 .3747 .3706 .3668 .3634 .3603 .3575 .3540 .3509
.3482 .3458 .3438 .3421 .3407 .3397 .3389 .3385 .3383 .3385 .3389 .3396 .3405 .3418 .3432
.3450 .3470 .3493 .3518 .3546 .3576 .3609 .3645 .3683 .3724 .3768 .3815 .3865 .3917 .3973
.4032 .4094 .4159 .4228 .4300 .4376 .4456 .4540 .4627 .4720 .4816 .4918 .5024 .5136 .5253
.5375 .5504 .5638 .5780 .5928 .6084 .6247 .6419 .6599 .6788 .6987 .7196 .7416 .7648 .7892
.8149 .8420 .8706 .9008 .9327 .9664 1.0021 1.0399 1.0799 1.1223 1.1673 1.2151 1.2659 1.3200 1.3776
1.4389 1.5045 1.5744 1.6493 1.7294 1.8153 1.9075 2.0066 2.1132 2.2281 2.3521 2.4861 2.6312 2.7884 2.9592
3.1450 3.3474 3.5685 3.8104 4.0755 4.3669 4.6877 5.0418 5.4336 5.8682 6.3518 6.8912 7.4948 8.1724 8.9355
9.7981 10.777 11.891 13.166 14.631 16.322 18.283 20.570 23.252 26.418 30.177 34.672 40.086 46.659 54.704
64.637 77.015 92.587 112.37 137.75 170.60 213.48 269.73 343.59 439.89 562.92 713.63 884.48 1053.3 1182.2
1231.2
"""

# Compound Henyey-Greenstein function of Marcus 2007 (International Comet Quarterly 29, 39) for dust without gas:
# asymmetries of the forward and the backward lobe, and the forward fraction. The table above confirms them: from
# 46° on it is this function plus the even light of gas of 1/100 at 90° (his 1/δ), within the rounding of its
# digits. A fit of all four numbers to it gives 0.900, -0.600, 0.950 and 0.0100.
_MARCUS_FORWARD, _MARCUS_BACKWARD, _MARCUS_FORWARD_FRACTION = 0.9, -0.6, 0.95


def relative_phase(function: str | PhaseFunctionTable, phase_deg: ArrayLike) -> F64:
    """Return the light that dust scatters at phase angles over that at 0°, float64 of the same shape.

    Parameters
    ----------
    function
        "halley_marcus", "marcus", or a table of values.
    phase_deg
        Angles at the dust between the directions to the Sun and to the camera, 0 to 180.
    """
    angle = np.clip(np.asarray(phase_deg, dtype=np.float64), 0, 180)
    if function == "halley_marcus":
        return np.asarray(np.exp(_halley_marcus()(angle)))
    if function == "marcus":
        return np.asarray(_marcus(angle) / _marcus(np.zeros(1)))
    assert isinstance(function, PhaseFunctionTable)
    logarithm = np.log(function.value)
    return np.asarray(np.exp(np.interp(angle, function.phase_deg, logarithm - logarithm[0])))


@lru_cache(maxsize=1)
def _halley_marcus() -> Any:
    """Return a function that interpolates the logarithm of the composite phase function."""
    from scipy.interpolate import CubicSpline

    values = np.array(_HALLEY_MARCUS.split(), dtype=np.float64)
    return CubicSpline(np.arange(len(values)), np.log(values))


def _marcus(phase_deg: F64) -> F64:
    """Return the function of Marcus 2007, which is 1 at 90°."""
    cosine = -np.cos(np.radians(phase_deg))  # of the scattering angle

    def lobe(g: float) -> F64:
        return np.asarray(((1 + g * g) / (1 + g * g - 2 * g * cosine)) ** 1.5)

    fraction = _MARCUS_FORWARD_FRACTION
    return fraction * lobe(_MARCUS_FORWARD) + (1 - fraction) * lobe(_MARCUS_BACKWARD)
