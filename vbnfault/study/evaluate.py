"""Evaluate points of a study at views of a scene, and compute again only what a factor moves.

    render ▶ metered light ▶ ghosts, starburst, glare, veil ▶ metrics

A view is rendered once; optics, Sun and detector act on its radiance. The results of each stage are kept with all
that the stage depends on (`kept`), a few of them at a time, so that the result of an evaluation does not depend on
those before it. In a Sobol design the points AB differ from their point A in one factor, so most of their stages
are found there.

The image metrics follow the straylight alone, the fault of the scene that adds light; all faults of the scene act
on the images of the navigation metrics, which pass the whole pipeline. Parameters of a fault that the
scene gives as intervals are drawn once for a view, with the same random numbers for all points of a block.

Assumptions: the ground is lit as in the rendered view wherever `sun.…` moves the Sun; the guard band and the depth
of field of the render are those of the nominal lens.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra
from ..core.errors import InputError, in_file, shown
from ..core.spectra import Bands
from ..core.tables import did_you_mean
from ..faults import Fault, FaultContext
from ..lens.adapt import changed
from ..lens.straylight.irradiance import flare_model
from ..lens.straylight.scatter import GlareLayout
from ..lens.straylight.settings import GhostSettings, SensorGrid
from ..lens.straylight.total import COARSE_SPIKES, GhostSource, SpreadLight, SunInLens, ghosts, veil_per_px
from ..pipeline.exposure import meter
from ..pipeline.injection import inject_faults
from ..pipeline.rendering import render_view
from ..pipeline.resolve import resolve
from ..pipeline.session import Session
from ..pipeline.spec import Injection, SampleSpec
from ..scene.config import Scene, configure_faults
from . import image_metrics
from . import navigation_metrics as nav
from .factors import (
    FAULT_KEY,
    FAULT_SCENE_KEY,
    Factors,
    Setting,
    StudyScene,
    acting_faults,
    base_scene,
    changed_scene,
    fault_choices,
)
from .image_metrics import LitImage
from .kept import Kept
from .spec import Evaluation, Metric, StudySpec
from .views import (
    CleanView,
    Exposed,
    RenderedView,
    camera_shape,
    dark_e,
    rendered_sequence,
    with_detector,
    with_sun,
)

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


_NAVIGATION: Mapping[str, Metric] = {metric.name: metric for metric in nav.METRICS}


class SceneEvaluator:
    """Evaluate the points of a study at the views of its scene.

    Parameters
    ----------
    spec
        The study.

    Raises
    ------
    InputError
        The scene, a factor or a metric is unknown or does not fit.
    """

    def __init__(self, spec: StudySpec) -> None:
        self.spec = spec
        self.kept = Kept()
        self._source = f"study {shown(spec.title)}"
        self._session: tuple[Hashable, Session] | None = None
        with in_file(self._source):
            self._base = base_scene(spec)
            self.scene_of = lru_cache(maxsize=16)(partial(changed_scene, spec, self._base))
            plain = [StudyScene(self._base)]
            if spec.models is not None:
                plain = [self.scene_of(self._base.dataset.seed, model) for model in spec.models.compare]
            # a session also draws the plan of its scene and checks its faults
            cameras = [Session(made.scene, source=self._source).base_camera for made in plain]
            self._chosen_faults = fault_choices(spec)
            for choice in self._chosen_faults:
                made = self.scene_of(spec.scene.seeds[0], "", ((FAULT_SCENE_KEY, choice),))
                configure_faults(made.scene, f"{FAULT_KEY} = {choice!r}")
            self._nominal_camera = camera = cameras[0]
            adding = [name for made in plain for name, f in made.faults.items() if f.soft_layer.endswith("_added")]
            self._adding = adding[0] if adding else ""  # the fault that adds light
            frame = FaultContext(camera=camera).frame
            traced = [made.faults[self._adding].prescription(frame) for made in plain if adding]
            self._nominal_lens = next(filter(None, traced), None) or frame.prescription("", "as_prescribed")
            self.factors = Factors(spec, self._base, camera, self._nominal_lens)
            self._check_metrics()

    # --- the contract of an evaluator -----------------------------------------------------------------------------

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Return the metrics that the study names."""
        made = []
        for name in self.spec.metrics.names:
            if name in _NAVIGATION:
                made.append(_NAVIGATION[name])
                continue
            rank = image_metrics.ghost_rank(name)
            made.append(image_metrics.metric(name, None if rank is None else self._ghost_pair(rank)))
        return tuple(made)

    def timings(self) -> Mapping[str, float]:
        """Return the seconds spent so far in each stage."""
        return dict(self.kept.seconds)

    def check(self) -> Sequence[str]:
        """Evaluate every factor at its nominal and another value on the first view, and return warnings.

        Raises
        ------
        InputError
            A value is out of range, or no model of the study reads a factor.
        """
        _ = self.metrics
        places: dict[str, set[str]] = {}
        for i, factor in enumerate(self.spec.factors):
            if factor.key == FAULT_KEY:
                continue  # a fault need not act in the first view
            try:
                places[factor.key] = self._places_without(factor)
            except InputError as error:
                raise InputError(f"factor[{i}].key = {shown(factor.key)}: {error}") from None
            # with a chosen fault, that may only mean that no fault with this key acts in the first view
            if len(places[factor.key]) == 2 * len(self.spec.model_names) and not self._chosen_faults:
                raise InputError(
                    f"factor[{i}].key = {shown(factor.key)}: nothing in the images of the study reads it; "
                    "leave it out"
                )
        self.kept.release("check")
        return [
            f"factor {key!r} is inactive {' and '.join(sorted(where))}" for key, where in places.items() if where
        ]

    def _places_without(self, factor: Any) -> set[str]:
        """Return where in the study a factor changes no bit of the light: two entries for a model that ignores it.

        The others stand at their nominal values, or, where the factor is not read there, near their upper bounds.
        """
        places = set()
        middle = {f.key: _value(f, f.nominal()) for f in self.spec.factors}
        upper = {f.key: _value(f, 0.9) for f in self.spec.factors}
        for model in self.spec.model_names:
            with_model = f" with the model {model}" if model else ""
            self._refuse(model, middle | {factor.key: _value(factor, 0.0)})
            if self._acts(model, middle, factor.key, _value(factor, 0.98)):
                continue
            places.add(f"where the others are nominal{with_model}")
            if not self._acts(model, upper, factor.key, _value(factor, 0.1)):
                places.add(f"where the others are large{with_model}")
        return places

    def _acts(self, model: str, point: Mapping[str, float | str], key: str, value: float | str) -> bool:
        """Return whether another value of a factor changes a bit of the light at a point, with any chosen fault."""
        for choice in self._chosen_faults or ("",):
            at = {**point, FAULT_KEY: choice} if choice else point
            with self.kept.holding("check"):
                base = self._fingerprint(model, at)
            if self._fingerprint(model, {**at, key: value}) != base:
                return True
        return False

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        """Return the value of each metric that the study names."""
        setting = self.factors.setting(evaluation.values)
        if evaluation.role == "A":  # the rows AB of this base row differ from it in one factor each
            with self.kept.holding(evaluation.model):
                return self._values(evaluation, setting)
        return self._values(evaluation, setting)

    def _values(self, evaluation: Evaluation, setting: Setting) -> Mapping[str, float]:
        """Return the value of each metric that the study names."""
        names = self.spec.metrics.names
        values: dict[str, float] = {}
        image_names = [name for name in names if name not in _NAVIGATION]
        if image_names:
            image = self._lit_image(evaluation, setting)
            with self.kept.timed("metrics"):
                values |= {name: image_metrics.value(name, image) for name in image_names}
        own = [name for name in names if name in _NAVIGATION]
        if own:
            values |= self._navigation_values(evaluation, setting, own)
        return {name: values[name] for name in names}

    def picture(self, evaluation: Evaluation) -> NDArray[Any]:
        """Return an image of an evaluation, [y, x, channel].

        Where the study has metrics of navigation, it is the image with all faults that they judge, uint8 as stored;
        otherwise the expected image with straylight, float32 in electrons, without noise.
        """
        setting = self.factors.setting(evaluation.values)
        if any(name in _NAVIGATION for name in self.spec.metrics.names):
            (frame,) = self._navigation_frames(evaluation, setting, 1)
            return np.ascontiguousarray(frame.image[..., :3])
        image = self._lit_image(evaluation, setting)
        return np.ascontiguousarray(np.moveaxis((image.kept + image.added)[:3], 0, -1))

    # --- the study's scene ----------------------------------------------------------------------------------------

    def _check_metrics(self) -> None:
        """Raise InputError if a metric is unknown, or has nothing to measure in the scene."""
        known = [*image_metrics.NAMES, *_NAVIGATION]
        for name in self.spec.metrics.names:
            if name in _NAVIGATION:
                continue
            if not image_metrics.is_image_metric(name):
                raise InputError(f"metrics.names: {shown(name)} is unknown{did_you_mean(name, known)}")
            if self._chosen_faults:
                raise InputError(
                    f"metrics.names: {name!r} measures the straylight of the scene; "
                    f"with the factor {FAULT_KEY} use metrics of navigation: {', '.join(_NAVIGATION)}"
                )
            if not self._adding:
                raise InputError(
                    f"metrics.names: {shown(name)} needs a fault that adds light, which the scene "
                    f"{shown(self.spec.scene.base)} has not"
                )

    # --- stages ---------------------------------------------------------------------------------------------------

    def _scene(self, evaluation: Evaluation, setting: Setting) -> StudyScene:
        """Return the scene of an evaluation."""
        return self.scene_of(evaluation.seed, evaluation.model, tuple(sorted(setting.scene.items())))

    def _view(self, evaluation: Evaluation, made: StudyScene) -> RenderedView:
        """Return a view, rendered where this was not done before for what the renderer reads of the scene."""
        key = made.render_key, evaluation.view
        return self.kept.once("render", key, lambda: self._rendered(key[0], made.scene, evaluation.view))

    def _rendered(self, key: Hashable, scene: Scene, index: int) -> RenderedView:
        """Render a view."""
        if self._session is None or self._session[0] != key:
            self._session = None  # release the old terrain first
            self._session = key, Session(scene, source=self._source)
        session = self._session[1]
        spec = session.spec(index)
        pose = resolve(spec, 0)
        spec = spec.at(pose)
        return RenderedView(spec=spec, pose=pose, rendering=render_view(spec, pose))

    def _exposed(self, evaluation: Evaluation, setting: Setting) -> Exposed:
        """Return the view of an evaluation with its camera, its Sun and its exposure."""
        made = self._scene(evaluation, setting)
        seen = self._seen(self._view(evaluation, made), evaluation, made, setting)
        return Exposed(**vars(seen), exposure=meter(seen.spec, seen.rendering))

    def _seen(self, view: RenderedView, evaluation: Evaluation, made: StudyScene, setting: Setting) -> RenderedView:
        """Return a rendered view with the scene, the camera and the Sun of an evaluation.

        What the stages share between the samples of a view is kept by all that this view differs in but its camera,
        which is in the keys of the stages.
        """
        scene = made.scene
        camera = self._camera(replace(view.spec, scene=scene), setting)
        pose, rendering = with_sun(view, setting.sun)
        key = (made.render_key, evaluation.view, view.number, tuple(setting.sun.items()), scene.camera)
        return RenderedView(
            spec=replace(view.spec, scene=scene, faults=made.faults, taken_with=camera),
            pose=pose,
            rendering=replace(rendering, shared=self.kept.of_view(key)),
            number=view.number,
        )

    def _camera(self, spec: SampleSpec, setting: Setting) -> Camera:
        """Return the camera of an evaluation without an exposure."""
        camera = with_detector(spec.camera, setting.detector)
        changes = tuple(setting.lens)
        if not changes:
            return camera
        if camera.lens.real is not None:
            key = camera.lens, changes
            real = camera.lens.real
            lens = self.kept.once(
                "direct image",
                key,
                lambda: replace(real, prescription=changed(real.prescription, changes), guard=real.guard_px),
                "lens",
            )
            camera = replace(camera, lens=lens)
        return replace(camera, lens_changes=changes)

    # --- light ----------------------------------------------------------------------------------------------------

    def _lit_image(self, evaluation: Evaluation, setting: Setting) -> LitImage:
        """Return the expected light of an evaluation."""
        exposed = self._exposed(evaluation, setting)
        fault = exposed.spec.faults[self._adding]
        params = fault.draw_state(exposed.context, exposed.spec.rng("fault", f"{self._adding}/0"))
        added = fault.added_light(params, exposed.context, self._once, spikes=COARSE_SPIKES)
        with self.kept.timed("light"):
            light = _added_by(fault, exposed, params) if added is None else self._by_parts(added, exposed)
        camera = exposed.camera
        detector = camera.detector
        return LitImage(
            clean=exposed.clean,
            lit=exposed.lit,
            dark_e=dark_e(camera),
            read_noise_e=detector.read_noise_e_rms,
            full_well_e=detector.full_well_e,
            white_e=detector.white_e,
            mask_level_dn=fault.effect_level_dn,
            **light,
        )

    def _once(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return `function(*arguments)`, which is a stage of its own, from its last results where they hold it."""
        stage, part = _STAGES.get(function, (function.__name__, ""))
        return self.kept.once(stage, arguments, partial(function, *arguments), part)

    def _by_parts(self, light: Any, exposed: Exposed) -> dict[str, Any]:
        """Return the fields of `LitImage` that hold straylight with parts (`Fault.added_light`)."""
        seconds = np.float32(exposed.camera.exposure_s)
        left = exposed.scene_e * (1 - light.scene_lost).astype(np.float32)[:, None, None]
        direct = None
        if exposed.direct_e is not None:
            direct = exposed.direct_e * light.direct_left.astype(np.float32)[:, None, None]
            left += direct
        added = np.ascontiguousarray(np.moveaxis(light.added, -1, 0))
        if not light.scene_added:  # what the lens scatters of the scene returns as a veil
            veil = veil_per_px(camera_shape(exposed.camera), exposed.camera.focal_length_px)
            flux = exposed.scene_e.sum(axis=(1, 2), dtype=np.float64) * light.scene_lost
            added = added + veil * flux.astype(np.float32)[:, None, None]
        fields = {"kept": left, "direct": direct, "added": added, "parts_e": {}, "ghosts_e": ()}
        if light.of_sun is None:
            return fields
        source, sun = light.source, light.of_sun
        per_mm2 = float(seconds) / source.sensor.pitch_mm**2
        rates = sun.rates * sun.ghost_gain
        fields["parts_e"] = {name: float(flux.mean() * per_mm2) for name, flux in sun.flux_mm2.items()}
        fields["ghosts_e"] = self._single_ghosts(source, rates * per_mm2)
        fields["ghosts"] = _mean_of_channels(sun.ghosts, rates * seconds)
        if "ghost_difference" in self.spec.metrics.names:
            settings = replace(source.settings, ghosts=replace(source.settings.ghosts, model="traced"))
            traced = self._once(ghosts, replace(source, settings=settings).of_ghosts)
            fields["traced_ghosts"] = _mean_of_channels(traced, rates * seconds)
        return fields

    # --- single ghosts --------------------------------------------------------------------------------------------

    @cached_property
    def _ghost_pairs(self) -> tuple[tuple[int, ...], ...]:
        """Return the paths of the nominal lens that reach the frame, the one with most flux first.

        The Sun stands at half the half-width of the field, to the right.
        """
        camera = self._nominal_camera
        lens = self._nominal_lens
        scene = self._base.render
        bands = Bands.sunlight(scene.band_min_nm, scene.band_max_nm)
        sensor = SensorGrid(shape=camera_shape(camera), pitch_mm=camera.detector.pixel_pitch_um * 1e-3)
        model = flare_model(lens, bands, sensor, spectra.sun_angular_radius_rad(1.0), GhostSettings())
        ghosts = sorted(model.ghosts(camera.fov_deg / 4), key=lambda ghost: -ghost.flux_fraction)
        return tuple(ghost.pair for ghost in ghosts)

    def _ghost_pair(self, rank: int) -> tuple[int, ...]:
        """Return the path of a rank. Raises InputError where the lens has fewer paths."""
        if rank > len(self._ghost_pairs):
            raise InputError(
                f"study {shown(self.spec.title)}: metrics.names: 'ghost_{rank}_flux_e': of the nominal lens "
                f"{len(self._ghost_pairs)} ghosts reach the frame"
            )
        return self._ghost_pairs[rank - 1]

    def _single_ghosts(self, light: SunInLens, e_per_mm2: F64) -> tuple[float, ...]:
        """Return the flux of the ghosts that the study follows, in electrons."""
        ranks = [rank for name in self.spec.metrics.names if (rank := image_metrics.ghost_rank(name)) is not None]
        if not ranks:
            return ()
        pairs = tuple(self._ghost_pair(rank) for rank in range(1, max(ranks) + 1))
        flux = self._once(_flux_mm2, light.of_ghosts, pairs)
        return tuple(float((e_per_mm2 * flux[pair]).mean()) for pair in pairs)

    # --- frames for navigation ------------------------------------------------------------------------------------

    def _navigation_values(
        self, evaluation: Evaluation, setting: Setting, names: Sequence[str]
    ) -> Mapping[str, float]:
        """Return the metrics of navigation, from images that pass the whole pipeline."""
        frames = self._navigation_frames(evaluation, setting, nav.views_needed(names))
        if not frames:
            return dict.fromkeys(names, float("nan"))
        _, twins = self._clean_views(evaluation, setting, len(frames))
        with self.kept.timed("navigation"):
            return nav.navigation_values(frames, names, twins)

    def _navigation_frames(self, evaluation: Evaluation, setting: Setting, count: int) -> list[nav.NavigationFrame]:
        """Return the clean and the faulted image of the first `count` views of an evaluation's sequence.

        There are none where the fault that a factor chooses cannot act, or does not show.
        """
        made = self._scene(evaluation, setting)
        frames: list[nav.NavigationFrame] = []
        first: Injection | None = None
        for clean in self._clean_views(evaluation, setting, count)[0]:
            with self.kept.timed("faults"):
                spec = replace(clean.spec, scene=made.scene, faults=made.faults)
                view = spec, clean.pose, clean.rendering, clean.exposure
                if first is None:
                    chosen = acting_faults(made.faults, spec, clean.pose) if self._chosen_faults else None
                    first = injection = inject_faults(*view, commanded=chosen)
                    if self._chosen_faults and not first.draws:
                        return []
                else:
                    injection = nav.continue_faults(*view, first)
                image = injection.development.image(injection.draws).array
                frames.append(replace(clean.frame, image=image))
        return frames

    def _clean_views(
        self, evaluation: Evaluation, setting: Setting, count: int
    ) -> tuple[Sequence[CleanView], nav.ViewedImages]:
        """Return the first `count` views of an evaluation's sequence without faults, and their clean twins."""
        without = replace(setting, scene={k: v for k, v in setting.scene.items() if k != FAULT_SCENE_KEY})
        made = self._scene(evaluation, without)
        view = self._view(evaluation, made)
        key = made.render_key, evaluation.view, count
        sequence = self.kept.once("render", key, lambda: list(rendered_sequence(view, count)), "sequence")
        sun, detector = tuple(sorted(setting.sun.items())), tuple(sorted(setting.detector.items()))

        def make() -> tuple[Sequence[CleanView], nav.ViewedImages]:
            seen = (self._seen(view, evaluation, made, setting) for view in sequence)
            views = [CleanView.of(view, nominal.spec.camera) for view, nominal in zip(seen, sequence, strict=True)]
            return views, nav.clean_twins([view.frame for view in views])

        return self.kept.once("clean twins", (*key, made.scene.camera, tuple(setting.lens), detector, sun), make)

    # --- what a factor moves --------------------------------------------------------------------------------------

    def _check_of(self, model: str, values: Mapping[str, float | str]) -> Evaluation:
        """Return the evaluation of a point on the first view."""
        seed, view = self.spec.scene.seeds[0], self.spec.scene.views[0]
        return Evaluation(index=0, seed=seed, view=view, model=model, role="check", values=values)

    def _refuse(self, model: str, values: Mapping[str, float | str]) -> None:
        """Raise InputError if a scene, a sensor or a lens cannot have the values of a point."""
        setting = self.factors.setting(values)
        changed(self._nominal_lens, setting.lens)
        with_detector(self._nominal_camera, setting.detector)
        self._scene(self._check_of(model, values), setting)

    def _fingerprint(self, model: str, values: Mapping[str, float | str]) -> str:
        """Return a digest of all light, noise and images of the first view at a point."""
        evaluation = self._check_of(model, values)
        digest = hashlib.sha256()
        if any(name not in _NAVIGATION for name in self.spec.metrics.names):
            image = self._lit_image(evaluation, self.factors.setting(values))
            for array in (image.clean, image.kept, image.added, image.white_e, np.asarray(image.dark_e)):
                digest.update(np.ascontiguousarray(array).tobytes())
            digest.update(
                repr((image.ghosts_e, image.read_noise_e, image.full_well_e, image.mask_level_dn)).encode()
            )
        if any(name in _NAVIGATION for name in self.spec.metrics.names):
            digest.update(repr(sorted(self.evaluate(evaluation).items())).encode())
        return digest.hexdigest()


# --- values and images -------------------------------------------------------------------------------------------


def _value(factor: Any, point: float) -> float | str:
    """Return the value of a factor at a point of the unit interval."""
    value = np.asarray(factor.values(np.array([point])), dtype=object).tolist()[0]
    return value if isinstance(value, str) else float(value)


def _flux_mm2(source: GhostSource, paths: tuple[tuple[int, ...], ...]) -> dict[tuple[int, ...], F64]:
    """Return the flux of the ghosts of some paths on the unbounded sensor plane, float64[band] each."""
    return source.model.flux_mm2(*source.sun, paths)


# The stage and the part of it under which the time of these functions is counted.
_STAGES: Mapping[Callable[..., Any], tuple[str, str]] = {
    _flux_mm2: ("ghosts", "single"),
    GlareLayout: ("glare", "layout"),
}


def _mean_of_channels(light: SpreadLight, rates: F64) -> F32:
    """Return light times a rate for each channel, the mean of all, float32[y, x]."""
    return np.asarray((light.planes * rates.astype(np.float32)[:, None, None]).mean(axis=0))


def _added_by(fault: Fault, exposed: Exposed, params: Any) -> dict[str, Any]:
    """Return the fields of `LitImage` that hold the straylight of a model that gives one image."""
    clean = exposed.exposure.rate.scaled(exposed.camera.exposure_s)
    image = fault.on_light(clean, params, exposed.context).merged.array
    added = np.ascontiguousarray(np.moveaxis(image, -1, 0)) - exposed.clean
    light = {"kept": exposed.clean, "direct": exposed.direct_e, "added": np.maximum(added, 0)}
    return {**light, "parts_e": {}, "ghosts_e": ()}
