"""From one planned sample to one labelled sample, in physical order.

    resolve ▶ render ▶ meter ▶ photograph ▶ label

One expensive render serves every twin: the picture with all faults, the clean one and `without_<fault>` share
radiance, exposure and noise, so they differ by the faults alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from . import config, frames, labels, photometry, plan, world
from .body import Body, Patch, Site, cached_patch, choose_sites
from .body.refine import GROWTH_POWER
from .camera import Camera
from .config import SceneConfig
from .detector import Noise
from .errors import InputError
from .faults import Fault, FaultContext, Params, dataset_order, from_dict, physical_order
from .lens import RealLens
from .quantities import BODY, RGBI, SKY, Electrons, Radiance, Sample, Truth
from .scene import Scene, Sunlight, View
from .spacecraft import SpacecraftMesh

if TYPE_CHECKING:
    from .render import Surface

F64 = NDArray[np.float64]

_RESOLVE_BATCH = 8
_DRAW_TRIES = 8
# The metered exposure stays within these factors of what a facet lit at 45 degrees would be given, so that a
# sliver of grazing light does not turn the frame into noise.
_METERING_RANGE = (0.25, 8.0)
# A step's own change of this many DN survives every later optical step of the paper's tables (cos⁴ at 255 → 105
# keeps 41 %), so the fault needs no full comparison to be called present.
_CLEARLY_VISIBLE_DN = 6.0
# Of the full well: what counts as lit where noise of sampling is judged.
_LIT = 0.01
# Share of the lit pixels that may keep more noise of sampling than the scene allows.
_FEW = 0.01
# Slope an octave of the finest relief: steeper would be a wall of needles.
_STEEPEST_DETAIL = 0.12
_ANGLE_LAYERS = {"incidence_deg", "emission_deg", "phase_deg", "albedo"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """A site with its patch and the renderer's copy of it, and the spacecraft above it, if there is one."""

    body: Body
    site: Site
    surface: Surface
    vehicle: SpacecraftMesh | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """The outcome of `resolve`: where the camera and the Sun are. `tries` counts the proposals drawn."""

    position_L_m: F64
    L_from_C: F64
    sun_L: F64
    sun_azimuth_deg: float
    sun_elevation_deg: float
    sun_visible_fraction: float
    tries: int
    resolved: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleSpec:
    """One sample of a plan, with all that `simulate` needs."""

    index: int
    scene: SceneConfig
    plan: plan.Plan
    faults: Mapping[str, Fault]
    terrain: Terrain

    @property
    def seed(self) -> int:
        return self.scene.dataset.seed

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """The generator of this sample for (stage, name)."""
        return config.rng(self.seed, self.index, stage, name)


@dataclass(kw_only=True, eq=False)
class Frame:
    """What the stages add to, one after the other."""

    spec: SampleSpec
    pose: Pose = field(init=False)
    camera: Camera = field(init=False)
    sunlight: Sunlight = field(init=False)
    radiance: Radiance = field(init=False)
    # what was rendered and where it shows open sky, guard band included, where the picture has another grid
    rendered: Radiance | None = None
    open_sky: NDArray[np.bool_] | None = None
    truth: Truth = field(init=False)
    context: FaultContext = field(init=False)
    rate: Electrons = field(init=False)
    drawn: dict[str, Params] = field(default_factory=dict)
    rejected: list[Params] = field(default_factory=list)
    images: dict[str, RGBI] = field(default_factory=dict)
    signals: dict[Any, Electrons] = field(default_factory=dict)
    pictures: dict[Any, RGBI] = field(default_factory=dict)
    samples_per_pixel: float = float("nan")
    noise_fraction_p99: float = float("nan")
    mask: NDArray[np.bool_] = field(init=False)
    effects: dict[str, NDArray[np.bool_]] = field(default_factory=dict)


def simulate(spec: SampleSpec) -> Sample:
    """One finished sample, every stage in order."""
    return to_sample(develop_frame(spec))


def develop_frame(spec: SampleSpec) -> Frame:
    """All stages, everything between radiance and labels kept."""
    frame = Frame(spec=spec)
    for stage in STAGES:
        stage(frame)
    return frame


# --- resolve -----------------------------------------------------------------------------------------------


def resolve(frame: Frame) -> None:
    """Settle height and Sun elevation against the terrain, by keyed tries of the proposal.

    A try is accepted when nothing lies within the clearance, when the spacecraft does not reach into the ground,
    when a Sun-averted camera does not look at the Sun and when a straylight sample sees the whole of it. If none
    is, the last clear one is taken. A spacecraft that SPICE places stays where it is.
    """
    from . import render

    spec = frame.spec
    if spec.scene.spice.spacecraft:
        frame.pose = _on_the_way(spec)
        return
    scene, i = spec.scene, spec.index
    samples, stratum = np.full(1, i), spec.plan.stratum[i : i + 1]
    fixed = {name: float(values[i]) for name, values in spec.plan.variables.items()}
    geometry = scene.geometry
    start = max(300.0, 2 * float(np.hypot(fixed["x_m"], fixed["y_m"])))
    surface = spec.terrain.surface
    ground = float(render.ground_height_m(surface, np.array([fixed["x_m"]]), np.array([fixed["y_m"]]), start)[0])
    needs_sun = bool(spec.plan.injects(plan.STRAYLIGHT)[i])
    least = plan.least_sun_angle_deg(scene)
    fallback: Pose | None = None
    for first in range(0, geometry.max_tries, _RESOLVE_BATCH):
        attempts = range(first, min(first + _RESOLVE_BATCH, geometry.max_tries))
        tries = [
            plan.propose(scene, samples, stratum, ("sun_elevation_deg", "height_m"), attempt)
            for attempt in attempts
        ]
        # the first try is the proposal itself, and a batch has a fixed size: one kernel for all
        elevation = np.array([float(t["sun_elevation_deg"][0]) for t in tries])
        height = np.array([float(t["height_m"][0]) for t in tries])
        position = np.column_stack(
            [np.full(len(tries), fixed["x_m"]), np.full(len(tries), fixed["y_m"]), -(ground + height)]
        )
        suns = [world.sunlight(scene, frames.direction_L(fixed["sun_azimuth_deg"], e)) for e in elevation]
        clear = render.is_clear(surface, position, geometry.clearance_m)
        visible = render.sun_visible_fraction(surface, position, suns)
        for k, attempt in enumerate(attempts):
            axes = _attitude(scene, int(stratum[0]), suns[k].direction_L, fixed)
            angle = np.degrees(np.arccos(np.clip(axes[:, 2] @ suns[k].direction_L, -1, 1)))
            averted_ok = stratum[0] != plan.SUN_AVERTED or angle >= least
            vehicle = spec.terrain.vehicle
            if vehicle is not None:
                if vehicle.blocked((axes.T @ suns[k].direction_L)[None])[0]:
                    visible[k] = 0.0
                if clear[k]:
                    parts = position[k] + vehicle.outline_B_m @ axes.T
                    clear[k] = not render.is_between(surface, position[k], parts)
            good = bool(clear[k] and averted_ok and (not needs_sun or visible[k] == 1.0))
            pose = Pose(
                position_L_m=position[k],
                L_from_C=axes,
                sun_L=suns[k].direction_L,
                sun_azimuth_deg=fixed["sun_azimuth_deg"],
                sun_elevation_deg=float(elevation[k]),
                sun_visible_fraction=float(visible[k]),
                tries=attempt + 1,
                resolved=good,
            )
            if good:
                frame.pose = pose
                return
            if fallback is None or clear[k]:
                fallback = pose
    assert fallback is not None
    frame.pose = replace(fallback, tries=geometry.max_tries)


def _on_the_way(spec: SampleSpec) -> Pose:
    """Camera and Sun where SPICE has them at the sample's epoch, which is its scene's."""
    from . import render

    scene, site, surface = spec.scene, spec.terrain.site, spec.terrain.surface
    placed = world.spacecraft_pose(scene, scene.sun.julian_date)
    sun_J_au, T_from_J = world.ephemeris(scene)
    L_from_T = site.T_from_L.T
    position = L_from_T @ (placed.camera_position_T_m - site.position_T_m)
    axes, sun_L = L_from_T @ placed.T_from_C, L_from_T @ T_from_J @ frames.unit(sun_J_au)
    visible = float(render.sun_visible_fraction(surface, position[None], [world.sunlight(scene, sun_L)])[0])
    if spec.terrain.vehicle is not None and spec.terrain.vehicle.blocked((axes.T @ sun_L)[None])[0]:
        visible = 0.0
    azimuth, elevation = frames.azimuth_elevation_deg(sun_L)
    clear = bool(render.is_clear(surface, position[None], scene.geometry.clearance_m)[0])
    return Pose(
        position_L_m=position,
        L_from_C=axes,
        sun_L=sun_L,
        sun_azimuth_deg=azimuth,
        sun_elevation_deg=elevation,
        sun_visible_fraction=visible,
        tries=1,
        resolved=clear and (visible == 1.0 or not spec.plan.injects(plan.STRAYLIGHT)[spec.index]),
    )


def _attitude(scene: SceneConfig, stratum: int, sun_L: F64, fixed: Mapping[str, float]) -> F64:
    down = np.array([0.0, 0.0, 1.0])
    reference = sun_L if plan.strata(scene)[stratum].reference == "sun" else down
    return frames.L_from_C(reference, fixed["roll_deg"], fixed["pitch_deg"], fixed["yaw_deg"])


# --- render ------------------------------------------------------------------------------------------------


def describe(frame: Frame) -> Scene:
    """The sample as the renderer takes it."""
    spec, camera = frame.spec, frame.camera
    scene = spec.scene
    guard_x, guard_y = camera.guard_px
    view = View(
        position_L_m=frame.pose.position_L_m,
        L_from_C=frame.pose.L_from_C,
        intrinsics=camera.intrinsics + np.array([0, 0, guard_x, guard_y]),
        width_px=camera.width_px + 2 * guard_x,
        height_px=camera.height_px + 2 * guard_y,
        aperture_radius_m=camera.lens.aperture_radius_m,
        focus_distance_m=camera.lens.focus_distance_m,
    )
    wavelength = world.wavelengths_nm(scene)
    return Scene(
        view=view,
        sun=frame.sunlight,
        wavelength_nm=wavelength,
        photometry=world.photometric_model(scene),
        dust_contrast=world.dust_contrast(scene),
        bounces=scene.render.bounces,
        samples_per_pixel=scene.render.samples_per_pixel,
        key=int(spec.rng("render", "jitter").integers(2**32)),
    )


def render_frame(frame: Frame) -> None:
    """Radiance of every band, and truth.

    The renderer knows pinhole cameras only. Behind a prescription `rendered` is what it gives, guard band included;
    `radiance` is the same on the picture's own grid, distorted, before any of it is lost or blurred, and truth is
    that of the rendered pixel nearest to what a pixel's centre sees, less than a pixel away.
    """
    from . import render

    spec, i = frame.spec, frame.spec.index
    frame.camera = world.base_camera(
        spec.scene,
        architecture=int(spec.plan.architecture[i]),
        readout_direction=int(spec.plan.readout_direction[i]),
    )
    frame.sunlight = world.sunlight(spec.scene, frame.pose.sun_L)
    frame.samples_per_pixel = float(spec.scene.render.samples_per_pixel)
    scene = describe(frame)
    surface = spec.terrain.surface
    angles = bool(_ANGLE_LAYERS & set(spec.scene.dataset.layers))
    guide = render.truth(surface, scene.view, scene.sun, angles=angles)
    lens = frame.camera.lens
    frame.truth = guide
    if isinstance(lens, RealLens):
        frame.truth, frame.open_sky = _at_pixels(guide, lens.nearest_pixels), guide.semantic == SKY
    if spec.scene.render.noise_fraction is None:
        _keep(frame, render.radiance(surface, scene, guide))
    else:
        _render_to_the_noise(frame, scene, guide, spec.scene.render.noise_fraction)


def _keep(frame: Frame, radiance: Radiance) -> None:
    """Radiance as rendered, on whose grid the lens acts, and as the picture has it."""
    lens = frame.camera.lens
    if isinstance(lens, RealLens):
        frame.rendered, radiance = radiance, lens.on_frame(radiance)
    frame.radiance = radiance


def _imaged(frame: Frame) -> Radiance:
    """What the lens takes."""
    return frame.radiance if frame.rendered is None else frame.rendered


def _at_pixels(truth: Truth, pixels: NDArray[np.int32]) -> Truth:
    """The truth of pixels by their number, on the grid of those numbers."""
    layers = {name: getattr(truth, name) for name in truth.__dataclass_fields__}
    flat = {name: a.reshape(-1, *a.shape[2:]) for name, a in layers.items() if a is not None}
    return replace(truth, **{name: a[pixels] for name, a in flat.items()})


def _render_to_the_noise(frame: Frame, scene: Scene, guide: Truth, fraction: float) -> None:
    """Render with more samples where chance would show: up to `fraction` of the sensor's own noise.

    The error of a pixel is judged by two halves of its samples, over 3×3 pixels; those that err too much are
    rendered again with four times as many, and so on, until at most 1 % of the lit pixels are left or the scene's
    limit is reached. All of it follows from scene and sample, so the bits do not depend on how a build runs.
    """
    from . import render

    surface, settings = frame.spec.terrain.surface, frame.spec.scene.render
    lens_and_sensor = _green_per_second(frame)
    found, halves = render.direct(surface, scene, lens_and_sensor)
    array = found.array.copy()
    once_more = render.indirect(surface, scene, guide) if scene.bounces else np.zeros_like(array)
    whole = found.with_array(array + once_more)
    exposure = _exposure_s(frame, _rate(frame, whole))
    error_e = np.abs(halves) * exposure
    signal_e = np.einsum("b,byx->yx", lens_and_sensor * exposure, whole.array)
    detector = frame.camera.detector
    sensor_e2 = signal_e + detector.dark_current_e_s * exposure + detector.read_noise_e_rms**2
    # neither what is hardly lit nor what saturates shows this noise; the latter is lit all the same
    lit = signal_e > _LIT * detector.full_well_e
    shows = lit & (signal_e - 4 * error_e < detector.full_well_e)
    worth = cv2.dilate(shows.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    spent = np.full(error_e.shape, scene.samples_per_pixel, dtype=np.int32)
    while True:
        # of nine pixels, each as if it had this one's samples: along an edge variance falls as their number^-3/2
        each = np.where(worth, error_e**2 / sensor_e2, 0) * spent**1.5
        share = np.sqrt(np.maximum(cv2.blur(each, (3, 3)), 0) / spent**1.5)
        noisy = (share > fraction) & worth & (4 * spent <= settings.max_samples_per_pixel)
        share[~shows] = 0
        if np.count_nonzero(share[lit] > fraction) <= _FEW * np.count_nonzero(lit) or not noisy.any():
            break
        for samples in np.unique(spent[noisy]):
            chosen = np.flatnonzero(noisy & (spent == samples)).astype(np.uint32)
            # samples of their own: the first ones chose the pixel, and a lucky choice would be a bias
            key = (scene.key + 4 * int(samples)) & 0xFFFFFFFF
            again = replace(scene, samples_per_pixel=4 * int(samples), key=key)
            more, halves = render.direct(surface, again, lens_and_sensor, chosen)
            array.reshape(len(array), -1)[:, chosen] = more.array[:, 0]
            error_e.ravel()[chosen] = np.abs(halves[0]) * exposure
        spent[noisy] *= 4
    _keep(frame, found.with_array(array + once_more))
    frame.samples_per_pixel = float(spent.mean())
    frame.noise_fraction_p99 = float(np.percentile(share[lit], 99)) if lit.any() else 0.0


def _green_per_second(frame: Frame) -> F64:
    """Electrons per second of the green pixels for a unit of radiance in each band, float64[band]."""
    nodes = world.wavelengths_nm(frame.spec.scene)
    unit = Radiance(array=np.eye(len(nodes), dtype=np.float32)[:, :, None], wavelength_nm=nodes)
    return np.asarray(_rate_on_axis(frame, unit).array[:, 0, 1], dtype=np.float64)


# --- meter -------------------------------------------------------------------------------------------------


def meter(frame: Frame) -> None:
    """Exposure: fixed, or metered once on the noise-free, fault-free frame; all twins share it."""
    frame.rate = _rate(frame, _imaged(frame))
    frame.camera = replace(frame.camera, exposure_s=_exposure_s(frame, frame.rate))
    _add_stars(frame)
    direction_C = frame.pose.L_from_C.T @ frame.pose.sun_L
    frame.context = FaultContext(
        camera=frame.camera,
        sun_xy_px=frame.camera.project(direction_C),
        sun_direction_C=direction_C,
        sun_irradiance_W_m2_nm=frame.sunlight.irradiance_W_m2_nm,
        wavelength_nm=frame.radiance.wavelength_nm,
        sun_angular_radius_rad=frame.sunlight.angular_radius_rad,
        sun_visible_fraction=frame.pose.sun_visible_fraction,
    )


def _exposure_s(frame: Frame, rate: Electrons) -> float:
    fixed = frame.spec.scene.camera.exposure_s
    return _metered_exposure_s(frame, rate) if fixed == "auto" else float(fixed)


def _add_stars(frame: Frame) -> None:
    """Stars after metering: no exposure is made for them."""
    scene, truth = frame.spec.scene, frame.truth
    if scene.sky.stars == "off":
        return
    T_from_L = frame.spec.terrain.site.T_from_L
    T_from_J = world.target_attitude(scene, T_from_L @ frame.pose.sun_L)
    J_from_C = T_from_J.T @ T_from_L @ frame.pose.L_from_C
    before = _imaged(frame)
    if frame.open_sky is None:
        starry = world.with_stars(scene, before, frame.camera, J_from_C, truth.semantic == SKY)
    else:
        starry = world.with_stars(scene, before, frame.camera, J_from_C, frame.open_sky, describe(frame).view)
    if starry is not before:
        _keep(frame, starry)
        frame.rate = _rate(frame, starry)


def _metered_exposure_s(frame: Frame, rate: Electrons) -> float:
    settings, scene = frame.spec.scene.camera, frame.spec.scene
    # as a facet whose normal is 45 degrees from the Sun would be exposed
    half = np.sqrt(0.5)
    lit = photometry.radiance_factor(world.photometric_model(scene), [0, half, half], [half, 0, half])[:, 0] / np.pi
    facet = (lit * frame.sunlight.irradiance_W_m2_nm).astype(np.float32).reshape(-1, 1, 1)
    wavelength = world.wavelengths_nm(scene)
    per_second = _rate_on_axis(frame, Radiance(array=facet, wavelength_nm=wavelength))
    facet_brightness = float(_brightness(per_second.array, per_second.white_e).max())
    reference = settings.metering_level / max(facet_brightness, 1e-30)
    # every other pixel each way is sample enough for a percentile
    body = frame.truth.semantic[::2, ::2] == BODY
    shown = _brightness(rate.array[::2, ::2], rate.white_e)[body]
    shown = shown[shown > 0.02 / reference]  # sunlit: above a fiftieth of the reference facet
    exposure = reference
    if len(shown) >= 64:
        metered = settings.metering_level / float(np.percentile(shown, settings.metering_percentile))
        low, high = _METERING_RANGE
        exposure = float(np.clip(metered, low * reference, high * reference))
    return float(np.clip(exposure, settings.exposure_min_s, settings.exposure_max_s))


def _brightness(electrons: NDArray[np.float32], white_e: NDArray[np.float32]) -> NDArray[np.float32]:
    """Greatest of R, G, B per pixel as a fraction of white, float32[y, x]."""
    r, g, b = np.moveaxis(electrons / white_e, -1, 0)
    return np.asarray(np.maximum(np.maximum(r, g), b))


def _rate(frame: Frame, radiance: Radiance) -> Electrons:
    """Expected electrons after one second."""
    camera = frame.camera
    return camera.detector.electrons_expected(camera.lens.image(radiance), 1.0)


def _rate_on_axis(frame: Frame, radiance: Radiance) -> Electrons:
    """Expected electrons after one second of radiance of any shape, as if all of it were seen along the axis."""
    lens = frame.camera.lens
    irradiance = lens.on_axis(radiance) if isinstance(lens, RealLens) else lens.image(radiance)
    return frame.camera.detector.electrons_expected(irradiance, 1.0)


# --- photograph --------------------------------------------------------------------------------------------


def photograph(frame: Frame) -> None:
    """Draw the commanded faults and take the pictures: `clean`, `image` and the twins the scene asks for.

    A drawn fault that does not show is drawn again a few times, then left out, so that `frame.drawn` holds what
    is in the pixels and labels never claim more.
    """
    spec = frame.spec
    commanded = [name for name in spec.faults if spec.plan.injects(name)[spec.index]]
    if not frame.pose.resolved:
        commanded = [name for name in commanded if not spec.faults[name].needs_sun]
    # noise and the clean picture need one core, the faults' optics another
    undisturbed = _signal(frame, {}, [])
    with ThreadPoolExecutor(1) as aside:
        exposed = aside.submit(_expose_clean, frame, undisturbed)
        _draw(frame, commanded, attempt=0)
        optical = _in_order(frame, frame.drawn, "electrons")
        _signal(frame, frame.drawn, optical)
        for name in [n for n in optical if spec.faults[n].effect_mask]:
            _signal(frame, frame.drawn, [n for n in optical if n != name])
        noise, frame.images["clean"] = exposed.result()
    frame.pictures[frame.camera, (), False] = frame.images["clean"]
    for attempt in range(1, _DRAW_TRIES + 1):
        invisible = _invisible(frame, noise)
        # the rejected are kept, or a new draw could take over the identity of an old one
        frame.rejected += [frame.drawn.pop(name) for name in invisible]
        if not invisible or attempt == _DRAW_TRIES:
            break
        _draw(frame, commanded, attempt)
    frame.images["image"] = _develop(frame, frame.drawn, noise)
    twins = [layer for layer in stored_layers(spec.scene, spec.faults) if layer.startswith("without_")]
    for layer in twins:
        name = layer.removeprefix("without_")
        if name in frame.drawn:
            frame.images[layer] = _develop(frame, _but(frame.drawn, name), noise)
        else:
            frame.images[layer] = frame.images["image"]


def _expose_clean(frame: Frame, signal: Electrons) -> tuple[Noise, RGBI]:
    spec, camera = frame.spec, frame.camera
    noise = Noise.draw(frame.context.shape, spec.rng("detector", "shot"), spec.rng("detector", "read"))
    return noise, camera.detector.develop(signal, camera.exposure_s, noise)


def _draw(frame: Frame, commanded: Sequence[str], attempt: int) -> None:
    """Draw the commanded faults that are not drawn yet."""
    for name in commanded:
        if name not in frame.drawn:
            generator = frame.spec.rng("fault", f"{name}/{attempt}")
            frame.drawn[name] = frame.spec.faults[name].draw(frame.context, generator)


def _but(drawn: Mapping[str, Params], left_out: str) -> dict[str, Params]:
    return {name: params for name, params in drawn.items() if name != left_out}


def _in_order(frame: Frame, drawn: Mapping[str, Params], step: str) -> list[str]:
    return [name for name in physical_order(drawn) if frame.spec.faults[name].step == step]


def _altered(frame: Frame, drawn: Mapping[str, Params]) -> Camera:
    """The camera as the drawn faults alter it."""
    camera = frame.camera
    for name in physical_order(drawn):
        camera = frame.spec.faults[name].alter(camera, drawn[name])
    return camera


def _key(drawn: Mapping[str, Params], names: Sequence[str]) -> tuple[tuple[str, int], ...]:
    return tuple((name, id(drawn[name])) for name in names)


def _signal(frame: Frame, drawn: Mapping[str, Params], names: Sequence[str]) -> Electrons:
    """Expected electrons with the optical faults `names`, of those drawn; twins share what they have in common."""
    camera = _altered(frame, drawn)
    if camera != frame.camera:
        cached: dict[Any, Electrons] = {}  # another instrument: not to be mixed with the others
    else:
        cached = frame.signals
    key = _key(drawn, names)
    if key not in cached:
        if names:
            *before, last = names
            signal = _signal(frame, drawn, before)
            cached[key] = frame.spec.faults[last].apply(signal, drawn[last], frame.context)
        else:
            if camera == frame.camera:
                signal = frame.rate.with_array(frame.rate.array * np.float32(camera.exposure_s))
            else:
                signal = camera.detector.electrons_expected(camera.lens.image(_imaged(frame)), camera.exposure_s)
            cached[key] = signal
    return cached[key]


def _develop(frame: Frame, drawn: Mapping[str, Params], noise: Noise | None) -> RGBI:
    """The finished picture with the faults `drawn`; noise-free without `noise`."""
    optical = _in_order(frame, drawn, "electrons")
    camera = _altered(frame, drawn)
    key = (camera, _key(drawn, optical), noise is None)
    if key not in frame.pictures:
        signal = _signal(frame, drawn, optical)
        frame.pictures[key] = camera.detector.develop(signal, camera.exposure_s, noise)
    return _read_out(frame, frame.pictures[key], drawn)


def _read_out(frame: Frame, picture: RGBI, drawn: Mapping[str, Params]) -> RGBI:
    """The picture with the drawn readout faults."""
    for name in _in_order(frame, drawn, "rgbi"):
        picture = frame.spec.faults[name].apply(picture, drawn[name], frame.context)
    return picture


def _invisible(frame: Frame, noise: Noise) -> list[str]:
    """Drawn faults without any effect on the noise-free picture."""
    doubtful = sorted(_doubtful(frame, noise))
    return [n for n in doubtful if not (_shows_on_some_rows(frame, n) or effect_of(frame, n).any())]


def _shows_on_some_rows(frame: Frame, name: str) -> bool:
    """Whether every eighth row of the noise-free picture is enough to see an optical fault."""
    faults, drawn = frame.spec.faults, frame.drawn
    optical, readout = (_in_order(frame, drawn, step) for step in ("electrons", "rgbi"))
    if name not in optical or _altered(frame, drawn) != frame.camera:
        return False
    rows = slice(frame.context.shape[0] // 32, None, 8)
    detector, exposure = frame.camera.detector, frame.camera.exposure_s
    pictures = []
    for names in (optical, [n for n in optical if n != name]):
        signal = _signal(frame, drawn, names)
        some = signal.with_array(np.ascontiguousarray(signal.array[rows]))
        pictures.append(detector.develop(some, exposure, None).array)
    seen = labels.effect(*pictures)
    for other in readout:
        over = faults[other].footprint(drawn[other], frame.context)
        if over is not None:
            seen &= ~over[rows]
    return bool(seen.any())


def effect_of(frame: Frame, name: str) -> NDArray[np.bool_]:
    """bool[y, x]: where the noise-free picture changes when one of the drawn faults is switched off."""
    drawn, others = frame.drawn, _but(frame.drawn, name)
    optical = _in_order(frame, drawn, "electrons")
    if name not in optical or _altered(frame, drawn) != frame.camera:
        return labels.effect(_develop(frame, drawn, None).array, _develop(frame, others, None).array)
    # only rows whose signal changes can change: the others need not be developed
    signals = [_signal(frame, d, [n for n in optical if n in d]) for d in (drawn, others)]
    height = frame.context.shape[0]
    changed = np.flatnonzero((signals[0].array != signals[1].array).reshape(height, -1).any(axis=1))
    if not len(changed):
        return np.zeros(frame.context.shape, dtype=bool)
    # with a margin: a broken pixel's neighbours look two pixels far
    rows = slice(max(changed[0] - 2, 0), changed[-1] + 3)
    pictures = []
    for signal in signals:
        part = frame.camera.detector.develop(signal.with_array(signal.array[rows]), frame.camera.exposure_s, None)
        whole = np.zeros((*frame.context.shape, 4), dtype=np.uint8)
        whole[rows] = part.array
        pictures.append(_read_out(frame, RGBI(array=whole), others).array)
    return labels.effect(*pictures)


def _doubtful(frame: Frame, noise: Noise) -> set[str]:
    """Drawn faults that a cheap look does not show to be plainly visible."""
    faults, drawn = frame.spec.faults, frame.drawn
    if _altered(frame, drawn) != frame.camera:
        return set(drawn)
    out = {name for name in drawn if faults[name].effect_mask}
    optical, readout = (_in_order(frame, drawn, step) for step in ("electrons", "rgbi"))
    # pixels enough to see what is plainly visible; the rest of the doubt is settled by `effect_of`
    some = (slice(frame.context.shape[0] // 32, None, 16), slice(None, None, 4))
    for k, name in enumerate(optical):
        a, b = (
            np.minimum(q.array[some], q.white_e) * (255 / q.white_e)
            for q in (_signal(frame, drawn, optical[:k]), _signal(frame, drawn, optical[: k + 1]))
        )
        if np.abs(b - a).max(initial=0) < _CLEARLY_VISIBLE_DN:
            out.add(name)
    picture = _develop(frame, {name: drawn[name] for name in optical}, noise)
    touched = []
    for name in readout:
        after = faults[name].apply(picture, drawn[name], frame.context)
        where = np.flatnonzero(labels.effect(after.array, picture.array))
        a, b = (q.array.reshape(-1, 4)[where].astype(np.int16) for q in (picture, after))
        touched.append((name, where[(np.abs(b - a) >= _CLEARLY_VISIBLE_DN).any(axis=1)]))
        picture = after
    overwritten = np.zeros(frame.context.shape[0] * frame.context.shape[1], dtype=bool)
    for name, where in reversed(touched):  # what a later fault overwrites does not count
        if overwritten[where].all():
            out.add(name)
        overwritten[where] = True
    return out


# --- label -------------------------------------------------------------------------------------------------


def label(frame: Frame) -> None:
    """Masks of every class, by footprint or by effect."""
    spec = frame.spec
    wanted = stored_layers(spec.scene, spec.faults)
    frame.effects = {
        name: effect_of(frame, name)
        for name in frame.drawn
        if spec.faults[name].effect_mask or "mask_effect" in wanted
    }
    frame.mask = labels.mask_layers(spec.faults, frame.drawn, frame.context, frame.effects)


# The stages, in physical order.
STAGES = (resolve, render_frame, meter, photograph, label)


def to_sample(frame: Frame) -> Sample:
    """The layers and scalars of the dataset, by the names of its arrays."""
    spec, pose, i = frame.spec, frame.pose, frame.spec.index
    site = spec.terrain.site
    names = list(spec.faults)
    available: dict[str, Any] = {
        "depth_m": frame.truth.depth_m,
        "normal": frame.truth.normal,
        "semantic": frame.truth.semantic,
        "incidence_deg": frame.truth.incidence_deg,
        "emission_deg": frame.truth.emission_deg,
        "phase_deg": frame.truth.phase_deg,
    }
    layers = {
        "image": frame.images["image"].array,
        "clean": frame.images["clean"].array,
        "mask": frame.mask,
        "mask_any": labels.union(frame.mask, names, mask_any_faults(spec.scene, spec.faults)),
    }
    for name in stored_layers(spec.scene, spec.faults):
        if name.startswith("without_"):
            layers[name] = frame.images[name].array
        elif name == "mask_effect":
            empty = np.zeros(frame.context.shape, dtype=bool)
            layers[name] = np.stack([frame.effects.get(f, empty) for f in names])
        elif name == "radiance":
            layers[name] = frame.radiance.array
        elif name == "albedo" and frame.truth.dust is not None:
            layers[name] = world.normal_albedo(spec.scene, frame.truth.dust)
        elif name == "point_T_m":
            layers[name] = _points_T_m(frame)
        elif name in available:
            layers[name] = available[name]
    T_from_L = site.T_from_L
    T_from_C = T_from_L @ pose.L_from_C
    sun_T = T_from_L @ pose.sun_L
    sun_xy = frame.context.sun_xy_px
    fixed = {name: float(values[i]) for name, values in spec.plan.variables.items()}
    angles = fixed["roll_deg"], fixed["pitch_deg"], fixed["yaw_deg"]
    if spec.scene.spice.spacecraft:
        angles = frames.roll_pitch_yaw_deg(pose.sun_L, pose.L_from_C)
    scalars: dict[str, Any] = {
        "injected": np.array([name in frame.drawn for name in names]),
        "camera_position_T_m": site.position_T_m + T_from_L @ pose.position_L_m,
        "position_L_m": pose.position_L_m,
        "camera_from_T": frames.quaternion(T_from_C.T),
        "T_from_L": T_from_L,
        "T_from_J": world.target_attitude(spec.scene, sun_T),
        "site_T_m": site.position_T_m,
        "sun_direction_T": sun_T,
        "sun_distance_au": world.sun_distance_au(spec.scene),
        "julian_date": spec.scene.sun.julian_date,
        "intrinsics": frame.camera.intrinsics,
        "distortion": frame.camera.distortion,
        "sun_azimuth_deg": pose.sun_azimuth_deg,
        "sun_elevation_deg": pose.sun_elevation_deg,
        "roll_deg": angles[0],
        "pitch_deg": angles[1],
        "yaw_deg": angles[2],
        "sun_xy_px": np.full(2, np.nan) if sun_xy is None else sun_xy,
        "sun_visible_fraction": pose.sun_visible_fraction,
        "exposure_s": frame.camera.exposure_s,
        "samples_per_pixel": frame.samples_per_pixel,
        "noise_fraction_p99": frame.noise_fraction_p99,
        "tries": pose.tries + int(spec.plan.attitude_tries[i]) - 1,
        "stratum": int(spec.plan.stratum[i]),
        "site": int(spec.plan.site[i]),
        "lens": 0,
        "detector_individual": 0,
        "split": int(spec.plan.split[i]),
        "parameters": {
            name: {"model": spec.faults[name].model, **params} for name, params in sorted(frame.drawn.items())
        },
        "proposal": proposal(spec.scene, spec.plan, i),
    }
    return Sample(index=i, layers=layers, scalars=scalars)


def _points_T_m(frame: Frame) -> F64:
    """Surface points that truth belongs to, of the pixel centres, in T, float64[y, x, 3] metres, NaN on the sky."""
    fx, fy, cx, cy = frame.camera.intrinsics
    height, width = frame.context.shape
    rows, columns = np.ogrid[:height, :width]
    lens, (guard_x, guard_y) = frame.camera.lens, frame.camera.guard_px
    if isinstance(lens, RealLens):
        rows, columns = np.divmod(lens.nearest_pixels, width + 2 * guard_x)
        rows, columns = rows - guard_y, columns - guard_x
    x, y = (columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy
    depth = np.where(np.isfinite(frame.truth.depth_m), frame.truth.depth_m.astype(np.float64), np.nan)
    seen_C = np.stack([x * depth, y * depth, depth], axis=-1)
    site, pose = frame.spec.terrain.site, frame.pose
    T_from_C = site.T_from_L @ pose.L_from_C
    camera_T_m = site.position_T_m + site.T_from_L @ pose.position_L_m
    return np.asarray(seen_C @ T_from_C.T + camera_T_m)


def proposal(scene: SceneConfig, table: plan.Plan, index: int) -> dict[str, Any]:
    """What the plan proposed for a sample, before `resolve`; plain data. Where the Sun-averted attitude was
    drawn again, the one that was kept (`tries` counts it)."""
    camera = scene.camera
    return {
        **{name: float(values[index]) for name, values in table.variables.items()},
        "injected": [name for name in table.faults if table.injects(name)[index]],
        "architecture": camera.architectures[int(table.architecture[index])],
        "readout_direction": camera.readout_directions[int(table.readout_direction[index])],
    }


# --- a session: many samples of one scene ------------------------------------------------------------------


def configure_faults(scene: SceneConfig, source: str = "scene") -> dict[str, Fault]:
    """The scene's faults in dataset order. Raises InputError."""
    for name in scene.faults:
        from_dict(name, scene.faults[name], source=source)  # unknown classes first: they cannot be ordered
    faults = {n: from_dict(n, scene.faults[n], source=source) for n in dataset_order(scene.faults)}
    if scene.camera.lens and "vignetting" in faults and faults["vignetting"].model == "cos4":
        raise InputError(
            f"{source}: faults.vignetting.model = 'cos4': with camera.lens = {scene.camera.lens!r} pictures fall "
            "off as its rays do, and cos⁴ would count that twice; use model 'lens'"
        )
    for layer in scene.dataset.layers:
        if layer.startswith("without_") and layer != "without_straylight" and layer[8:] not in faults:
            raise InputError(f"{source}: dataset.layers: {layer!r}: the scene has no such fault")
    if "raw" in scene.dataset.layers:
        raise InputError(f"{source}: dataset.layers: 'raw' needs a mosaic detector, which no detector here has")
    for name in scene.dataset.mask_any or ():
        if name not in faults:
            raise InputError(f"{source}: dataset.mask_any: {name!r}: the scene has no such fault")
    return faults


def stored_layers(scene: SceneConfig, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """The optional layers of the scene; the default asks for a twin without straylight, which a scene that has
    no straylight does without."""
    idle = "without_straylight" if plan.STRAYLIGHT not in faults else None
    return tuple(layer for layer in scene.dataset.layers if layer != idle)


def mask_any_faults(scene: SceneConfig, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """The classes united in mask_any: as configured, else the localised ones."""
    if scene.dataset.mask_any is not None:
        return scene.dataset.mask_any
    return tuple(name for name, fault in faults.items() if fault.localised)


class Session:
    """A scene with its plan, and the terrain of the site at work: `simulate` for any sample, in any order.

    `blocks`: sizes of the planned blocks (default: one of `dataset.samples`); `threads`: render threads of this
    process. Raises InputError for a scene that cannot be used.
    """

    def __init__(
        self,
        scene: SceneConfig,
        *,
        blocks: Sequence[int] | None = None,
        threads: int | None = None,
        source: str = "scene",
    ) -> None:
        self.scene = scene
        self.faults = configure_faults(scene, source)
        self.plan = plan.make_plan(scene, list(self.faults), blocks)
        self._threads = threads
        self._terrain: Terrain | None = None

    @cached_property
    def base_camera(self) -> Camera:
        """The camera before a sample's exposure, architecture and readout direction."""
        return world.base_camera(self.scene)

    @cached_property
    def body(self) -> Body:
        """The body, loaded when first asked for."""
        return world.make_body(self.scene)

    @cached_property
    def vehicle(self) -> SpacecraftMesh | None:
        """The spacecraft that carries the camera, if the scene has one."""
        return world.spacecraft(self.scene)

    @cached_property
    def sites(self) -> tuple[Site, ...]:
        """All sites of the scene."""
        if self.scene.spice.spacecraft:
            return world.way_sites(self.scene, self.body)
        return choose_sites(self.body, self.scene.dataset.sites, self.scene.dataset.seed)

    def terrain(self, site: int) -> Terrain:
        """The terrain of a site; the one used last is kept."""
        if self._terrain is None or self._terrain.site.index != site:
            from . import render

            if self._threads is not None:
                render.set_threads(self._threads)
            self._terrain = None  # let go of the old one first: two do not fit a small machine
            patch = self._patch(self.sites[site])
            surface = self.surface(patch)
            self._terrain = Terrain(body=self.body, site=patch.site, surface=surface, vehicle=self.vehicle)
        return self._terrain

    def surface(self, patch: Patch) -> Surface:
        """The renderer's copy of a patch, with relief finer than its facets and the scene's spacecraft."""
        from . import render

        vehicle = None if self.vehicle is None else world.render_vehicle(self.scene, self.vehicle)
        fine = render.FineRelief(
            slope=0.0,
            facet_m=patch.facet_m,
            radius_m=patch.radius_m,
            growth=GROWTH_POWER,
            hurst=self.body.roughness.hurst,
        )
        # slopes of an octave of wavelength λ are 0.44 times the deviation over λ/4 a length of λ/4, for a
        # self-affine surface of Hurst exponent 0.85: the ratio of the integrals of its spectrum
        length = fine.longest_m / 4
        slope = 0.44 * float(self.body.roughness.deviation_at(length)) / length
        slope = min(slope, _STEEPEST_DETAIL) * self.scene.patch.relief
        return render.Surface(
            patch.vertices_L_m,
            patch.faces,
            patch.face_is_flat,
            dust=patch.dust,
            vehicle=vehicle,
            fine=replace(fine, slope=slope),
        )

    def _patch(self, site: Site) -> Patch:
        table = self.scene.patch
        return cached_patch(
            self.body,
            site,
            seed=self.scene.dataset.seed,
            facet_m=table.facet_m,
            radius_m=table.radius_m,
            relief=table.relief,
            hurst=table.hurst,
            craters_per_km2=table.craters_per_km2,
            min_boulder_m=table.min_boulder_m if table.boulders else 1e6,
            boulder_index=table.boulder_index,
            boulders_per_km2=table.boulders_per_km2,
            max_triangles=max(table.max_triangles, 2 * len(self.body.faces)),
        )

    def spec(self, index: int) -> SampleSpec:
        """What `simulate` needs for one sample. On a spacecraft's way every sample has a date of its own."""
        scene, site = self.scene, int(self.plan.site[index])
        if scene.spice.spacecraft:
            share = float(config.keyed_uniform(scene.dataset.seed, np.array([index]), "plan", "epoch")[0])
            sun = scene.sun.model_copy(update={"julian_date": world.epoch_jd(scene, site, share)})
            scene = scene.model_copy(update={"sun": sun})
        return SampleSpec(index=index, scene=scene, plan=self.plan, faults=self.faults, terrain=self.terrain(site))

    def simulate(self, index: int) -> Sample:
        """One finished sample."""
        return simulate(self.spec(index))

    def frame(self, index: int) -> Frame:
        """One sample with all that lies between radiance and labels."""
        return develop_frame(self.spec(index))
