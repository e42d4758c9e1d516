"""Inject faults into images: of files, of other renderers, of a camera that runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra
from ..core.errors import InputError
from ..core.process.environment import share_arenas
from ..core.quantities import RGBI, Electrons, Radiance
from ..core.shared_results import SharedResults
from ..detector import GreyDetector, ThreeColourDetector
from ..faults import Fault, FaultContext
from ..faults.contract import with_sensor
from ..pipeline import masks
from ..pipeline.development import Development, Draws, without
from ..pipeline.exposure import reference_exposure_s
from ..pipeline.injection import draw_faults, visible_draws
from ..pipeline.labels import labels_of
from ..pipeline.spec import Draw, Injection, Labels, SceneExposure, SceneLight, lasts, mask_any_faults
from ..scene import keyed_random
from ..scene.config import Scene, configure_faults, load_scene, parse_scene
from ..scene.instrument import CameraTable, ImageTable
from ..world import cameras, ephemeris
from .change import struck
from .picture import Picture, check_levels
from .response import Response
from .sun import sun_direction

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LEAST_PX = 16
# These keys of a device make its pixels differ
_PATTERNS = (
    *("prnu", "prnu_row", "prnu_column", "prnu_low", "dsnu_e", "dsnu_row_e", "dsnu_column_e", "dark_nonuniformity"),
    *("dose_TeV_g", "dead_fraction", "dead_fraction_yr", "stuck_fraction", "stuck_fraction_yr"),
    *("rts_fraction", "trap_fraction", "trap_fraction_TeV_g", "years"),
)
_NEEDS_SUN = "needs the Sun before the camera; give its position: image.sun, --sun or sun="
_UNSEEN = (
    "changes nothing in any of its draws; it is too weak here, or other faults hide it, as by turning all white"
)
_MUCH_LONGER = 30.0  # exposure over that of sunlit ground, from which a person should know
_ROUNDING_DN = 2.0  # a larger change of the model's image of 8 bits shows in any image


@dataclass(frozen=True, kw_only=True, eq=False)
class Injected:
    """Hold an image with its faults, and what is known of them.

    Attributes
    ----------
    image
        The image with faults, in the shape and the data type of the given one; uint8[y, x, 4] for electrons and
        radiance.
    clean
        The image without faults: the given one; of a noise-free one what the camera makes of it.
    faults
        The classes of the scene, in the order of the dataset.
    masks
        bool[fault, y, x]: the mask of each class.
    mask_any
        bool[y, x]: pixels of the classes of `dataset.mask_any`, by default the localised ones.
    mask_effect
        bool[fault, y, x]: pixels of the noise-free image that change by 1 DN of 8 bits or more; None if the
        injector does not compute them.
    injected
        bool[fault].
    parameters
        The drawn parameters by class, plain data.
    left_out
        Why a commanded class is not in the image, by class.
    unrecoverable
        bool[y, x]: pixels at white or at the lowest number, of which the light is not known.
    electrons
        float32[y, x, channel]: electrons of the image with faults before the readout; None where a fault acts in
        the readout or on the finished image.
    camera
        The camera, with its exposure.
    response
        How the numbers follow from light; None for electrons and radiance.
    sun_xy_px
        Pixel position of the Sun, float64[2]; None without a Sun before the camera.
    assumptions
        What was assumed of the camera, a sentence each.
    """

    image: NDArray[Any]
    clean: NDArray[Any]
    faults: tuple[str, ...]
    masks: Mask
    mask_any: Mask
    mask_effect: Mask | None
    injected: Mask
    parameters: dict[str, dict[str, Any]]
    left_out: dict[str, str]
    unrecoverable: Mask
    electrons: F32 | None
    camera: Camera
    response: Response | None = None
    sun_xy_px: NDArray[np.float64] | None = None
    assumptions: tuple[str, ...] = ()

    def white_fraction(self, image: NDArray[Any]) -> float:
        """Return the fraction of an image's numbers that are white, of one like `image` or `clean`."""
        white = 255.0 if self.response is None else self.response.white_dn
        return float(np.mean(image >= white))


class _ImageDevelopment(Development):
    """Develop images whose clean electrons are given; where they hold the noise of an image, no other is drawn."""

    def __init__(self, electrons: Electrons, *, holds_noise: bool, **shared: Any) -> None:
        super().__init__(**shared)
        self._given, self._holds_noise = electrons, holds_noise

    @cached_property
    def noise(self) -> Any:
        return None if self._holds_noise else super().noise

    def image(self, draws: Draws, *, noisy: bool = True, keep_signals: bool = True) -> RGBI:
        return super().image(draws, noisy=noisy and not self._holds_noise, keep_signals=keep_signals)

    def _undisturbed(self, draws: Draws) -> Electrons:
        if self._instrument(draws):
            names = ", ".join(sorted(draws))
            raise InputError(f"{names}: changes the lens or the filters, which needs radiance and not an image")
        return self._given


@dataclass(frozen=True, kw_only=True, eq=False)
class _Drawing:
    """Hold the faults of an image and its keyed random numbers."""

    faults: Mapping[str, Fault]
    seed: int
    index: int
    state: int | None

    @property
    def shares_state(self) -> bool:
        """Return whether other images have the same state of the instrument."""
        return self.state is not None

    def fraction(self, fault: str) -> float:
        """Return 1: all of a fault is active, since images of one's own have no times."""
        return 1.0

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """Return the generator for (stage, name); faults that last from image to image follow `state`."""
        state = self.state if lasts(self, stage, name) else None
        return keyed_random.rng(self.seed, self.index if state is None else state, stage, name)


class Injector:
    """Inject the faults of a scene into images of its camera; everything that images share is made once.

    Parameters
    ----------
    scene
        A scene, its file or name. Its `[camera]`, `[sun]`, `[image]` and `[faults]` count.
    source
        Name of the scene in messages.
    effects
        Whether to compute what each fault changes. Without, an image takes a fraction of the time: `mask_effect` is
        None, `mask_any` unites the masks, and a fault counts as injected though no pixel may show it.

    Raises
    ------
    InputError
        The scene cannot be used.
    """

    def __init__(self, scene: Scene | str | Path, *, source: str = "scene", effects: bool = True) -> None:
        if not isinstance(scene, Scene):
            source, scene = str(scene), load_scene(scene)
        share_arenas()  # an image passes through many arrays of its size: a tenth of the time
        self.scene, self.source, self.effects = scene, source, effects
        self.faults = configure_faults(scene, source)
        if scene.event:
            raise InputError(f"{source}: event: images of one's own have no times; leave the events out")
        table = scene.image or ImageTable()
        if table.black_dn is not None and table.white_dn is not None:
            check_levels(table.black_dn, table.white_dn)
        self._cameras: dict[tuple[tuple[int, int], bool], tuple[Camera, tuple[str, ...]]] = {}
        self._shared: tuple[Any, SharedResults] | None = None

    def require_faults(self) -> None:
        """Raise InputError if no image would change, since there are no faults and the camera adds no noise."""
        if not self.faults and not (self.scene.image or ImageTable()).noise_free:
            raise InputError(
                f"{self.source}: [faults] names no class, so no image would change; `vbnfault list faults`"
            )

    def __call__(
        self,
        image: NDArray[Any] | Electrons | Radiance,
        index: int = 0,
        *,
        state: int | None = None,
        sun: str | Sequence[float] | None = None,
        commanded: Sequence[str] | None = None,
        depth_m: NDArray[Any] | None = None,
        camera: Camera | None = None,
        context: Mapping[str, Any] | None = None,
        raw: bool | None = None,
    ) -> Injected:
        """Return an image with faults.

        Parameters
        ----------
        image
            [y, x], [y, x, 1], [y, x, 3] (R, G, B) or [y, x, 4] (R, G, B, I), of whole numbers or floats; or the
            expected electrons of the camera, or radiance, from which the camera takes the image with its own noise.
        index
            Number of the image: with the seed of the scene it keys all random numbers.
        state
            Number of the instrument's state: images with the same one have the same dust, defects and lens, and
            differ in what happens during an exposure (`Fault.per_exposure`). None: each image has its own.
        sun
            "auto" finds the Sun as the saturated disc; two numbers are its pixel position, three its direction in
            the camera frame; None is what `[image]` says.
        commanded
            Classes to inject; default: all of the scene.
        depth_m
            float[y, x]: depth along the boresight, where it is known.
        camera
            Camera with its exposure, in place of the scene's.
        context
            Further fields of `faults.FaultContext` that are known.
        raw
            Whether the numbers of [y, x] are those of the sensor's mosaic; default: as `[image]` says.

        Raises
        ------
        InputError
            The image cannot be used with this camera.
        """
        given = image if isinstance(image, Electrons | Radiance) else _checked_array(image)
        unknown = sorted({*(commanded or ())} - {*self.faults})
        if unknown:
            raise InputError(f"commanded = {commanded!r}: {unknown[0]} is none of {', '.join(self.faults)}")
        shape = _shape(given)
        if depth_m is not None and np.shape(depth_m) != shape:
            raise InputError(f"depth_m of shape {list(np.shape(depth_m))}: must be {list(shape)}, as the image")
        grey = isinstance(given, np.ndarray) and given.ndim == 2
        camera, assumed = self._camera(shape, camera, grey=grey)
        drawing = _Drawing(faults=self.faults, seed=self.scene.dataset.seed, index=index, state=state)
        picture = None
        if isinstance(given, Electrons | Radiance):
            light = given if isinstance(given, Electrons) else camera.expose(given, camera.exposure_s)
        else:
            camera = _without_pattern(camera)
            as_raw = bool(self.scene.image and self.scene.image.raw) if raw is None else raw
            picture = self._picture(given, camera, drawing, raw=as_raw)
            assumed += picture.assumptions
            light = picture.electrons
        known = replace(self._context(camera, sun, depth_m, picture), **(context or {}))
        of = partial(_development, context=known, drawing=drawing, holds_noise=picture is not None)
        development = of(light)
        drawn, left_out = self._drawn(development, drawing, commanded)
        draws, result, electrons = drawn, None, None
        if picture is not None:
            draws, (result, electrons) = self._struck(picture, development, drawn, of)
            left_out |= {
                name: "changes no number of the image; it is too weak here" for name in drawn if name not in draws
            }
        labels = self._labels(Injection(draws=draws, development=development))
        nothing = np.zeros(known.shape, dtype=bool)
        effects = [labels.effects.get(name, nothing) for name in self.faults] if self.effects else []
        return Injected(
            image=development.image(draws).array if result is None else result,
            clean=development.image({}).array if picture is None else picture.numbers,
            faults=tuple(self.faults),
            masks=labels.masks,
            mask_any=labels.mask_any,
            mask_effect=np.array(effects, dtype=bool).reshape(-1, *known.shape) if self.effects else None,
            injected=np.array([name in draws for name in self.faults], dtype=bool),
            parameters={name: {"model": draw.fault.model, **draw.params} for name, draw in sorted(draws.items())},
            left_out=left_out,
            unrecoverable=nothing if picture is None else picture.unrecoverable,
            electrons=electrons,
            camera=camera,
            response=None if picture is None else picture.response,
            sun_xy_px=known.sun_xy_px,
            assumptions=tuple(assumed),
        )

    def _picture(self, numbers: NDArray[Any], camera: Camera, drawing: _Drawing, *, raw: bool) -> Picture:
        """Return an image as the camera sees it; one without noise is first taken by the camera."""
        table = self.scene.image or ImageTable()
        picture = Picture.of(numbers, table, camera, raw=raw)
        return picture.exposed(table, drawing.rng) if table.noise_free else picture

    def _struck(
        self,
        picture: Picture,
        development: Development,
        drawn: dict[str, Draw],
        of: Callable[[Electrons], Development],
    ) -> tuple[dict[str, Draw], tuple[NDArray[Any], F32 | None]]:
        """Return the draws that change numbers of an image, and `change.struck` with these."""
        draws, result = drawn, struck(picture, development, drawn, of)
        doubtful = drawn if self.effects else ()
        for name in [name for name in doubtful if not development.effect(drawn, name, _ROUNDING_DN).any()]:
            # a change below the rounding of the model's image may be one below that of this image, too
            others = without(draws, name)
            lacking = struck(picture, development, others, of)
            if np.array_equal(lacking[0], result[0]):
                draws, result = others, lacking
        return draws, result

    def _labels(self, injection: Injection) -> Labels:
        """Return the labels of an image; those without effects have the union of masks as `mask_any`."""
        members = mask_any_faults(self.scene, self.faults)
        if self.effects:
            return labels_of(self.faults, injection, members, ("mask_effect",))
        labels = labels_of(self.faults, injection, (), ())
        return replace(labels, mask_any=masks.union(labels.masks, self.faults, members))

    def _drawn(
        self, development: Development, drawing: _Drawing, commanded: Sequence[str] | None
    ) -> tuple[dict[str, Draw], dict[str, str]]:
        """Return draws of the commanded classes, and why the others are not in the image."""
        names = [name for name in self.faults if commanded is None or name in commanded]
        in_dark = development.context.sun_xy_px is None
        left_out = {name: _NEEDS_SUN for name in names if in_dark and self.faults[name].needs_sun}
        possible = [name for name in names if name not in left_out]
        if not self.effects:
            return draw_faults(drawing, development, possible, {}, 0), left_out
        draws = visible_draws(drawing, development, possible)
        unseen = {name: _UNSEEN for name in possible if name not in draws}
        return draws, {**left_out, **unseen}

    # --- camera and Sun ------------------------------------------------------------------------------------------

    def _camera(self, shape: tuple[int, int], given: Camera | None, *, grey: bool) -> tuple[Camera, list[str]]:
        """Return the camera of images of a shape, grey or in colours, and what was assumed of it."""
        height, width = shape
        if given is not None:
            if (given.height_px, given.width_px) != shape:
                raise InputError(
                    f"image of {width} x {height} pixels: the camera has {given.width_px} x {given.height_px}"
                )
            return given, []
        if min(shape) < _LEAST_PX:
            raise InputError(f"image of {width} x {height} pixels: must have at least {_LEAST_PX} x {_LEAST_PX}")
        self.scene = of_first_image(self.scene, width, height)
        table, assumed = self.scene.camera, []
        given_keys = table.model_fields_set
        if table.calibration is None and not {"fov_deg", "focal_length_mm", "lens"} & given_keys:
            assumed.append(f"camera.fov_deg = {table.fov_deg:g}: assumed, since the scene does not give it")
        if "detector" not in given_keys:
            pixels = "pixels without colour filters" if grey else "three colours in every pixel"
            assumed.append(f"camera.detector = '': assumed, {pixels}, since the scene names none")
        if (shape, grey) not in self._cameras:
            self._cameras[shape, grey] = self._made_camera(
                table.of_image(width, height),
                GreyDetector if grey else ThreeColourDetector,
            )
        camera, of_exposure = self._cameras[shape, grey]
        return camera, [*assumed, *of_exposure]

    def _made_camera(
        self, table: CameraTable, generic: type[ThreeColourDetector]
    ) -> tuple[Camera, tuple[str, ...]]:
        """Return the camera of a table, and a sentence where its exposure is assumed or would be far too long.

        `generic` is as in `cameras.base_camera`.
        """
        scene = self.scene.model_copy(update={"camera": table})
        camera = cameras.base_camera(scene, generic=generic)
        reference_s = reference_exposure_s(scene, camera)
        said: tuple[str, ...] = ()
        if table.exposure_s == "auto":
            exposure_s = float(np.clip(reference_s, table.exposure_min_s, table.exposure_max_s))
            said = (
                f"camera.exposure_s = {exposure_s:.3g}: assumed, as ground of body.reflectance lit at 45 "
                "degrees is metered",
            )
            return replace(camera, exposure_s=exposure_s), said
        exposure_s = float(table.exposure_s)
        if exposure_s > _MUCH_LONGER * reference_s:
            said = (
                f"camera.exposure_s = {exposure_s:g}: taken as given; sunlit ground of body.reflectance would need "
                f"{reference_s:.2g} s, so if camera.f_number or camera.transmission is wrong, sunlight on dust and "
                f"in the lens is up to {exposure_s / reference_s:.0f} times too bright",
            )
        return replace(camera, exposure_s=exposure_s), said

    def _context(
        self, camera: Camera, sun: str | Sequence[float] | None, depth_m: Any, picture: Picture | None
    ) -> FaultContext:
        """Return the context of the faults."""
        nodes = ephemeris.wavelengths_nm(self.scene)
        distance_au = ephemeris.sun_distance_au(self.scene)
        direction = sun_direction(
            (self.scene.image or ImageTable()).sun if sun is None else sun, camera, distance_au, picture
        )
        return FaultContext(
            camera=camera,
            sun_xy_px=None if direction is None else camera.project(direction),
            sun_direction_C=direction,
            sun_irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(nodes, distance_au),
            wavelength_nm=nodes,
            sun_angular_radius_rad=spectra.sun_angular_radius_rad(distance_au),
            sun_visible_fraction=None if direction is None else 1.0,
            depth_m=None if depth_m is None else np.asarray(depth_m),
            of_view=self._shared_by(camera, direction),
        )

    def _shared_by(self, camera: Camera, sun: NDArray[np.float64] | None) -> SharedResults:
        """Return what images of one camera with the same Sun share, kept for the last such pair."""
        key = camera, None if sun is None else sun.tobytes()
        if self._shared is None or self._shared[0] != key:
            self._shared = key, SharedResults(kept=True)
        return self._shared[1]


def of_first_image(scene: Scene, width_px: int, height_px: int) -> Scene:
    """Return a scene whose calibration, if it states no size, holds for images of this width and height."""
    if not scene.camera.unsized_calibration:
        return scene
    return scene.model_copy(update={"camera": scene.camera.of_image(width_px, height_px)})


@lru_cache(maxsize=8)
def _without_pattern(camera: Camera) -> Camera:
    """Return a camera whose sensor has no drawn pattern: an image shows that of the device that took it."""
    if camera.detector.mosaic is None:
        return camera
    nothing = dict.fromkeys(_PATTERNS, 0.0)
    return with_sensor(camera, individual=replace(camera.mosaic.sensor.individual, hot_growth=None, **nothing))


def _development(
    light: Electrons, context: FaultContext, drawing: _Drawing, *, holds_noise: bool
) -> _ImageDevelopment:
    """Return what develops images of given electrons."""
    nodes, camera = context.sunlight[0], context.camera
    dark = Radiance(array=np.zeros((len(nodes), 1, 1), np.float32), wavelength_nm=nodes)
    exposure = SceneExposure(camera=camera, light=SceneLight(lens=camera.lens, rendered=dark), rate=light)
    return _ImageDevelopment(light, holds_noise=holds_noise, exposure=exposure, context=context, rng=drawing.rng)


def _shape(image: NDArray[Any] | Electrons | Radiance) -> tuple[int, int]:
    """Return (height, width) in pixels."""
    array = image.array if isinstance(image, Electrons | Radiance) else image
    height, width = array.shape[-2:] if isinstance(image, Radiance) else array.shape[:2]
    return int(height), int(width)


def inject(
    image: NDArray[Any] | Electrons | Radiance,
    faults: Mapping[str, Any],
    *,
    camera: Camera | Mapping[str, Any] | None = None,
    seed: int = 0,
    sun: str | Sequence[float] | None = None,
    **known: Any,
) -> Injected:
    """Return an image with faults, their masks and their parameters.

    Parameters
    ----------
    image
        As for `Injector`.
    faults
        Tables of the faults by class, as under `[faults]` of a scene: {"dust_on_optics": {"model": "defocused"}}.
    camera
        Keys of `[camera]`, or a camera with its exposure; default: a scene's default camera.
    seed
        Seed of all random numbers.
    sun, known
        As for `Injector`; `image_keys` are keys of `[image]`.

    Raises
    ------
    InputError
        Image, camera or faults cannot be used.
    """
    if not isinstance(faults, Mapping):
        raise InputError(f"faults = {faults!r}: must be tables by class, as {{'dust_on_optics': {{}}}}")
    if not isinstance(camera, Camera | Mapping | None):
        raise InputError(f"camera = {camera!r}: must be keys of [camera], as {{'detector': 'rosetta_navcam'}}")
    tables: dict[str, Any] = {"title": "inject", "dataset": {"seed": seed}, "faults": dict(faults)}
    if "image_keys" in known:
        tables["image"] = known.pop("image_keys")
    if isinstance(camera, Mapping):
        tables["camera"] = dict(camera)
    injector = Injector(parse_scene(tables, source="inject"), source="inject")
    injector.require_faults()
    return injector(image, sun=sun, camera=camera if isinstance(camera, Camera) else None, **known)


def _checked_array(image: Any) -> NDArray[Any]:
    """Return an image as an array. Raises InputError if it has another shape or data type than an image."""
    if image is None or isinstance(image, str | Path):
        raise InputError(f"image: is {image!r} and no array; was the file read?")
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)) or not array.size:
        raise InputError(
            f"image of shape {list(array.shape)}: must be [y, x], or [y, x, channel] with 1, 3 or 4 channels"
        )
    if array.dtype.kind not in "uif" or (array.dtype.kind in "ui" and array.dtype.itemsize > 4):
        raise InputError(f"image of {array.dtype}: must hold whole numbers of up to 32 bits, or floats")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"image: holds {int((~np.isfinite(array)).sum())} values that are NaN or infinite")
    return array
