"""Compute reflectance and transmittance of thin-film coatings by wavelength, angle and polarisation.

Airy's recursion runs over the interfaces from the substrate outwards. A medium of index n + ik with k ≥ 0 absorbs
(Macleod 2010, Thin-Film Optical Filters, chapter 2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from ..core.errors import InputError
from ..core.tables import table_class

F64 = NDArray[np.float64]

DESIGN_NM = 550.0
_MGF2, _HIGH = 1.38, 2.05  # indices of magnesium fluoride and of a mixed oxide
NAMES = ("none", "mgf2", "v", "bbar")


@table_class()
class Layer:
    """Give one layer of a coating: its index n + ik and its thickness."""

    n: float = Field(ge=0.01, le=10, description="refractive index")
    k: float = Field(default=0.0, ge=0, le=20, description="extinction coefficient")
    thickness_nm: float = Field(ge=0, le=1e5, description="thickness of the layer")


def design(name: str, glass_index: float) -> tuple[Layer, ...]:
    """Return the layers of a named coating between air and glass, the layer next to the air first.

    - `none`: no layer;
    - `mgf2`: a quarter wave of magnesium fluoride;
    - `v`: two layers that do not reflect at 550 nm; where no such pair exists (index of the glass from 1.90 to
      2.21) it is the quarter wave of `mgf2`, which then serves as well;
    - `bbar`: a quarter, a half and a quarter wave, a broadband coating whose innermost layer is chosen for the
      glass.

    Raises
    ------
    InputError
        The name is unknown.
    """
    if name not in NAMES:
        raise InputError(f"coating = {name!r}: unknown; known are {', '.join(NAMES)}, or a list of layers")
    if name == "none":
        return ()
    outer = Layer(n=_MGF2, thickness_nm=DESIGN_NM / 4 / _MGF2)
    if name == "mgf2":
        return (outer,)
    if name == "bbar":
        # at 550 nm the half wave has no effect, and the two quarter waves cancel if the inner one has this index
        inner = _MGF2 * np.sqrt(glass_index)
        half = Layer(n=_HIGH, thickness_nm=DESIGN_NM / 2 / _HIGH)
        return (outer, half, Layer(n=float(inner), thickness_nm=float(DESIGN_NM / 4 / inner)))
    # Macleod 2010, section 4.2.2, thick outer and thin inner solution
    a, b = glass_index - _MGF2**2, _HIGH**2 - glass_index
    c, d = _MGF2**2 * glass_index - _HIGH**2, glass_index - 1
    if a * c <= 0:
        return (outer,)
    phase_outer = np.pi - np.arctan(_MGF2 * np.sqrt(d * b / (c * a)))
    phase_inner = np.arctan(_HIGH * np.sqrt(d * a / (c * b)))
    return (
        Layer(n=_MGF2, thickness_nm=float(phase_outer * DESIGN_NM / (2 * np.pi * _MGF2))),
        Layer(n=_HIGH, thickness_nm=float(phase_inner * DESIGN_NM / (2 * np.pi * _HIGH))),
    )


def reflect_transmit(
    layers: Sequence[Layer], n_front: ArrayLike, n_back: ArrayLike, cos_front: ArrayLike, wavelength_nm: ArrayLike
) -> tuple[F64, F64, F64, F64]:
    """Return reflectance and transmittance of power for both polarisations.

    Parameters
    ----------
    layers
        In the order in which light meets them.
    n_front, n_back
        Real indices of the media in front of the coating and behind it.
    cos_front
        Cosine of the angle of incidence, in (0, 1].
    wavelength_nm
        In vacuum.

    Returns
    -------
    R_s, R_p, T_s, T_p
        float64 each, of the arguments' common shape, in [0, 1].
    """
    n0, ns, c0, wavelength = np.broadcast_arrays(
        np.asarray(n_front, complex), np.asarray(n_back, complex), np.asarray(cos_front, complex), wavelength_nm
    )
    across2 = n0 * n0 * (1 - c0 * c0)

    def normal(index: NDArray) -> NDArray:
        """Return n cos θ on the branch of the root whose wave decays or travels into the medium."""
        q = np.sqrt(index * index - across2 + 0j)
        return np.where((q.imag < 0) | ((q.imag == 0) & (q.real < 0)), -q, q)

    films = [np.full(n0.shape, layer.n + 1j * layer.k) for layer in layers]
    media = [n0, *films, ns]
    runs = [n0 * c0, *(normal(index) for index in media[1:])]
    # exp(iδ) of each film's phase thickness δ, squared for the way there and back; the same in both polarisations
    turns = [
        np.exp(2j * np.pi * run * layer.thickness_nm / wavelength)
        for run, layer in zip(runs[1:], layers, strict=False)
    ]
    powers = []
    for p in (False, True):
        # admittance: n cos θ for s polarisation, n / cos θ for p
        y = [index * index / q if p else q for index, q in zip(media, runs, strict=True)]
        r, t = (y[-2] - y[-1]) / (y[-2] + y[-1]), 2 * y[-2] / (y[-2] + y[-1])
        for k in range(len(layers) - 1, -1, -1):
            turn = turns[k]
            first, through = (y[k] - y[k + 1]) / (y[k] + y[k + 1]), 2 * y[k] / (y[k] + y[k + 1])
            below = 1 + first * r * turn * turn
            r, t = (first + r * turn * turn) / below, through * t * turn / below
        powers.append((np.abs(r) ** 2, np.abs(t) ** 2 * y[-1].real / y[0].real))
    (rs, ts), (rp, tp) = powers
    return rs, rp, ts, tp


def mean_reflectance(
    layers: Sequence[Layer], n_front: ArrayLike, n_back: ArrayLike, cos_front: ArrayLike, wavelength_nm: ArrayLike
) -> F64:
    """Return the reflectance of unpolarised light, the mean of both polarisations."""
    rs, rp, _, _ = reflect_transmit(layers, n_front, n_back, cos_front, wavelength_nm)
    return np.asarray((rs + rp) / 2)
