"""Draw the commanded faults of a sample so that each is visible in its image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..faults import FaultContext, FrameBefore
from .development import Development, Draws, informs, without
from .spec import Draw, Drawing, Injection, Pose, Rendering, SampleSpec, SceneExposure, is_state, stored_layers

_DRAW_TRIES = 8
# A fault that changes the light by less than a count moves the noise-free image across a few roundings. The image
# with noise rounds elsewhere: as many of its pixels are expected to change, but where these are few, none may.
_FEW_PX, _MORE_THAN_ROUNDING_DN = 32, 2.0


def inject_faults(
    spec: SampleSpec,
    pose: Pose,
    rendering: Rendering,
    exposure: SceneExposure,
    views: int = 1,
    commanded: Sequence[str] | None = None,
    *,
    redrawn: bool = False,
    before: Callable[[], FrameBefore] | None = None,
) -> Injection:
    """Draw the commanded faults of a sample. `views` is the number of its views that were rendered so far.

    `commanded` are the faults; by default those that the plan commands. `before` makes the frame before in a
    sequence. With `redrawn`, nothing is drawn in a view in whose place another one is needed in any case
    (`asking_for_another_view`).

    A fault without a visible effect is drawn again a few times, then left out. So the result holds the faults that
    are in the image, and labels never claim more. A state of the instrument is not drawn again in a sequence.
    """
    commanded = list(spec.commanded if commanded is None else commanded)
    if not pose.resolved or pose.sun_visible_fraction == 0:
        commanded = [name for name in commanded if not spec.faults[name].needs_sun]
    development = Development(
        exposure=exposure,
        context=replace(fault_context(pose, rendering, exposure), before=before),
        rng=spec.rng,
        twins=[name for name in spec.faults if f"without_{name}" in stored_layers(spec.scene, spec.faults)],
    )
    in_vain = _in_vain(spec, development, commanded)
    if redrawn and asking_for_another_view(spec, in_vain):
        return Injection(draws={}, development=development, in_vain=in_vain)
    commanded = [name for name in commanded if name not in in_vain]
    draws = visible_draws(spec, development, commanded, views)
    return Injection(draws=draws, development=development, in_vain=in_vain)


def visible_draws(
    spec: Drawing, development: Development, commanded: Sequence[str], views: int = 1
) -> dict[str, Draw]:
    """Return draws of the faults that each change the image; a fault that none of a few draws shows is left out.

    `views` is as for `inject_faults`.
    """
    # every view uses new draws: a draw that is invisible in one view is not tried again in the next
    attempt = (views - 1) * _DRAW_TRIES
    last = attempt + _DRAW_TRIES - 1
    draws = draw_faults(spec, development, commanded, {}, attempt)
    while invisible := _invisible(development, draws):
        draws = {name: draw for name, draw in draws.items() if name not in invisible}
        attempt += 1
        if attempt <= last:
            # what one image of a sequence does not show stays as it is: others may show it
            again = [name for name in commanded if not (spec.shares_state and is_state(spec, name))]
            draws = draw_faults(spec, development, again, draws, attempt)
    return draws


def asking_for_another_view(spec: SampleSpec, unseen: Sequence[str]) -> list[str]:
    """Return those of the faults that are not in the image for which another view of the sample may be tried."""
    scene = spec.scene
    if scene.plan.on_invisible == "drop" or scene.is_flown:
        return []
    # with "as_drawn" the Sun may be hidden, so faults that need it may be absent
    as_drawn = scene.geometry.sun_visibility == "as_drawn"
    return [name for name in unseen if not (as_drawn and spec.faults[name].needs_sun)]


def _in_vain(spec: SampleSpec, development: Development, commanded: Sequence[str]) -> list[str]:
    """Return the commanded faults that need light, if neither the scene nor another fault sends any."""
    optical = [name for name in commanded if spec.faults[name].step == "electrons"]
    if not optical or not all(spec.faults[name].needs_light for name in optical):
        return []
    if development.signal({}, []).merged.array.any():
        return []
    return [name for name in optical if spec.faults[name].steps == ("electrons",)]  # later steps may show


def fault_context(pose: Pose, rendering: Rendering, exposure: SceneExposure) -> FaultContext:
    """Return the context of the sample that its faults receive."""
    direction_C = pose.L_from_C.T @ pose.sun_L
    sunlight = rendering.scene.sun
    return FaultContext(
        camera=exposure.camera,
        sun_xy_px=exposure.camera.project(direction_C),
        sun_direction_C=direction_C,
        sun_irradiance_W_m2_nm=sunlight.irradiance_W_m2_nm,
        wavelength_nm=exposure.light.rendered.wavelength_nm,
        sun_angular_radius_rad=sunlight.angular_radius_rad,
        sun_visible_fraction=pose.sun_visible_fraction,
        depth_m=rendering.truth.depth_m,
        up_C=-pose.L_from_C[2],
        radiance=exposure.light.rendered,
        surroundings=rendering.surroundings,
        far_sources=rendering.far_sources,
        time_s=None if pose.time_s is None else pose.time_s - exposure.camera.exposure_s / 2,
        of_view=rendering.shared,
    )


def draw_faults(
    spec: Drawing, development: Development, commanded: Sequence[str], draws: Draws, attempt: int
) -> dict[str, Draw]:
    """Return the draws, and a new one for each commanded fault without a draw; those that inform others first."""
    complete = dict(draws)
    for name in sorted(commanded, key=lambda n: not informs(spec.faults[n])):
        if name not in complete:
            fault = spec.faults[name]
            context = development.context_of(fault, complete)
            params = fault.draw(context, spec.rng("fault", f"{name}/{attempt}"))
            complete[name] = Draw(fault=fault, attempt=attempt, params=fault.grown(params, spec.fraction(name)))
    return complete


# --- visibility --------------------------------------------------------------------------------------------


def _invisible(development: Development, draws: Draws) -> list[str]:
    """Return the drawn faults without any effect on the noise-free image, or on the one with noise."""
    # without a fault that informs others, their light is computed anew, with much memory
    last = [name for name in draws if informs(draws[name].fault)]
    invisible = [name for name in draws if name not in last and _is_invisible(development, draws, name)]
    if last:
        development.forget_steps(draws)
        invisible += [name for name in last if _is_invisible(development, draws, name)]
    return invisible


def _is_invisible(development: Development, draws: Draws, name: str) -> bool:
    """Return whether no pixel of the noise-free image changes without a drawn fault, or none of that with noise."""
    level = draws[name].fault.effect_level_dn
    pixels = int(np.count_nonzero(development.effect(draws, name, level)))
    if not 0 < pixels <= _FEW_PX or level >= _MORE_THAN_ROUNDING_DN:
        return pixels == 0
    if development.effect(draws, name, _MORE_THAN_ROUNDING_DN).any():
        return False
    return np.array_equal(development.image(draws).array, development.image(without(draws, name)).array)
