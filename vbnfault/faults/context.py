"""Define what a fault knows of the sample that it acts on."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra
from ..core.quantities import RGBI, Electrons, FarSource, Radiance
from ..core.shared_results import SharedResults
from ..core.sundisc import Pinhole
from ..lens.image_frame import ImageFrame
from .fields import REFERENCE_WIDTH_PX

Params = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameBefore:
    """Hold what a frame of a sequence left behind, without the faults that use a frame before themselves.

    Attributes
    ----------
    image
        The finished image.
    light
        Expected electrons on the sensor, before faults act on them: those that last act in the frame itself.
    held_e
        float32[y, x]: electrons that each pixel held, for a detector with a mosaic.
    end_s
        End of its exposure, in the time of the sequence.
    """

    image: RGBI
    light: Electrons
    held_e: NDArray[np.float32] | None
    end_s: float


@dataclass(frozen=True, kw_only=True, eq=False)
class FaultContext:
    """Describe the sample that a fault acts on.

    The fields of the Sun and of the scene are None where they are unknown, for example for a user's own image
    without a pose.

    Attributes
    ----------
    sun_xy_px
        float64[2]: pixel position of the Sun's centre. It may lie outside the frame. None if the Sun is behind the
        camera.
    sun_direction_C
        float64[3]: unit vector towards the Sun in the camera frame C (x right, y down, z along the boresight).
    sun_irradiance_W_m2_nm, wavelength_nm
        float64[band]: irradiance of the Sun at the camera, and the nodes of its bands.
    sun_visible_fraction
        Fraction of the Sun's disc that is not covered, in [0, 1].
    sun_angular_radius_rad
        Angular radius of the Sun's disc.
    depth_m
        float[y, x]: depth of the scene along the boresight at the pixel centres, inf on the sky.
    up_C
        float64[3]: unit vector in C away from the body, along the vertical of the site.
    radiance
        Radiance of the scene on the grid of its render, that of a pinhole camera with a guard band. None for a
        user's own image.
    surroundings
        Radiance around that render, on the grids of `lens.straylight.scene.surrounding_grids`; empty if no fault of
        the scene needs it.
    far_sources
        Light of bright bodies beside the target; empty if no fault of the scene needs it.
    coating_loss
        Fraction of the coatings' area that another fault of the sample has removed, in [0, 1]. Only a model with
        `Fault.informed` gets it; for the others it is 0.
    time_s
        Time at which the exposure begins in its sequence; None for an image of no sequence.
    before
        Function that makes the frame before this one in its sequence; None if there is none.
    of_view
        Results that all samples of the view share (`dataset.variants_per_view`). What is kept here may depend on
        the camera's lens and on the light of the view; everything else belongs to the key.
    """

    camera: Camera
    sun_xy_px: NDArray[np.float64] | None = None
    sun_direction_C: NDArray[np.float64] | None = None
    sun_irradiance_W_m2_nm: NDArray[np.float64] | None = None
    wavelength_nm: NDArray[np.float64] | None = None
    sun_visible_fraction: float | None = None
    sun_angular_radius_rad: float | None = None
    depth_m: NDArray[np.floating[Any]] | None = None
    up_C: NDArray[np.float64] | None = None
    radiance: Radiance | None = None
    surroundings: tuple[Radiance, ...] = ()
    far_sources: tuple[FarSource, ...] = ()
    coating_loss: float = 0.0
    time_s: float | None = None
    before: Callable[[], FrameBefore] | None = field(default=None, repr=False)
    of_view: SharedResults = field(default_factory=SharedResults, repr=False)
    # `init=False`, because `dataclasses.replace` must not copy results of one frame to another
    _memo: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Return (height, width) in pixels."""
        return self.camera.height_px, self.camera.width_px

    @property
    def sun_before_camera(self) -> NDArray[np.float64] | None:
        """Return a vector towards the Sun in the camera frame C with z > 0, float64[3]; not normalised.

        If no direction is known, the vector is computed from the Sun's pixel position, by the camera's calibration
        or by a pinhole model. Return None if the Sun is behind the camera or unknown.
        """
        direction = self.sun_direction_C
        if direction is None and self.sun_xy_px is not None:
            projection = self.camera.lens.calibration or Pinhole(self.camera.intrinsics)
            direction = projection.directions_of(np.asarray(self.sun_xy_px, dtype=np.float64))
        return direction if direction is not None and direction[2] > 0 else None

    @property
    def sunlight(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return band nodes and the Sun's irradiance in them; if unknown, eight from 400 to 700 nm at 1 au."""
        if self.wavelength_nm is not None and self.sun_irradiance_W_m2_nm is not None:
            return self.wavelength_nm, self.sun_irradiance_W_m2_nm
        nodes = spectra.band_nodes_nm(400.0, 700.0, 8)
        return nodes, spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)

    @property
    def sun_visible(self) -> float:
        """Return the visible fraction of the Sun's disc; 1 if it is unknown."""
        return 1.0 if self.sun_visible_fraction is None else float(self.sun_visible_fraction)

    @property
    def scale(self) -> float:
        """Return the factor that converts pixels of a 1024 px wide image to pixels of this camera."""
        return self.camera.width_px / REFERENCE_WIDTH_PX

    @property
    def frame(self) -> ImageFrame:
        """Return the lens and the image size of the camera, as ray tracing needs them."""
        return ImageFrame(
            lens=self.camera.lens,
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            pixel_pitch_um=self.camera.detector.pixel_pitch_um,
            changes=self.camera.lens_changes,
        )

    def once(self, function: Callable[..., T], params: Params, *more: Any) -> T:
        """Return `function(params, self, *more)`, computed once for each function and content of its arguments.

        `apply` and `footprint` share the result, so an expensive computation runs only once.
        """
        owner = getattr(function, "__self__", None)  # the model of a method, whose keys count too
        key = function.__module__, function.__qualname__, pickle.dumps((owner, params, more))
        if key not in self._memo:
            self._memo[key] = function(params, self, *more)
        result: T = self._memo[key]
        return result
