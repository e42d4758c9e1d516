"""Reflection of the terrain: `photometry` in drjit, and as a Mitsuba plugin.

A photometric model gives *terms* per sample and weights of each term in each band: bands are linear in the terms,
so only the terms are summed over the samples of a pixel.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..photometry import Hapke, Photometry
from .runtime import dr, mi


class Reflection:
    """A photometric model at hits with unit `normal`, seen along unit `view` (away from the surface)."""

    def __init__(self, model: Photometry, normal: Any, view: Any) -> None:
        self._model = model
        self._frame = mi.Frame3f(normal)
        self._view = _triple(self._frame.to_local(view))

    def terms(self, light: Any) -> list[Any]:
        """Per sample, BRDF × cos i for unit directions towards the light; 0 where it comes from below."""
        return self._model.evaluate(dr, _triple(self._frame.to_local(light)), self._view)

    def scattered(self, u: Any, v: Any) -> tuple[Any, list[Any]]:
        """A direction drawn by the cosine, from two uniform numbers, and the terms over its density there."""
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v))
        local.z = dr.maximum(local.z, 1e-5)
        # BRDF × cos i over cos i / π
        weight = dr.pi / local.z
        terms = self._model.evaluate(dr, _triple(local), self._view)
        return self._frame.to_world(local), [term * weight for term in terms]


def _triple(v: Any) -> tuple[Any, Any, Any]:
    return v.x, v.y, v.z


class HapkeBSDF(mi.BSDF):  # type: ignore[misc]
    """Mitsuba plugin `hapke`, for scenes of one's own: `mi.load_dict({"type": "hapke", "w": 0.045, ...})`.

    Numbers, the same at all wavelengths: `w`, `g`, `B0`, `h_s`, `B_C0` (default 0), `h_c` (1), `roughness_deg` (0),
    `K` (1), as `photometry.Hapke`; directions are drawn by the cosine, which is unbiased for any of them.
    One-sided: black from below.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)

        def one(key: str, default: float | None = None) -> np.ndarray:
            value = props[key] if default is None else props.get(key, default)
            return np.array([float(value)])

        self._model = Hapke(
            single_scattering_albedo=one("w"),
            asymmetry=one("g"),
            shadow_hiding_amplitude=one("B0"),
            shadow_hiding_width=one("h_s"),
            coherent_amplitude=one("B_C0", 0.0),
            coherent_width=one("h_c", 1.0),
            roughness_deg=one("roughness_deg", 0.0),
            porosity_factor=one("K", 1.0),
        )
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_flags = flags
        self.m_components = [flags]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        sample = mi.BSDFSample3f()
        sample.wo = mi.warp.square_to_cosine_hemisphere(sample2)
        sample.pdf = mi.warp.square_to_cosine_hemisphere_pdf(sample.wo)
        sample.eta = 1.0
        sample.sampled_type = +mi.BSDFFlags.GlossyReflection
        sample.sampled_component = 0
        value = self.eval(ctx, si, sample.wo, active)
        usable = sample.pdf > 0
        return sample, dr.select(usable, value / dr.maximum(sample.pdf, 1e-20), 0) & active

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        (value,) = self._model.evaluate(dr, _triple(wo), _triple(si.wi))
        seen = (si.wi.z > 0) & (wo.z > 0) & active
        return mi.Spectrum(dr.select(seen, value, 0))

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        seen = (si.wi.z > 0) & (wo.z > 0) & active
        return dr.select(seen, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def to_string(self) -> str:
        return f"Hapke[{self._model}]"


mi.register_bsdf("hapke", HapkeBSDF)
