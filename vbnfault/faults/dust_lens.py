"""Simulate dust by physics: grains on a lens surface or on the sensor's window, in the beams that cross them.

A pixel loses the fraction of its beam's footprint that grains cover (`lens.beams` computes it by exact rays):

    τ = 1 - Σ (1 - t_g) · |grain ∩ footprint| / |footprint|.

A grain of diameter d in front of a pupil of diameter D, at a distance z from it, gives a shadow f (D + d) / z wide,
with f the focal length. Its plateau is f |D - d| / z wide and (d/D)² deep. A grain at a height s above the sensor,
in a cone of f-number N, gives a shadow d + s/N wide. Grains are discs perpendicular to the axis, with the
transmission t_g. All channels lose the same fraction.

In the Sun a grain glows. It diffracts as much light as it blocks, like a disc of its radius a, at the angle θ from
the Sun's direction and for k = 2π/λ:

    dσ/dΩ = (1 - t_g) k² a⁴ [J1(x) / x]²,   x = k a sin θ.

This is averaged over radii within ±50 %, because real grains do not show the rings of a disc. The outside of a
grain reflects like a sphere, (1 - t_g) a²/4 R((π - θ)/2), with R the reflectance at an angle of incidence. A pixel
whose beam crosses the grain receives the irradiance

    E = E☉ T dσ/dΩ dΩ/dA

from the Sun's irradiance E☉ through the transmittance T of the lens, with dΩ/dA the solid angle per area of sensor
(the form of Peterson 2004, Proc. SPIE 5178, 184, for a single grain). Other pixels receive nothing from the grain.
Grains on the front are therefore bright discs near the Sun, with the outlines of their shadows.

After a touchdown a cover of fine dust lies on the front besides. Grains that are spread evenly and cover the
fraction c of the front take the fraction c of the light, and diffract as much of what passes (Babinet): the direct
image has (1 - c)², a halo c (1 - c), both together 1 - c. The halo is that of the grains' mean diameter. ONC-T and
ONC-W1 of Hayabusa2 lost sensitivity and contrast after the first touchdown on Ryugu (Kouyama et al. 2021, Icarus
360, 114353), and ONC-T went on doing so for more than a year (Yamada et al. 2023, Earth Planets Space 75, 36).

Left out are the glow of fine dust under a Sun outside the frame, that of grains on the window, which is lost in
the Sun's own image, and the light that reaches grains behind the first surface from outside the beam of the Sun's
image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import j1

from ..lens import RealLens, load_lens
from ..lens.beams import Footprint
from ..lens.coating import reflect_transmit
from ..lens.glass import D_NM
from ..lens.image_frame import ImageFrame
from ..lens.paraxial import along
from ..lens.rays import forward
from ..lens.straylight.particles import DUST_INDEX
from .context import FaultContext, Params
from .contract import LensFault, first_of
from .fields import Interval, Severity, bounds, number
from .planes import cell_px, reaches, strewn, times

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_DRAWN, _WINDOW = -1, -2
_NODES = 129  # nodes along each side of the frame at which the code searches for shadows
_COARSEST = 8  # largest distance in px between the nodes at which shadows are computed
_ERROR = 3e-4  # largest error of the interpolation between them, as a fraction of the light
_OFFSETS: F64 = np.geomspace(1e-5, 2.0, 257)
_LOOKUP = 1 << 14
_RADII = 32  # number of radii over which a lobe is averaged
_SMOOTH = 30.0  # k a sin θ above which a lobe falls smoothly


@dataclass(frozen=True, kw_only=True)
class DefocusedDust(LensFault):
    """Add the shadows of grains far out of focus, and their glow in the Sun."""

    fault = "dust_on_optics"
    model = "defocused"
    step = "electrons"
    severity = Severity(key="count", low=1, high=1000, drawn=lambda params, *_: len(params["x_mm"]))
    localised = False
    soft_layer = "dust_opacity"

    surface: int = number(
        0,
        limits=(_WINDOW, 99),
        integer=True,
        doc="row of the prescription that the grains lie on; -1: each grain on the front or on the sensor's "
        "window, by chance; -2: all on the window",
    )
    count: Interval = bounds(20, 60, limits=(0, 1000), integer=True, doc="number of grains on the clear aperture")
    diameter_um: Interval = bounds(
        50, 300, limits=(0.1, 1e4), unit="µm", doc="smallest and largest diameter of a grain"
    )
    size_exponent: float = number(
        1.0, limits=(0, 6), doc="p of the number of grains larger than D, ∝ D⁻ᵖ; 0: uniform in log D"
    )
    transmission: Interval = bounds(0.0, 0.3, limits=(0, 1), doc="fraction of the light that a grain lets pass")
    window_height_mm: Interval = bounds(
        0.3, 1.0, limits=(1e-3, 100), unit="mm", doc="of the window's dusty side above the sensor"
    )
    cover: Interval = bounds(
        0.0, 0.0, limits=(0, 0.9), doc="fraction of the front under fine dust, as after a touchdown; 0: none"
    )
    cover_um: float = number(30.0, limits=(1, 1000), unit="µm", doc="mean diameter of this fine dust; assumed")
    mask_loss: float = number(
        0.01,
        limits=(1e-4, 1),
        doc="the mask holds the pixels that lose at least this fraction of their light, or gain as much of white",
    )

    def validate(self) -> None:
        """Raise an error if the named lens cannot be loaded, or lacks the surface."""
        super().validate()
        if self.lens and self.surface >= (rows := len(load_lens(self.lens).surfaces)):
            raise ValueError(f"surface = {self.surface}: {self.lens} has rows 0 to {rows - 1}")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return lens, row of the surface, height of the window, and one list per property of the grains.

        `x_mm` and `y_mm` are the positions on the surface, measured from the axis (x to the right, y down, in the
        same directions as the shadows of grains on the window). `on_window` says which grains lie on the window.
        """
        frame = context.frame
        surfaces = frame.real_lens(self.lens).prescription.surfaces
        row = min(max(int(self.surface), 0), len(surfaces) - 1)
        count = self.count.integer(rng)
        height = self.window_height_mm.uniform(rng)
        by_chance = rng.random(count) < 0.5
        on_window = by_chance if self.surface == _DRAWN else np.full(count, self.surface == _WINDOW)
        largest = surfaces[row].semi_diameter_mm
        radius, turn = largest * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
        across = rng.uniform(-0.5, 0.5, (2, count))
        size_mm = np.array([[frame.width_px], [frame.height_px]]) * frame.pixel_pitch_um * 1e-3
        x, y = np.where(on_window, across * size_mm, radius * np.stack([np.cos(turn), np.sin(turn)]))
        params: Params = {
            "lens": self.lens,
            "surface": row,
            "window_height_mm": float(height),
            "on_window": on_window.tolist(),
            "x_mm": np.round(x, 5).tolist(),
            "y_mm": np.round(y, 5).tolist(),
            "diameter_um": np.round(self.diameter_um.power_law(rng.random(count), self.size_exponent), 3).tolist(),
            "transmission": np.round(self.transmission.uniform(rng, count), 4).tolist(),
            "mask_loss": float(self.mask_loss),
        }
        if cover := self.cover.uniform(rng):  # so that the stored parameters of other scenes stay as they are
            params |= {"cover": cover, "cover_um": float(self.cover_um)}
        return params

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with only the first `fraction` of the grains."""
        return first_of(params, fraction, "on_window", "x_mm", "y_mm", "diameter_um", "transmission")

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons times the transmission of all grains, plus their glow."""
        out, cover = times(quantity.array, context.once(_shadows, params).transmission), params.get("cover", 0.0)
        if cover:
            waves = partial(context.once, _halo_waves, params)
            diffracted = np.full(1, cover * (1 - cover), np.float32)
            halo = strewn(out, quantity.white_e, waves, cell_px(context.frame), diffracted)
            out = out * np.float32((1 - cover) ** 2) + halo
        light = context.once(_glow, params)
        return quantity.with_array(out if light is None else out + light)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels where the loss reaches `mask_loss`, or the glow that fraction of white, bool[y, x].

        The glow counts if it reaches the level in any channel.
        """
        dark = self.soft(params, context) >= np.float32(params["mask_loss"])
        light = context.once(_glow, params)
        if light is None:
            return np.asarray(dark)
        white = np.asarray(context.camera.detector.white_e, dtype=np.float32)
        return np.asarray(dark | reaches(light, np.float32(params["mask_loss"]) * white))

    def soft(self, params: Params, context: FaultContext) -> F32:
        """Return the fraction of the light that the grains remove, float32[y, x]. Their glow does not count."""
        return np.float32(1) - context.once(_shadows, params).transmission * np.float32(
            1 - params.get("cover", 0.0)
        )


# --- geometry --------------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _footprint(frame: ImageFrame, name: str, row: int, height_mm: float) -> Footprint:
    """Return the footprints on a surface of the lens, or `height_mm` above the sensor if that is not 0."""
    beams = frame.beams(name)
    return Footprint.above_sensor(beams, height_mm) if height_mm else Footprint.on_row(beams, row)


class _Grains(NamedTuple):
    """Hold the grains of one surface: positions and radii in mm, and the fraction of light that each blocks."""

    x_mm: F64
    y_mm: F64
    radius_mm: F64
    taken: F64


def _grains(params: Params, on_window: bool) -> _Grains:
    """Return the grains on the window, or those on the surface of the lens."""
    chosen = np.array(params["on_window"], dtype=bool) == on_window
    names = ("x_mm", "y_mm", "diameter_um", "transmission")
    x, y, diameter, passes = (np.asarray(params[n], dtype=np.float64)[chosen] for n in names)
    return _Grains(x, y, diameter / 2e3, 1 - passes)


# --- shadows ---------------------------------------------------------------------------------------------------


class _Shadows(NamedTuple):
    """Hold what the grains do to each pixel's beam.

    Attributes
    ----------
    transmission
        float32[y, x].
    seen
        float32[2, y, x]: Σ (1 - t) · q · a in mm, and Σ (1 - t) · q · a² in mm², over the grains on the surface
        that the Sun lights. q is the lit fraction of the grain times the fraction of it in the pixel's beam, a is
        its radius. None if the Sun lights no grain.
    """

    transmission: F32
    seen: F32 | None


def _shadows(params: Params, context: FaultContext) -> _Shadows:
    """Return the shadows of all grains. Transmissions of the window and of the lens's surface multiply."""
    frame = context.frame
    total: F32 | None = None
    seen: F32 | None = None
    for on_window in (False, True):
        grains = _grains(params, on_window)
        if not len(grains.x_mm):
            continue
        height = params["window_height_mm"] if on_window else 0.0
        footprint = _footprint(frame, params["lens"], params["surface"], height)
        lit = None if on_window else _lit(params, context, grains)
        lost, seen_here = _sums(grains, footprint, frame, on_window, lit)
        kept = np.maximum(np.float32(1) - lost, np.float32(0))
        total = kept if total is None else total * kept
        seen = seen if seen_here is None else seen_here
    if total is None:
        total = np.ones(context.shape, dtype=np.float32)
    return _Shadows(total, seen)


def _step_px(grains: _Grains, footprint: Footprint, frame: ImageFrame) -> int:
    """Return the distance in px between the nodes at which shadows are computed, a power of two.

    Between the nodes the interpolation is linear. The soft edge of a shadow is as wide as the grain, or as the beam
    if that is narrower.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = np.abs(np.gradient(footprint.centre_mm, footprint.slope)).max()
    focal_px = frame.lens.focal_length_mm * 1e3 / frame.pixel_pitch_um
    beam_mm2 = float(np.median(footprint.area_mm2[footprint.area_mm2 > 0]))
    edge_px = 2 * np.minimum(grains.radius_mm, np.sqrt(beam_mm2 / np.pi)) * focal_px / max(float(moves), 1e-9)
    depth = grains.taken * np.minimum(np.pi * grains.radius_mm**2 / beam_mm2, 1)
    # the edge rises over its width like the area of a circular segment: linear pieces miss 0.3 (step / width)^1.5
    # of it
    step = float((edge_px * (_ERROR / np.maximum(0.3 * depth, 1e-12)) ** (2 / 3)).min())
    return int(2 ** np.clip(np.floor(np.log2(max(step, 1))), 0, np.log2(_COARSEST)))


def _sums(
    grains: _Grains, footprint: Footprint, frame: ImageFrame, on_window: bool, lit: F64 | None
) -> tuple[F32, F32 | None]:
    """Return the summed blocked fraction of the light, float32[y, x], and `seen` of `_Shadows`."""
    step = _step_px(grains, footprint, frame)
    x_px, y_px = frame.nodes_px(step)
    sums = np.zeros((1 if lit is None else 3, len(y_px), len(x_px)), dtype=np.float32)
    # compute the footprints of a coarse grid once; on the pixel grid, compute only those near each grain
    whole = footprint.towards(*frame.slopes(x_px, y_px)) if step > 1 else None
    for k, (top, bottom, left, right) in enumerate(_windows(grains, footprint, frame, x_px, y_px)):
        if top >= bottom or left >= right:
            continue
        part = (slice(top, bottom), slice(left, right))
        footprints = (
            footprint.towards(*frame.slopes(x_px[left:right], y_px[top:bottom]), light=not on_window)
            if whole is None
            else whole.part(part)
        )
        radius = float(grains.radius_mm[k])
        # near the sensor the cone is narrow: shadows are small, and at the frame's corners footprints are far from
        # round
        cover = footprints.covered_nearby if on_window else footprints.covered
        covered = cover(float(grains.x_mm[k]), float(grains.y_mm[k]), radius)
        covered *= np.float32(grains.taken[k])
        sums[0][part] += covered
        if lit is not None and lit[k] > 0:
            covered *= footprints.area_mm2
            sums[1][part] += covered * np.float32(lit[k] / (np.pi * radius))
            sums[2][part] += covered * np.float32(lit[k] / np.pi)
    finer = [frame.between_nodes(v, step) for v in sums]
    return finer[0], None if lit is None else np.stack(finer[1:])


def _windows(
    grains: _Grains, footprint: Footprint, frame: ImageFrame, x_px: NDArray, y_px: NDArray
) -> list[tuple[int, int, int, int]]:
    """Return for each grain the start and stop of rows and columns; outside of them it touches no footprint."""
    x, y = (np.linspace(v[0], v[-1], min(_NODES, len(v))) for v in (x_px, y_px))
    footprints = footprint.towards(*frame.slopes(x, y), light=False)
    at_x, at_y = footprints.centre_mm * footprints.cos, footprints.centre_mm * footprints.sin
    # distance from a node to the farthest position that has it as its nearest node
    apart = sum(float(np.hypot(np.diff(at_x, axis=a), np.diff(at_y, axis=a)).max(initial=0)) for a in (0, 1))
    reach = float(footprint.rim_mm.max()) + grains.radius_mm + 0.55 * apart
    grain_x, grain_y, square = (v.astype(np.float32)[:, None, None] for v in (grains.x_mm, grains.y_mm, reach**2))
    near: Any = (at_x - grain_x) ** 2 + (at_y - grain_y) ** 2 < square
    near &= footprints.area_mm2 > 0
    spans = []
    for fine, coarse, touched in ((y_px, y, near.any(axis=2)), (x_px, x, near.any(axis=1))):
        gap = coarse[1] - coarse[0] if len(coarse) > 1 else 1.0
        first, last = touched.argmax(axis=1), touched.shape[1] - 1 - touched[:, ::-1].argmax(axis=1)
        start = np.searchsorted(fine, coarse[first] - gap)
        stop = np.where(touched.any(axis=1), np.searchsorted(fine, coarse[last] + gap, side="right"), 0)
        spans += [start, stop]
    return [(int(a), int(b), int(c), int(d)) for a, b, c, d in zip(*spans, strict=True)]


# --- glow ------------------------------------------------------------------------------------------------------


class _Sun(NamedTuple):
    """Hold the slopes and the unit vector of the Sun's direction, and its irradiance in the bands, W m⁻² nm⁻¹."""

    slope: F64
    direction: F64
    wavelength_nm: F64
    irradiance: F64
    radius_rad: float


def _sun(context: FaultContext) -> _Sun | None:
    """Return the Sun; None if it is unknown, behind the camera or covered."""
    direction, irradiance = context.sun_direction_C, context.sun_irradiance_W_m2_nm
    if direction is None or irradiance is None or context.wavelength_nm is None or direction[2] <= 1e-3:
        return None
    if context.sun_visible == 0:
        return None
    unit = direction / np.linalg.norm(direction)
    radius = 0.0 if context.sun_angular_radius_rad is None else float(context.sun_angular_radius_rad)
    return _Sun(unit[:2] / unit[2], unit, context.wavelength_nm, irradiance * context.sun_visible, radius)


def _in_suns_beam(params: Params, context: FaultContext, grains: _Grains, sun: _Sun) -> F64:
    """Return the fraction of each grain's area inside the beam of the Sun's image, float64[grain]."""
    footprint = _footprint(context.frame, params["lens"], params["surface"], 0.0)
    if np.hypot(*sun.slope) > footprint.slope[-1]:
        return np.zeros(len(grains.x_mm))
    footprints = footprint.towards(*sun.slope.reshape(2, 1, 1))
    shares = [
        float((footprints.covered(x, y, a) * footprints.area_mm2)[0, 0]) / (np.pi * a * a)
        for x, y, a, _ in zip(*grains, strict=True)
    ]
    return np.array(shares)


def _lit(params: Params, context: FaultContext, grains: _Grains) -> F64 | None:
    """Return the fraction of each grain's area that the Sun lights; None if it lights no grain.

    The Sun lights all of the first surface.
    """
    sun = _sun(context)
    if sun is None:
        return None
    lit = _in_suns_beam(params, context, grains, sun) if params["surface"] else np.ones(len(grains.x_mm))
    return lit if lit.any() else None


def lobe(x: F64) -> F64:
    """Return [J1(x)/x]² averaged over a range of radii, float64 of the shape of `x`.

    The mean is that of s⁴ [J1(s x)/(s x)]² over radii s a, with s within ±50 % of its middle. s is scaled to a mean
    square of 1, which keeps the scattered light, ∝ a².
    """
    u = 2 * (np.arange(_RADII) + 0.5) / _RADII - 1
    weight = 1 + np.cos(np.pi * u)
    s = 1 + 0.5 * u
    s /= np.sqrt(np.average(s**2, weights=weight))
    of = np.maximum(np.multiply.outer(x, s), 1e-6)
    return np.asarray(np.average(s**4 * (j1(of) / of) ** 2, axis=-1, weights=weight))


@lru_cache(maxsize=1)
def _lobe_nodes() -> tuple[F64, F64]:
    """Return the nodes and values of the table of `lobe`."""
    x = np.linspace(0, _SMOOTH, 3001)
    return x, lobe(x)


def _lobe_table(x: F64) -> F64:
    """Return `lobe` by linear interpolation, within 1e-4; above `_SMOOTH` it falls as x⁻³."""
    nodes, values = _lobe_nodes()
    out = np.interp(x, nodes, values)
    far = x >= _SMOOTH
    out[far] = values[-1] * (_SMOOTH / x[far]) ** 3
    return out


def _halo_waves(params: Params, context: FaultContext, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Return the Fourier transform of the light that fine dust diffracts into the cells around, sum 1."""
    frame = context.frame
    cell = cell_px(frame) * frame.pixel_pitch_um * 1e-3 / frame.lens.focal_length_mm
    y, x = (np.fft.fftfreq(n, 1 / n) * cell for n in shape)
    sine = np.sin(np.arctan(np.hypot(x, y[:, None])))
    lobe_of = _lobe_table(np.pi * params["cover_um"] * 1e3 / D_NM * sine.ravel()).reshape(shape)
    waves: NDArray[np.complex64] = fft.rfft2((lobe_of / lobe_of.sum()).astype(np.float32))
    return waves


def _glow(params: Params, context: FaultContext) -> F32 | None:
    """Return the light that grains scatter or reflect onto the sensor, electrons float32[y, x, channel].

    Far from the Sun the lobes of all grains fall in the same manner, as a / (π k sin³θ), so a sum over the grains
    in a pixel's beam is sufficient. Near the Sun each grain has a lobe of its own. There the beam of a pixel is
    close to that of the Sun's image, so the grains in the Sun's beam can be used.
    """
    seen, sun = context.once(_shadows, params).seen, _sun(context)
    if seen is None or sun is None:
        return None
    camera = context.camera
    lens = context.frame.real_lens(params["lens"])
    grains = _grains(params, on_window=False)
    lit = _lit(params, context, grains)
    assert lit is not None
    core = lit * _in_suns_beam(params, context, grains, sun) * grains.taken
    light = sun.irradiance / camera.lens.focal_length_mm**2
    to_e = camera.electron_rate_weights(sun.wavelength_nm) * camera.exposure_s * light
    pixel_rad = camera.detector.pixel_pitch_um * 1e-3 / camera.lens.focal_length_mm
    sun = sun._replace(radius_rad=float(np.hypot(sun.radius_rad, pixel_rad / np.sqrt(np.pi))))
    own, factor, common, reflected = _lobes(grains.radius_mm, core, sun, _stretch(lens, params["surface"]))
    return _painted(to_e @ own, (to_e @ factor, to_e.sum(axis=1)), (common, reflected), seen, sun, context.frame)


def _stretch(lens: RealLens, row: int) -> float:
    """Return the diameter of the paraxial beam at the entrance over that on the row."""
    marginal = abs(float(along(lens.prescription, forward(lens.prescription))[1][row, 0, 0]))
    return 1 / max(marginal, 1e-6)


def _lobes(radius_mm: F64, core: F64, sun: _Sun, stretch: float) -> tuple[F64, F64, F64, F64]:
    """Return the scattered intensity at `_OFFSETS`, averaged over the Sun's disc (widened by a pixel's area).

    Returns
    -------
    own
        float64[band, offset] in mm²: intensity of the grains in the Sun's beam, weighted by `core`, minus the
        common lobe.
    factor, common
        float64[band] and float64[offset]: the common lobe per mm of radius is their product.
    reflected
        float64[offset]: reflected intensity per mm² of squared radius.
    """
    k = 2 * np.pi * 1e6 / sun.wavelength_nm  # per mm
    nodes, values = _lobe_nodes()
    factor = float(np.pi * nodes[-1] ** 3 * values[-1]) / (np.pi * k)  # π x³ · lobe(x) is constant for large x
    knee = 2 / (k.mean() * np.median(radius_mm))

    # an offset is twice the sine of half the angle
    sine = np.minimum(stretch * _OFFSETS * np.sqrt(np.maximum(1 - _OFFSETS**2 / 4, 0)), 1)
    common = (sine**2 + knee**2) ** -1.5 * (_OFFSETS**2 < 2)
    rs, rp, _, _ = reflect_transmit((), 1.0, DUST_INDEX.real, np.minimum(_OFFSETS / 2, 1), D_NM)
    own = -np.multiply.outer((core * radius_mm).sum() * factor, common)
    for radius, fraction in zip(radius_mm, core, strict=True):
        if fraction > 1e-6:
            strength = (fraction * k**2 * radius**4)[:, None]
            own += strength * _lobe_table(np.multiply.outer(k * radius, sine)) * (common > 0)
    # even a narrow lobe is sampled well at `_OFFSETS`, so its mean over the disc is a sum over rings
    over_disc = _over_disc(sun.radius_rad).T * stretch**4
    return own @ over_disc, factor, common @ over_disc, (rs + rp) / 8 @ over_disc


def _over_disc(radius_rad: float) -> F64:
    """Return weights that average a function of distance over a disc, float64[mean, function].

    Both axes are distances `_OFFSETS` from the centre of the function. Far from that centre, the mean is the
    function itself.
    """
    r, s = _OFFSETS[:, None], _OFFSETS[None, :]
    # arc within the disc of a ring about the centre of the function
    arc = np.arccos(np.clip((s * s + r * r - radius_rad**2) / (2 * s * r), -1, 1))
    weight = arc * s * np.gradient(_OFFSETS)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    return np.where(r < 8 * radius_rad, weight, np.eye(len(_OFFSETS)))


@lru_cache(maxsize=2)
def _field(frame: ImageFrame) -> tuple[F32, F32 | None]:
    """Return the directions of all pixels, float32[3, y, x], and the relative solid angle per sensor area.

    The latter, float32[y, x], is the solid angle of a real lens per area of the sensor, over that on the axis; None
    for a thin lens.
    """
    lens = frame.lens
    x, y = frame.slopes(np.arange(frame.width_px) + 0.5, np.arange(frame.height_px) + 0.5)
    per_length = 1 / np.sqrt(1 + x * x + y * y)
    density = None
    if lens.falls_off:
        slope = np.hypot(x, y)
        nodes = np.linspace(1e-4, float(slope.max()) + 1e-3, 1025)
        height = lens.distorted(nodes)
        on_area = nodes / (height * np.gradient(height, nodes)) / (1 + nodes**2) ** 1.5
        density = np.interp(slope, nodes, on_area).astype(np.float32)
    return np.stack([x * per_length, y * per_length, per_length]), density


def _painted(
    own_e: F64, factors_e: tuple[F64, F64], lobes: tuple[F64, F64], seen: F32, sun: _Sun, frame: ImageFrame
) -> F32:
    """Return the glow in electrons, float32[y, x, channel].

    It is the sum of `own_e`, float64[channel, offset], and of both lobes, float64[offset]. Each lobe is multiplied
    by its factor for the channel and by its layer of `seen`.
    """
    directions, density = _field(frame)
    square = np.zeros_like(directions[0])
    for component, at in zip(directions, sun.direction, strict=True):
        away = component - np.float32(at)
        away *= away
        square += away
    nodes = 2 * np.log(_OFFSETS)
    steps = np.linspace(nodes[0], nodes[-1], _LOOKUP)
    position = np.log(np.maximum(square, np.float32(_OFFSETS[0] ** 2), out=square), out=square)
    position -= np.float32(steps[0])
    position *= np.float32(1 / (steps[1] - steps[0]))
    position += np.float32(0.5)
    at_step = position.astype(np.int32)

    def looked_up(values: F64) -> F32:
        return np.take(np.interp(steps, nodes, values).astype(np.float32), at_step, mode="clip")

    diffracted, reflected = (looked_up(lobe) * layer for lobe, layer in zip(lobes, seen, strict=True))
    colours = []
    for own, by_diffraction, by_reflection in zip(own_e, *factors_e, strict=True):
        light = cv2.addWeighted(diffracted, float(by_diffraction), reflected, float(by_reflection), 0)
        if own.any():
            light += looked_up(own)
        if density is not None:
            light *= density
        colours.append(cv2.max(light, 0))
    return np.asarray(cv2.merge(colours)).reshape(*square.shape, len(colours))
