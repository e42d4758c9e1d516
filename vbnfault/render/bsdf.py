"""Compute the terrain's reflection: the models of `reflectance` in drjit, and as a Mitsuba plugin.

A reflectance gives *terms* per sample, and the weight of each term in each band. Bands are linear in the
terms, so only the terms are summed over the samples of a pixel.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..reflectance.hapke import HAPKE_TABLES, Hapke, hapke_at
from .albedo import GroundPoints, Mirror
from .description import RenderInput
from .runtime import dr, mi
from .sampling import SunDisc
from .surface import TerrainMesh, facing


def has_bands(surface: TerrainMesh, scene: RenderInput) -> bool:
    """Return whether bands differ by more than a factor, so that each needs its own term."""
    coloured = surface.albedo is not None and surface.albedo.coloured
    return scene.reflectance.terms > 1 or scene.dust_contrast is not None or surface.vehicle is not None or coloured


class Reflection:
    """Evaluate the reflection at `hit` with unit vectors `normal` and `view` (from the surface to the viewer).

    If `banded`, there is one term per band, and it includes the weights of the model. Otherwise there is the single
    term of the model, without weights.
    """

    def __init__(
        self, surface: TerrainMesh, scene: RenderInput, hit: Any, normal: Any, view: Any, *, banded: bool
    ) -> None:
        self._scene, self._hit, self._banded = scene, hit, banded
        self._vehicle = surface.vehicle
        self._factors: list[Any] | None = None
        self._mirror: Mirror | None = None
        if surface.albedo is not None:
            spacing = 1 / (float(scene.view.intrinsics[0]) * scene.samples_per_pixel**0.5)
            ground = GroundPoints(
                point_L_m=hit.point,
                footprint_m=hit.range_m * spacing,
                valid=hit.valid,
                view_L=view,
                sun_L=SunDisc(scene.sun).direction,
            )
            self._factors, self._mirror = surface.albedo.factors(ground)
        self._frame = mi.Frame3f(facing(normal, view))
        self._towards_viewer = self._frame.to_local(view)
        self._view = _triple(self._towards_viewer)

    def terms(self, light: Any) -> list[Any]:
        """Return the terms of BRDF × cos i per sample for unit directions towards the light; 0 from below."""
        return self._evaluate(self._frame.to_local(light))

    def scattered(self, u: Any, v: Any) -> tuple[Any, list[Any]]:
        """Return a cosine-distributed direction from two uniform numbers, and the terms divided by its density."""
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v))
        local.z = dr.maximum(local.z, 1e-5)
        weight = dr.pi / local.z  # the density is cos i / π
        return self._frame.to_world(local), [term * weight for term in self._evaluate(local)]

    def _evaluate(self, light: Any) -> list[Any]:
        """Return the terms for directions towards the light in the local frame."""
        model, contrast = self._scene.reflectance, self._scene.dust_contrast
        terms = model.evaluate(dr, _triple(light), self._view)
        if not self._banded:
            return terms if self._factors is None else [terms[0] * self._factors[0]]
        if model.terms == 1:
            terms = [terms[0] * dr.opaque(mi.Float, float(w)) for w in model.weights[0]]
        if contrast is not None:
            dust = self._hit.dust
            terms = [
                t * dr.fma(dust, dr.opaque(mi.Float, float(c)), 1) for t, c in zip(terms, contrast, strict=True)
            ]
        if self._factors is not None:
            each = self._factors * (len(terms) // len(self._factors))
            terms = [t * factor for t, factor in zip(terms, each, strict=True)]
        if self._mirror is not None:
            mirrored = self._mirror(light, self._towards_viewer)
            terms = [t + m for t, m in zip(terms, mirrored, strict=True)]
        if self._vehicle is not None:
            on, lambert = self._hit.on_vehicle, dr.maximum(light.z, 0) * dr.inv_pi
            albedo = self._vehicle.albedo(self._hit.material, on)
            terms = [dr.select(on, lambert * a, t) for a, t in zip(albedo, terms, strict=True)]
        return terms


def _triple(v: Any) -> tuple[Any, Any, Any]:
    """Return the components of a vector."""
    return v.x, v.y, v.z


class HapkeBSDF(mi.BSDF):  # type: ignore[misc]
    """Provide the Mitsuba plugin `hapke` for a user's own scenes.

    `mi.load_dict({"type": "hapke", "parameters": "67p_fornasier2015"})` uses a set of
    `reflectance.hapke.HAPKE_TABLES`. The reflectance is linear between the tabulated wavelengths. Instead of a set,
    numbers that hold at all wavelengths can be given: `w`, `g`, `B0`, `h_s`, `B_C0` (default 0), `h_c` (1),
    `roughness_deg` (0), `K` (1), as in `reflectance.hapke.Hapke`. Directions are cosine-distributed, which is
    unbiased for all of them. The surface is one-sided: it is black from below.

    Raises RuntimeError, through Mitsuba, if the set is unknown or a number is missing.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)

        def parameter(key: str, default: float | None = None) -> np.ndarray:
            return np.array([float(props[key] if default is None else props.get(key, default))])

        if "parameters" in props:
            rows = HAPKE_TABLES[props["parameters"]]
            self._nodes_nm = np.array([row[0] for row in rows])
            self._model = hapke_at(self._nodes_nm, rows)
        else:
            self._nodes_nm = np.zeros(1)
            self._model = Hapke(
                single_scattering_albedo=parameter("w"),
                asymmetry=parameter("g"),
                shadow_hiding_amplitude=parameter("B0"),
                shadow_hiding_width=parameter("h_s"),
                coherent_amplitude=parameter("B_C0", 0.0),
                coherent_width=parameter("h_c", 1.0),
                roughness_deg=parameter("roughness_deg", 0.0),
                porosity_factor=parameter("K", 1.0),
            )
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_flags = flags
        self.m_components = [flags]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        """Return a cosine-distributed direction and its weight."""
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
        """Return BRDF × cos i at the wavelengths of the ray."""
        values = self._model.evaluate(dr, _triple(wo), _triple(si.wi))
        value = mi.Spectrum(values[0])
        for k in range(1, len(values)):  # piecewise linear: each node adds its difference from the one before
            low, high = self._nodes_nm[k - 1 : k + 1]
            value += dr.clip((si.wavelengths - low) / (high - low), 0, 1) * (values[k] - values[k - 1])
        seen = (si.wi.z > 0) & (wo.z > 0) & active
        return dr.select(seen, value, 0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the probability density of a direction."""
        seen = (si.wi.z > 0) & (wo.z > 0) & active
        return dr.select(seen, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return BRDF × cos i and the probability density."""
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def to_string(self) -> str:
        """Return a text for Mitsuba's messages."""
        return f"Hapke[{self._model}]"


mi.register_bsdf("hapke", HapkeBSDF)
