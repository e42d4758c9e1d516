"""Define the tables of a scene file for what is around the camera: Sun, orbit, SPICE, sky and spacecraft."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..core.tables import Table
from .target import SpectrumTable

# The most SPICE kernels.
_MOST_KERNELS = 10_000
Cosine = Annotated[float, Field(ge=-1, le=1)]
Offset = Annotated[float, Field(ge=-1e4, le=1e4)]


class SunTable(Table):
    """Set the date of the ephemeris, the Sun's distance (default: from the ephemeris) and its limb darkening."""

    julian_date: float = Field(2456974.0, ge=1_000_000, le=5_000_000, description="TDB; sets the body's attitude")
    distance_au: float | None = Field(
        None, gt=0.01, le=1000, description="of the body from the Sun; default: from the ephemeris"
    )
    limb_darkening: bool = Field(True, description="after Neckel & Labs 1994; else a uniform disc")


class OrbitTable(Table):
    """Describe the body's two-body orbit about the Sun (ecliptic, equinox J2000); default: 67P's orbit of 2015."""

    eccentricity: float = Field(ge=0, le=100, description="1: a parabola, above: a hyperbola")
    perihelion_au: float = Field(gt=0.01, le=1000, description="perihelion distance")
    inclination_deg: float = Field(ge=0, le=180, description="of the orbit to the ecliptic")
    node_deg: float = Field(ge=-360, le=360, description="longitude of the ascending node")
    argument_deg: float = Field(ge=-360, le=360, description="of perihelion")
    perihelion_jd: float = Field(ge=1_000_000, le=5_000_000, description="TDB")
    mean_motion_deg_day: float | None = Field(
        None, gt=0, le=1000, description="of the mean anomaly; default: Kepler's third law; a parabola has none"
    )

    @model_validator(mode="after")
    def _parabola(self) -> OrbitTable:
        if self.eccentricity == 1 and self.mean_motion_deg_day is not None:
            raise ValueError(
                f"mean_motion_deg_day = {self.mean_motion_deg_day:g}: a parabola (eccentricity = 1) has "
                "none; leave it out"
            )
        return self


class SpiceTable(Table):
    """Name SPICE kernels for the Sun's position, the target's attitude and a spacecraft's pose.

    Without kernels, `[orbit]` and `[body]` give the Sun's position and the attitude. With a spacecraft, samples lie
    on its trajectory from `sun.julian_date` to `until_julian_date`. This time is divided equally among the sites;
    `[geometry]`, with its bounds of the Sun, does not apply.
    """

    kernels: tuple[str, ...] = Field(
        (),
        max_length=_MOST_KERNELS,
        description="kernels or meta-kernels (paths in these count from their folder); needs the extra 'spice'",
    )
    target: str = Field("CHURYUMOV-GERASIMENKO", description="SPICE name or number")
    frame: str = Field("", description="body-fixed frame; default: pole and period of [body]")
    spacecraft: str = Field("", description="SPICE name or number of what carries the camera")
    camera_frame: str = Field("", description="the camera's frame, such as ROS_NAVCAM-A")
    camera_axes: tuple[Cosine, Cosine, Cosine, Cosine, Cosine, Cosine, Cosine, Cosine, Cosine] | None = Field(
        None, description="rows of the rotation from image axes (x right, y down, z boresight) to camera_frame"
    )
    until_julian_date: float | None = Field(
        None, ge=1_000_000, le=5_000_000, description="TDB; default: all samples at sun.julian_date"
    )

    @model_validator(mode="after")
    def _served(self) -> SpiceTable:
        if self.frame and not self.kernels:
            raise ValueError(f"frame = {self.frame!r}: needs kernels")
        if self.spacecraft:
            for key in ("kernels", "frame", "camera_frame"):
                if not getattr(self, key):
                    raise ValueError(f"spacecraft = {self.spacecraft!r}: needs {key}")
        elif self.camera_frame or self.camera_axes:
            raise ValueError("camera_frame and camera_axes need spacecraft")
        return self


class BrightBodyTable(Table):
    """Describe a bright body out of the frame, whose light reaches the lens: a planet, or a body of one's own.

    It is a source of straylight if `sources = "scene"`; its image is not drawn.
    """

    planet: Literal["", "mercury", "venus", "earth", "mars", "jupiter", "saturn"] = Field(
        "", description="at its position and brightness of the sample's date; the other keys are for other bodies"
    )
    right_ascension_deg: float | None = Field(None, ge=-360, le=360, description="ICRF, as seen from the target")
    declination_deg: float | None = Field(None, ge=-90, le=90, description="ICRF, as seen from the target")
    of_sunlight: float | None = Field(
        None, gt=0, le=1, description="its irradiance over that of the Sun, both at the target"
    )
    angular_radius_deg: float = Field(0.0, ge=0, le=60, description="of its disc")

    @model_validator(mode="after")
    def _planet_or_own(self) -> BrightBodyTable:
        for key in ("right_ascension_deg", "declination_deg", "of_sunlight"):
            value = getattr(self, key)
            if self.planet and value is not None:
                raise ValueError(f"{key} = {value:g}: does not apply to planet = {self.planet!r}; leave it out")
            if not self.planet and value is None:
                raise ValueError(f"{key}: is missing; a body without planet needs it")
        if self.planet and self.angular_radius_deg:
            raise ValueError(
                f"angular_radius_deg = {self.angular_radius_deg:g}: does not apply to planet = {self.planet!r}; "
                "leave it out"
            )
        return self


class SkyTable(Table):
    """Set which stars the sky shows, and which bright bodies stand beside the target.

    An exposure for a sunlit comet hides stars, so the default is none.
    """

    stars: Literal["off", "auto", "on"] = Field("off", description="auto: those that the exposure can show")
    limiting_magnitude: float = Field(
        7.0, ge=-2, le=7, description="V magnitude of the faintest star that is drawn"
    )
    sigma_px: float = Field(0.6, ge=0, le=16, description="Gaussian point spread of a thin lens")
    bodies: tuple[BrightBodyTable, ...] = Field(
        (), max_length=32, description="bright bodies out of the frame, as sources of straylight; default: none"
    )


class PoseTable(Table):
    """Turn a part about its hinge, in the camera's axes B."""

    hinge_m: tuple[Offset, Offset, Offset] | None = Field(
        None, description="a point of the hinge's axis; the default vehicle has its own"
    )
    axis: tuple[Offset, Offset, Offset] | None = Field(
        None, description="direction of the hinge's axis, of any length; the default vehicle has its own"
    )
    angle_deg: float = Field(0.0, ge=-360, le=360, description="turn about the axis, by the right-hand rule")


Paint = str | Annotated[float, Field(ge=0, le=1)] | SpectrumTable


class SpacecraftTable(Table):
    """Describe the spacecraft that carries the camera, in the camera's axes B (x right, y down, z boresight)."""

    model: str = Field("none", description="'none', 'default' (a lander), or an OBJ or GLB file")
    unit: Literal["m", "cm", "mm"] = Field("m", description="of the model's file")
    roll_deg: float = Field(0.0, ge=-360, le=360, description="turn of the model about x, after pitch and yaw")
    pitch_deg: float = Field(0.0, ge=-360, le=360, description="turn of the model about y, after yaw")
    yaw_deg: float = Field(0.0, ge=-360, le=360, description="turn of the model about z, first")
    translation_m: tuple[Offset, Offset, Offset] = Field(
        (0.0, 0.0, 0.0), description="shift of the turned model: where its origin lies from the camera"
    )
    default_material: Paint = Field(0.3, description="a named material, a grey value, or a table")
    materials: dict[str, Paint] = Field(default_factory=dict, description="by part or material of the file")
    pose: dict[str, PoseTable] = Field(default_factory=dict, description="by part")
