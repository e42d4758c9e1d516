"""Put particles into view: grains of the coma, ice and debris between the camera and the scene, lit by the Sun.

On 28 March 2015 grains near Rosetta passed for stars in its star trackers, and the spacecraft lost its attitude.
Its cameras showed grains as points, as tracks, and near by as large discs out of focus.

**Where and how large.** Grains lie evenly in space, so their number rises with the square of their depth Z along
the boresight. Their radii a follow a power law, dn ∝ a^-q da. Beyond 3 au 67P had q = 2 up to 1 mm and 4 above
(Rotundi et al. 2015, Science 347, aaa3905, as summed up by Moreno et al. 2016, A&A 587, A155), at its perihelion
3.7 (Fulle et al. 2016, ApJ 821, 19; 3.6 above 1 mm by its tail and trail: Moreno et al. 2017, MNRAS 469, S186). A
comet that loses M of dust a second has M / (4π r² v) of it in a volume at the distance r. For 67P at its
perihelion, 1.5e3 kg/s (Fulle et al. 2016; up to 3e3 three weeks later: Moreno et al. 2017) of 800 kg/m³ between 0.1
and 100 mm at 1 m/s and q = 3.7 are 200 grains per m³ on the ground, 6 at 10 km and 0.014 at 200 km; at 3 au about a
hundredth of it (assumed). Close to the spacecraft there may be many more: Güttler et al. 2017 (MNRAS 469, S312) saw
a cloud of millimetre-sized aggregates at 2 to 40 m, which had come off Rosetta.

**Motion.** A grain leaves along the vertical of the site, within a cone around it, with the speed v (a / 1 mm)^-p.
Drag by gas gives p = 1/2 to a sphere that is still far slower than the gas. GIADA measured 3 m/s on average for
grains of 0.03 to 1 mm (Fulle et al. 2015, ApJ 802, L12), OSIRIS 1 m/s for those of decimetres (Lemos et al. 2023,
MNRAS). The camera has a velocity of its own in a random direction. In the exposure t a grain draws a line of the
length f V t / Z, with V the relative velocity across the line of sight. The change of Z during the exposure is
neglected, so grains that are nearer than half of what they move in it are left out: they would draw streaks right
across the frame.

**Light.** A grain of the geometric albedo A at the distance d gives the camera the irradiance

    E = E☉ (A Φ(α) + D) (a / d)²,   Φ = 10^(-0.4 β α),

with β = 0.047 mag/° of the nucleus of 67P (Fornasier et al. 2015, A&A 583, A30). Grains from a few millimetres on
have its phase function (Fulle et al. 2018, MNRAS 476, 2835; Lemos et al. 2023). Smaller ones are brighter beyond
90°, as the coma is (Bertini et al. 2017, MNRAS 469, S404), because they diffract sunlight around their rim. Their
Fraunhofer pattern (k a J₁(x sin θ) / (x sin θ))², with x = k a = 2π a / λ and the scattering angle θ = 180° - α,
has narrow rings. Its mean over sizes is that with J₁² = 1 / (π x sin θ), so that with Kirchhoff's obliquity

    D = ((1 + cos θ) / 2)² / (π x sin³ θ).

It exceeds the reflected light of a grain of 0.1 mm beyond 124°, and of 1 mm beyond 145°. Nearer to the Sun than 5°
it stays as it is there. Its colour is taken to be that of the reflected light. The power E T A_pupil cos θ (T: the
transmittance of the lens) is drawn as a disc of the radius √(blur² + (a f / Z)² + diffraction²), along the line
(`lens.streaks`). The blur is that of the camera's focus. Like the scene, this light is vignetted. A grain takes
from the light behind it the part that its shadow covers. It is lit where the camera is: by the visible part of the
Sun's disc. Where the depth of the scene is known, nearer ground hides a grain.

**What is left out.** Grains whose light, spread evenly over their figure, is below `least_noise` of the noise of a
dark pixel; all of them together are the diffuse coma. Of more than `most_grains` the brightest stay; of so many
that 3e5 of them had to be tried, those above a higher limit, or any of them if none is above it.

The parameters list the grains, one list for each property: position and extent of the streak in pixels, radius,
depth, distance, and irradiance at the camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.sundisc import forward, slopes_of
from ..detector.noise import poisson_above_0
from ..lens.streaks import Streaks, drawn, inside, pupil_support
from .context import FaultContext, Params
from .contract import Fault, mask_level
from .fields import Interval, bounds, flag, number
from .planes import reaches, times

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_RADII = 513  # nodes of the distribution of radii
_MOST_DRAWN = 300_000  # grains tried, on average, to find those that show
_DRAWN_AT_ONCE = 1 << 16
_ROUNDS = 16  # draws after which a sample stays without a grain
_DIFFRACTION = 0.42  # σ of the Gaussian nearest to an Airy disc, in wavelengths times f-number
_REFERENCE_NM = 550.0
_LEAST_DIFFRACTION_DEG = 5.0  # from the Sun, within which diffracted light stays as it is there
_DIGITS = 6  # of the stored parameters


@dataclass(frozen=True, kw_only=True)
class _Particles(Fault):
    """Add sunlit grains in front of the camera; base of the models."""

    fault = "particles"
    step = "electrons"
    per_exposure = True
    effect_mask = True

    density_per_m3: Interval = bounds(
        1.0, 10.0, limits=(1e-12, 1e6), unit="1/m³", doc="number of grains with radii within `radius_mm`"
    )
    radius_mm: Interval = bounds(
        0.1, 100.0, limits=(1e-3, 1e3), unit="mm", doc="smallest and largest radius of a grain"
    )
    size_exponent: float = number(
        3.7, limits=(0.5, 8), doc="q of the number of grains ∝ a^-q da; 67P: 2 far from the Sun, 3.7 at perihelion"
    )
    nearest_m: float = number(
        2.0, limits=(0.05, 1e5), unit="m", doc="smallest distance of a grain, along the boresight"
    )
    farthest_m: float = number(
        10_000.0, limits=(0.1, 1e6), unit="m", doc="largest distance of a grain, along the boresight"
    )
    speed_m_s: Interval = bounds(
        1.0, 5.0, limits=(0, 1e3), unit="m/s", doc="of a grain with a radius of 1 mm, drawn for each grain"
    )
    speed_exponent: float = number(
        0.5, limits=(0, 2), doc="p of the speed ∝ a^-p; 0.5: drag by gas; 0: the same for all sizes"
    )
    cone_deg: float = number(
        60.0,
        limits=(0, 180),
        unit="°",
        doc="half angle of the cone around the vertical in which directions are even; 180: all directions",
    )
    camera_speed_m_s: Interval = bounds(
        0.0, 1.0, limits=(0, 1e3), unit="m/s", doc="of the camera, in a random direction"
    )
    albedo: Interval = bounds(
        0.04, 0.09, limits=(0, 1), doc="geometric albedo at 550 nm, drawn for each grain; ice: up to 0.6"
    )
    phase_slope_mag_deg: float = number(
        0.047, limits=(0, 0.2), unit="mag/°", doc="fading with the phase angle; nucleus of 67P: 0.047"
    )
    diffraction: bool = flag(True, doc="whether small grains diffract sunlight forwards, beyond 90° of phase")
    reddening_per_100nm: float = number(
        0.11, limits=(-0.2, 1), doc="slope of the albedo over that at 550 nm; nucleus of 67P: 0.11 to 0.16; ice: 0"
    )
    least_noise: float = number(
        0.5, limits=(0.01, 1e4), doc="grains are left out whose mean light is below this fraction of the dark noise"
    )
    most_grains: int = number(
        2000, limits=(1, 20_000), integer=True, doc="in one image; of more the brightest stay"
    )
    mask_level_dn: float = mask_level()

    def validate(self) -> None:
        """Raise ValueError if the nearest grains are not nearer than the farthest."""
        if self.nearest_m >= self.farthest_m:
            raise ValueError(f"nearest_m = {self.nearest_m:g}: must be below farthest_m = {self.farthest_m:g}")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the drawn density and one list per property of the grains that show."""
        density = self.density_per_m3.uniform(rng)
        velocity = _random_direction(rng) * self.camera_speed_m_s.uniform(rng)
        up = context.up_C if context.up_C is not None else _random_direction(rng)
        grains = _Population(self, context, density=density, camera_velocity=velocity, up=up).drawn(rng)
        return {
            "density_per_m3": density,
            "reddening_per_100nm": float(self.reddening_per_100nm),
            "mask_level_dn": float(self.mask_level_dn),
            "count": len(grains.radius_mm),
            **{name: _rounded(values) for name, values in grains._asdict().items()},
        }

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons that the grains leave, plus those of their own light."""
        light = context.once(_light, params)
        if light is None:
            return quantity
        return quantity.with_array(times(quantity.array, light.passes) + light.added)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels where any channel gains `mask_level_dn`, or all lose that fraction, bool[y, x]."""
        light = context.once(_light, params)
        if light is None:
            return np.zeros(context.shape, dtype=bool)
        level = np.float32(params["mask_level_dn"] / 255)
        white = np.asarray(context.camera.detector.white_e, dtype=np.float32)
        return np.asarray(reaches(light.added, level * white) | (light.passes <= 1 - level))


def _with_default(key: str, default: Any) -> Any:
    """Return the declaration of a key of `_Particles` with another default."""
    return field(default=default, metadata=_Particles.__dataclass_fields__[key].metadata)


@dataclass(frozen=True, kw_only=True)
class ComaGrains(_Particles):
    """Add grains of the coma that the comet's gas carries past the camera: points, tracks and blurred discs."""

    model = "coma_grains"
    default = True
    after = "frozen_frame"


@dataclass(frozen=True, kw_only=True)
class Debris(_Particles):
    """Add a slow cloud close to the spacecraft, of what came off it: flakes, ice and dust, mostly out of focus."""

    model = "debris"

    # sizes and distances: Güttler et al. 2017; the others are assumed
    density_per_m3: Interval = _with_default("density_per_m3", Interval(0.003, 0.03))
    radius_mm: Interval = _with_default("radius_mm", Interval(0.3, 5.0))
    size_exponent: float = _with_default("size_exponent", 3.0)
    nearest_m: float = _with_default("nearest_m", 1.0)
    farthest_m: float = _with_default("farthest_m", 40.0)
    speed_m_s: Interval = _with_default("speed_m_s", Interval(0.01, 0.3))
    speed_exponent: float = _with_default("speed_exponent", 0.0)
    cone_deg: float = _with_default("cone_deg", 180.0)
    camera_speed_m_s: Interval = _with_default("camera_speed_m_s", Interval(0.0, 0.0))
    albedo: Interval = _with_default("albedo", Interval(0.05, 0.5))
    reddening_per_100nm: float = _with_default("reddening_per_100nm", 0.0)


# --- light -----------------------------------------------------------------------------------------------------


class _GrainLight(NamedTuple):
    """Hold what the grains do to the light.

    Attributes
    ----------
    added
        float32[y, x, channel]: electrons of the grains.
    passes
        float32[y, x]: fraction of the light behind them that passes between them.
    """

    added: F32
    passes: F32


class _Sunlight(NamedTuple):
    """Hold the Sun's light on the grains: band nodes, irradiance in the bands, and the Sun's direction in C."""

    wavelength_nm: F64
    irradiance: F64
    direction: F64 | None

    @classmethod
    def of(cls, context: FaultContext) -> _Sunlight:
        """Return the sunlight at the camera."""
        nodes, irradiance = context.sunlight
        direction = context.sun_direction_C if context.sun_direction_C is not None else context.sun_before_camera
        return cls(
            nodes,
            irradiance * context.sun_visible,
            None if direction is None else direction / np.linalg.norm(direction),
        )

    def reflected(self, reddening_per_100nm: float) -> F64:
        """Return the light of a reflector with an albedo of 1 at 550 nm, float64[band] in W m⁻² nm⁻¹."""
        rise = reddening_per_100nm * (self.wavelength_nm - _REFERENCE_NM) / 100
        return self.irradiance * np.maximum(1 + rise, 0)

    def total(self, reddening_per_100nm: float) -> float:
        """Return `reflected` summed over the bands, in W/m²; a single band covers 300 nm."""
        nodes = self.wavelength_nm
        edges = np.concatenate([nodes[:1], (nodes[1:] + nodes[:-1]) / 2, nodes[-1:]])
        width_nm = np.diff(edges) if len(nodes) > 1 else np.array([300.0])
        return float(self.reflected(reddening_per_100nm) @ width_nm)

    def phase_deg(self, towards: F64) -> F64:
        """Return the phase angles of grains in unit directions float64[n, 3]; 90° where the Sun is unknown."""
        if self.direction is None:
            return np.full(len(towards), 90.0)
        return np.degrees(np.arccos(np.clip(-towards @ self.direction, -1, 1)))


def phase_function(phase_deg: F64, slope_mag_deg: float) -> F64:
    """Return the light of a grain over that at a phase angle of 0, which fades by a slope in magnitudes."""
    return np.asarray(10 ** (-0.4 * slope_mag_deg * phase_deg))


def diffracted(radius_mm: F64, phase_deg: F64) -> F64:
    """Return the light that grains diffract over what a white disc of their size sends back: D of the module."""
    size = 2 * np.pi * radius_mm * 1e6 / _REFERENCE_NM
    angle = np.radians(180 - phase_deg)
    sine = np.sin(np.clip(angle, np.radians(_LEAST_DIFFRACTION_DEG), np.pi / 2))
    obliquity = ((1 + np.cos(angle)) / 2) ** 2
    return np.asarray(obliquity * np.minimum(1 / (np.pi * size * sine**3), size**2 / 4))


def _electrons_per_irradiance(context: FaultContext, sun: _Sunlight, reddening_per_100nm: float) -> F64:
    """Return the electrons for an irradiance of 1 W/m² of grains' light on a pixel, float64[channel]."""
    camera, total = context.camera, sun.total(reddening_per_100nm)
    shape = sun.reflected(reddening_per_100nm) / max(total, 1e-300)
    return np.asarray(camera.electron_rate_weights(sun.wavelength_nm) @ shape) * camera.exposure_s


def _pupil_per_pixel(context: FaultContext, slopes: F64) -> F64:
    """Return the sum of the irradiances of all pixels over that of a point source at the camera, float64[n].

    The power of a point is its irradiance times A cos θ. A lens whose image has no falloff images the scene
    brighter by 1 / cos⁴θ, and a grain with it, so that vignetting treats both alike.
    """
    camera = context.camera
    slope = np.hypot(slopes[:, 0], slopes[:, 1])
    cosine = 1 / np.sqrt(1 + slope**2)
    area = camera.lens.pupil_area_mm2(slope) * (cosine if camera.lens.falls_off else cosine**-3)
    return np.asarray(area / (camera.detector.pixel_pitch_um * 1e-3) ** 2)


def _light(params: Params, context: FaultContext) -> _GrainLight | None:
    """Return the light of the grains, after the lens's point spread; None without grains."""
    if not params["count"]:
        return None
    camera = context.camera
    grains = _GrainsInView(*(np.asarray(params[name], dtype=np.float64) for name in _GrainsInView._fields))
    slopes = np.column_stack([grains.slope_x, grains.slope_y])
    border = camera.lens.border_px
    streaks = _streaks(grains, context, pupil_support(context.frame, slopes, grains.depth_m)).moved(border, border)
    shape = context.shape[0] + 2 * border, context.shape[1] + 2 * border
    depth = None if context.depth_m is None else np.pad(context.depth_m, border, mode="edge")
    irradiance = grains.irradiance_W_m2 * _pupil_per_pixel(context, slopes)
    shadow_px2 = np.pi * _image_radius_px(grains, context) ** 2
    planes = drawn(streaks, np.stack([irradiance, shadow_px2]), shape, depth).astype(np.float32)
    light, covered = (camera.lens.spread(plane, _REFERENCE_NM) for plane in planes)
    electrons = _electrons_per_irradiance(context, _Sunlight.of(context), params["reddening_per_100nm"])
    return _GrainLight(
        added=np.maximum(light, 0)[..., None] * electrons.astype(np.float32),
        passes=np.clip(1 - covered, 0, 1).astype(np.float32),
    )


# --- grains ----------------------------------------------------------------------------------------------------


class _GrainsInView(NamedTuple):
    """Hold the grains, float64[n] each.

    `x_px` and `y_px` are the middles of their streaks, `dx_px` and `dy_px` the extents without the discs. `slope_x`
    and `slope_y` are the tangents of their directions in C, `distance_m` is measured from the camera and `depth_m`
    along the boresight. `blur_px` is the diameter of the blur circle of defocus.
    """

    x_px: F64
    y_px: F64
    dx_px: F64
    dy_px: F64
    blur_px: F64
    radius_mm: F64
    distance_m: F64
    depth_m: F64
    slope_x: F64
    slope_y: F64
    irradiance_W_m2: F64

    def select(self, keep: NDArray[Any]) -> _GrainsInView:
        """Return the grains that a mask, a slice or indices select."""
        return _GrainsInView(*(values[keep] for values in self))


def _image_radius_px(grains: _GrainsInView, context: FaultContext) -> F64:
    """Return the radius of the sharp image of each grain, float64[n]."""
    return np.asarray(grains.radius_mm * 1e-3 / grains.depth_m * context.camera.focal_length_px)


def _streaks(grains: _GrainsInView, context: FaultContext, support: F64 | None = None) -> Streaks:
    """Return the grains as figures on the frame, with outlines `support`.

    The radius has the mean square of defocus, grain and diffraction together; a disc of the radius r has r²/4 along
    each axis.
    """
    camera = context.camera
    diffraction_px = 2 * _DIFFRACTION * _REFERENCE_NM * 1e-3 * camera.lens.f_number / camera.detector.pixel_pitch_um
    if camera.lens.blurs:
        diffraction_px = 0.0  # it is in the point spread
    return Streaks(
        x_px=grains.x_px,
        y_px=grains.y_px,
        dx_px=grains.dx_px,
        dy_px=grains.dy_px,
        radius_px=np.sqrt((grains.blur_px / 2) ** 2 + _image_radius_px(grains, context) ** 2 + diffraction_px**2),
        depth_m=grains.depth_m,
        support=support,
    )


class _Population:
    """Draw the grains that show in one image.

    Grains are drawn from the volume in which a grain of their size can be bright enough at its brightest. Those
    that are too faint, beside the frame or behind the ground are then left out.
    """

    def __init__(
        self, fault: _Particles, context: FaultContext, *, density: float, camera_velocity: F64, up: F64
    ) -> None:
        self.fault, self.context = fault, context
        self.camera_velocity, self.up = camera_velocity, up
        camera = context.camera
        self.sun = _Sunlight.of(context)
        self.flux_W_m2 = self.sun.total(fault.reddening_per_100nm)
        self.electrons = float(_electrons_per_irradiance(context, self.sun, fault.reddening_per_100nm).max())
        dark_e = camera.detector.dark_current_e_s * camera.exposure_s
        self.least_e = fault.least_noise * float(np.sqrt(camera.detector.read_noise_e_rms**2 + dark_e))
        # edges of the frame
        projection = camera.projection
        height, width = context.shape
        edge = np.concatenate(
            [
                projection.directions_at(np.linspace(0, width, 65), np.array([0.0, height])).reshape(-1, 3),
                projection.directions_at(np.array([0.0, width]), np.linspace(0, height, 65)).reshape(-1, 3),
            ]
        )
        self.half = np.abs(slopes_of(edge)).max(axis=0)
        low, high = fault.radius_mm
        self.radius_mm = np.geomspace(low, max(high, low * (1 + 1e-9)), _RADII)
        number = (self.radius_mm / self.radius_mm[0]) ** (1 - fault.size_exponent)  # per step of log a
        self.bright = self._brightest_e_m2()  # float64[node]
        self._number, self._density, self._wanted_e = number, density, self.least_e
        self.mean = self._drawn_on_average()
        while self.mean > _MOST_DRAWN:
            self.least_e *= 1.5
            self.mean = self._drawn_on_average()

    def _drawn_on_average(self) -> float:
        """Return the mean number of grains to try with the limit `least_e`."""
        volume_m3 = np.sum(self._parts(self.radius_mm), axis=0)
        self.shown_below = _summed(self._number * volume_m3) / _summed(self._number)[-1]
        return float(self._density * self.shown_below[-1])

    def _speed(self, radius_mm: F64, at_1mm_m_s: F64 | float) -> F64:
        """Return the speeds of grains, in m/s."""
        return np.asarray(at_1mm_m_s * radius_mm**-self.fault.speed_exponent)

    def _reach_m(self, radius_mm: F64) -> F64:
        """Return how far beside the frame, in m, a grain may be and still draw into it."""
        camera = self.context.camera
        speed = self._speed(radius_mm, self.fault.speed_m_s.hi) + np.linalg.norm(self.camera_velocity)
        # a grain's slope changes by at most the speed times √(1 + slope²), over its depth; beside the frame the
        # slope is larger than in it by at most 1 along each axis
        largest = np.sqrt(1 + (np.hypot(*self.half) + 1.5) ** 2)
        moves = speed * camera.exposure_s / 2 * largest
        return np.asarray(moves + camera.lens.aperture_radius_m + radius_mm * 1e-3)

    def _brightest_e_m2(self) -> F64:
        """Return the most electrons of a grain in the frame, times (distance / radius)², for each node of radii."""
        fault = self.fault
        sides = (np.linspace(-1.2 * half, 1.2 * half, 33) for half in self.half)
        slopes = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        phase_deg = self.sun.phase_deg(_directions(slopes))
        reflected = fault.albedo.hi * float(phase_function(phase_deg, fault.phase_slope_mag_deg).max())
        light = np.full_like(self.radius_mm, reflected)
        if fault.diffraction:  # it rises with the phase angle; between two slopes this is larger than at both
            step_deg = float(np.degrees(np.hypot(*self.half)) * 2.4 / 32)
            light += diffracted(self.radius_mm, np.minimum(phase_deg.max() + step_deg, 180))
        pupil = float(_pupil_per_pixel(self.context, slopes).max())
        return np.asarray(self.flux_W_m2 * light * pupil * self.electrons)

    def _limits_m(self, radius_mm: F64) -> tuple[F64, F64]:
        """Return the smallest and largest depths of grains: as the fault's keys say, and as light and motion do."""
        fault, context = self.fault, self.context
        nearest, farthest = fault.nearest_m, fault.farthest_m
        if context.depth_m is not None:
            farthest = min(farthest, float(np.max(context.depth_m)))
        bright = np.interp(np.log(radius_mm), np.log(self.radius_mm), self.bright)
        shows = radius_mm * 1e-3 * np.sqrt(bright / self.least_e)
        low = np.maximum(nearest, self._reach_m(radius_mm))
        return low, np.maximum(np.minimum(farthest, shows), low)

    def _parts(self, radius_mm: F64) -> tuple[F64, F64, F64]:
        """Return the parts of the volume of grains of a size whose cross-section goes with Z², Z and 1.

        At the depth Z the volume is as wide and as high as the frame, and by the reach r wider on each side:
        (w Z + 2 r) (h Z + 2 r).
        """
        low, high = self._limits_m(radius_mm)
        width, height = 2 * self.half
        reach = self._reach_m(radius_mm)
        return (
            width * height * (high**3 - low**3) / 3,
            2 * reach * (width + height) * (high**2 - low**2) / 2,
            4 * reach**2 * (high - low),
        )

    def drawn(self, rng: np.random.Generator) -> _GrainsInView:
        """Return the grains that show: Poisson in number, but at least one where any can show."""
        none = self._candidates(0, rng)
        if self.mean < 1e-300 or self.electrons <= 0:
            return none
        for _ in range(int(np.clip(_MOST_DRAWN / max(self.mean, 1), 1, _ROUNDS))):
            for grains in self._experiments(rng):
                if len(grains.x_px):
                    return self._brightest(grains)
        if self.least_e > self._wanted_e:
            # the light of all is spread over so many pixels that none reaches the higher limit: any of them serve
            self.least_e = self._wanted_e
            self.mean = min(self._drawn_on_average(), _MOST_DRAWN)
            for grains in self._experiments(rng):
                return self._brightest(grains)
        return none

    def _brightest(self, grains: _GrainsInView) -> _GrainsInView:
        """Return at most `most_grains` grains, in their order."""
        brightest = np.argsort(-self._level_e(grains), kind="stable")
        return grains.select(np.sort(brightest[: int(self.fault.most_grains)]))

    def _experiments(self, rng: np.random.Generator) -> Iterator[_GrainsInView]:
        """Return the grains that show in independent draws of at least one candidate each, some at once if few."""
        experiments = int(np.clip(4096 / max(self.mean, 1), 1, 4096))
        counts = poisson_above_0(self.mean, rng.random(experiments))
        owner = np.repeat(np.arange(len(counts)), counts)
        shown, owners = [], []
        for start in range(0, len(owner), _DRAWN_AT_ONCE):
            of = owner[start : start + _DRAWN_AT_ONCE]
            grains = self._candidates(len(of), rng)
            keep = self._shows(grains)
            shown.append(grains.select(keep))
            owners.append(of[keep])
        whole = _GrainsInView(*(np.concatenate(column) for column in zip(*shown, strict=True)))
        of = np.concatenate(owners)
        for k in np.unique(of):
            yield whole.select(of == k)

    def _candidates(self, count: int, rng: np.random.Generator) -> _GrainsInView:
        """Return grains of the whole volume, each with its motion and its light."""
        fault, camera = self.fault, self.context.camera
        uniform = rng.random((8, count))
        # in proportion to the number of grains and the volume in which each can show
        below = self.shown_below
        radius_mm = np.exp(np.interp(uniform[0] * below[-1], below, np.log(self.radius_mm)))
        depth, reach = self._depths(radius_mm, uniform[1], uniform[2]), self._reach_m(radius_mm)
        edge = self.half[:, None] + reach / depth
        slope = (edge * (2 * uniform[3:5] - 1)).T
        towards = _directions(slope)
        speed = self._speed(radius_mm, fault.speed_m_s.lo + np.ptp(fault.speed_m_s) * uniform[5])
        heading = _in_cone(self.up, fault.cone_deg, uniform[6], uniform[7])
        velocity = heading * speed[:, None] - self.camera_velocity
        moved = (velocity[:, :2] - slope * velocity[:, 2:]) / depth[:, None] * camera.exposure_s
        first, last = (camera.projection.pixel_of(forward(slope + s * moved)) for s in (-0.5, 0.5))
        distance = depth * np.sqrt(1 + (slope**2).sum(axis=1))
        albedo = fault.albedo.uniform(rng, count)
        phase_deg = self.sun.phase_deg(towards)
        light = albedo * phase_function(phase_deg, fault.phase_slope_mag_deg)
        if fault.diffraction:
            light += diffracted(radius_mm, phase_deg)
        focus = abs(1 / depth - 1 / camera.lens.focus_distance_m)
        return _GrainsInView(
            x_px=(first[:, 0] + last[:, 0]) / 2,
            y_px=(first[:, 1] + last[:, 1]) / 2,
            dx_px=last[:, 0] - first[:, 0],
            dy_px=last[:, 1] - first[:, 1],
            blur_px=2 * camera.lens.aperture_radius_m * focus * camera.focal_length_px,
            radius_mm=radius_mm,
            distance_m=distance,
            depth_m=depth,
            slope_x=slope[:, 0],
            slope_y=slope[:, 1],
            irradiance_W_m2=self.flux_W_m2 * light * (radius_mm * 1e-3 / distance) ** 2,
        )

    def _depths(self, radius_mm: F64, uniform: F64, choice: F64) -> F64:
        """Return depths in m, in proportion to the cross-section of the volume there."""
        low, high = self._limits_m(radius_mm)
        parts = np.stack(self._parts(radius_mm))
        below = np.cumsum(parts, axis=0) / np.maximum(parts.sum(axis=0), 1e-300)
        power = 3.0 - (choice > below[:2]).sum(axis=0)
        return np.clip((low**power + uniform * (high**power - low**power)) ** (1 / power), low, high)

    def _shows(self, grains: _GrainsInView) -> NDArray[np.bool_]:
        """Return which grains are bright enough, reach the frame, and are not behind the ground, bool[n]."""
        first, last = inside(_streaks(grains, self.context), self.context.shape)
        keep = (self._level_e(grains) >= self.least_e) & (last > first)
        if self.context.depth_m is not None:
            height, width = self.context.shape
            column = np.clip(grains.x_px, 0, width - 1).astype(np.int64)
            row = np.clip(grains.y_px, 0, height - 1).astype(np.int64)
            keep &= self.context.depth_m[row, column] > grains.depth_m
        return np.asarray(keep)

    def _level_e(self, grains: _GrainsInView) -> F64:
        """Return the electrons of each grain, spread evenly over its figure of at least a pixel, float64[n]."""
        streaks = _streaks(grains, self.context)
        slopes = np.column_stack([grains.slope_x, grains.slope_y])
        electrons = grains.irradiance_W_m2 * _pupil_per_pixel(self.context, slopes) * self.electrons
        across = np.maximum(2 * streaks.radius_px, 1)
        return np.asarray(electrons / (np.maximum(np.pi / 4 * across**2, 1) + streaks.length_px * across))


def _directions(slopes: F64) -> F64:
    """Return unit vectors in C towards the tangents x/z and y/z, float64[n, 3]."""
    vectors = np.column_stack([slopes, np.ones(len(slopes))])
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _random_direction(rng: np.random.Generator) -> F64:
    """Return a unit vector in any direction, float64[3]."""
    return np.asarray(_in_cone(np.array([0.0, 0.0, 1.0]), 180.0, *rng.random((2, 1)))[0])


def _in_cone(axis: F64, half_angle_deg: float, height: F64, turn: F64) -> F64:
    """Return unit vectors evenly in a cone, float64[n, 3], from uniform numbers in [0, 1]."""
    cosine = 1 - height * (1 - np.cos(np.radians(half_angle_deg)))
    sine, angle = np.sqrt(np.maximum(1 - cosine**2, 0)), 2 * np.pi * turn
    z = axis / np.linalg.norm(axis)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.asarray(
        cosine[:, None] * z + (sine * np.cos(angle))[:, None] * x + (sine * np.sin(angle))[:, None] * y
    )


def _summed(values: F64) -> F64:
    """Return the sum of values up to each node by the trapezoidal rule, at equal steps; the first is 0."""
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2)])


def _rounded(values: F64) -> list[float]:
    """Return numbers with six digits, as plain data."""
    return [float(f"{value:.{_DIGITS}g}") for value in values.tolist()]
