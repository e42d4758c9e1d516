"""Read and check the scene file: one TOML file that defines a whole dataset. Units are in the names of the keys.

Unknown keys, wrong types, reversed bounds and values out of range are refused. The error is one sentence that names
the file, the key, the value and the allowed range. `faults.from_dict` checks the tables under `[faults]`, since
every fault model has its own keys.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from ..core import spectra, tables
from ..core.errors import InputError, in_file, shown, under_key
from ..core.files import path_checks, resources, toml_files
from ..core.quantities import SOFT_KINDS
from ..core.tables import Table
from ..detector.event_camera import EventCamera
from ..reflectance import is_packaged
from .bodies import with_named_body
from .coma import ComaTable
from .events import EventTable
from .instrument import OF_A_SENSOR_FILE, CameraTable, ImageTable, RenderTable
from .motion import MotionTable
from .sampling import DEFAULT_TWINS, OF_AN_AIM, DatasetTable, GeometryTable, PlanTable, StratumTable
from .surroundings import OrbitTable, SkyTable, SpacecraftTable, SpiceTable, SunTable
from .target import EARTH, BodyTable, PatchTable
from .trajectory import TrajectoryTable, with_rows

if TYPE_CHECKING:
    from ..faults import Fault

# Values of body.shape and of spacecraft.model that do not name a file.
_SHAPES = ("embedded", "ellipsoid")
_VEHICLES = ("none", "default")
# The most radiances of a frame (pixels × bands), 4 bytes each. About ten such arrays are in memory at a time.
_MOST_RADIANCES = 2**28


class SeverityLevels(Table):
    """Name the table that the levels of severity are read from."""

    file: str = Field(
        min_length=1,
        description="table of levels, as vbnfault severity writes it, from the scene file's folder; default: the "
        "packaged one",
    )


class Scene(Table):
    """Hold a whole scene file with all defaults filled in."""

    title: str = Field(description="name of the scene")
    description: str = Field("", description="what the scene is for, in a sentence")
    plugins: tuple[Annotated[str, Field(min_length=1)], ...] = Field(
        (),
        max_length=64,
        description="plug-ins that define further faults, ground reflectances and detector effects: names of "
        "modules, and paths of files that end with .py, from the scene file's folder",
    )
    dataset: DatasetTable = DatasetTable()
    body: BodyTable = BodyTable()
    patch: PatchTable = PatchTable()
    coma: ComaTable | None = None
    sun: SunTable = SunTable()
    orbit: OrbitTable | None = None
    spice: SpiceTable = SpiceTable()
    trajectory: TrajectoryTable | None = None
    motion: MotionTable | None = Field(None, description="motion of the camera during an exposure; default: none")
    spacecraft: SpacecraftTable = SpacecraftTable()
    sky: SkyTable = SkyTable()
    camera: CameraTable = CameraTable()
    event_camera: EventCamera | None = Field(
        None, description="pixels of an event camera, for vbnfault event-camera; default: those of its keys"
    )
    image: ImageTable | None = Field(None, description="images of one's own, for vbnfault inject")
    render: RenderTable = RenderTable()
    geometry: GeometryTable = GeometryTable()
    plan: PlanTable = PlanTable()
    faults: dict[str, dict[str, Any]] = Field(default_factory=dict)
    event: tuple[EventTable, ...] = Field(
        (), max_length=64, description="what brings faults at some time of a sequence"
    )
    # when a scene is read, each level is replaced by its value: this table is of no use afterwards
    severity: SeverityLevels | None = Field(None, exclude=True)

    @model_validator(mode="after")
    def _fits(self) -> Scene:
        width_px, height_px, bands = self.camera.width_px, self.camera.height_px, self.render.bands
        if width_px * height_px * bands > _MOST_RADIANCES:
            raise ValueError(
                f"camera.width_px = {width_px}, camera.height_px = {height_px}, render.bands = {bands}: a frame "
                f"has {width_px * height_px * bands} radiances; must be at most {_MOST_RADIANCES}, 1 GiB"
            )
        return self

    @model_validator(mode="after")
    def _one_trajectory(self) -> Scene:
        if self.trajectory is not None and self.spice.spacecraft:
            raise ValueError(
                f"trajectory.{'flight' if self.trajectory.file is None else f'file = {self.trajectory.file!r}'}: "
                f"spice.spacecraft = {self.spice.spacecraft!r} gives poses, too; leave one out"
            )
        return self

    @model_validator(mode="after")
    def _rolls_alone(self) -> Scene:
        if self.motion is not None and self.motion.shutter == "rolling" and self.spacecraft.model != "none":
            raise ValueError(
                f"motion.shutter = 'rolling': spacecraft.model = {self.spacecraft.model!r}: does not apply beside "
                "a spacecraft, which moves with the camera; must be 'global'"
            )
        return self

    @model_validator(mode="after")
    def _dust_reflects(self) -> Scene:
        """Check that ground with the least and the most dust and airfall has an albedo from 0 to 1."""
        photometry, airfall, given = self.body.photometry, self.patch.airfall, self.body.reflectance
        if self.patch.regolith is not None:
            return self
        nm = spectra.band_nodes_nm(self.render.band_min_nm, self.render.band_max_nm, self.render.bands)
        bare = spectra.reflectance(given.model_dump() if isinstance(given, Table) else given, nm)
        relative = 1 + np.outer([-2 * airfall, 0, 1, 1 + 2 * airfall], photometry.contrast_of_dust(nm))
        albedo = bare * relative if photometry.scales_reflectance else relative.clip(max=1)
        if albedo.min() < 0 or albedo.max() > 1:
            raise ValueError(
                f"body.photometry.dust_contrast = {photometry.dust_contrast:g}, dust_slope_per_100nm = "
                f"{photometry.dust_slope_per_100nm:g} and patch.airfall = {airfall:g}: the ground would have "
                f"albedos from {albedo.min():.3g} to {albedo.max():.3g}; must be from 0 to 1: lower one of them"
            )
        return self

    @property
    def frames(self) -> tuple[int, ...]:
        """Return the number of samples of each sequence; () if the samples are not frames of such."""
        if self.image is not None and self.image.frames:  # images of one's own have no poses of a table
            return self.image.frames
        return () if self.trajectory is None else self.trajectory.frames

    @property
    def is_flown(self) -> bool:
        """Return whether poses and Sun are those of a trajectory: of a table of poses, or of SPICE."""
        return self.trajectory is not None or bool(self.spice.spacecraft)

    @property
    def is_aimed(self) -> bool:
        """Return whether the camera aims at what `geometry.aim` names."""
        return self.geometry.aim is not None

    @property
    def exchanges_views(self) -> bool:
        """Return whether samples keep the values that were drawn, and exchange them (`scene.exchange`)."""
        return self.plan.unusable_views == "exchange" and not (self.is_aimed or self.is_flown)

    @model_validator(mode="after")
    def _aimed_alone(self) -> Scene:
        given = self.geometry
        if not self.is_aimed:
            changed = [key for key in OF_AN_AIM if getattr(given, key) != type(given).model_fields[key].default]
            # poses need no aim, and Python may take away the aim of a file that has these keys, too
            if changed and not self.is_flown and "aim" not in given.model_fields_set:
                raise ValueError(
                    f"geometry.{changed[0]} = {shown(getattr(given, changed[0]))}: applies beside geometry.aim "
                    "alone; give geometry.aim, or leave it out"
                )
            return self
        for key in ("x_m", "y_m", "height_m", "height_reference"):
            if getattr(given, key) != type(given).model_fields[key].default:
                raise ValueError(
                    f"geometry.{key} = {shown(getattr(given, key))}: does not apply beside geometry.aim, where "
                    "geometry.distance_m sets the distance; leave it out"
                )
        rivals = {
            "a trajectory": self.is_flown,
            f"plan.pair_strata = {str(self.plan.pair_strata).lower()}": self.plan.pair_strata,
            f"plan.sun_facing_nominal_fraction = {self.plan.sun_facing_nominal_fraction:g}": (
                self.plan.sun_facing_nominal_fraction > 0
            ),
        }
        for rival, is_there in rivals.items():
            if is_there:
                raise ValueError(f"geometry.aim: does not apply beside {rival}; leave one out")
        return self

    @model_validator(mode="after")
    def _strata(self) -> Scene:
        half, full = self.camera.fov_deg / 2, 360.0
        near, far, turn = (-half, half), (half, full - half), (0.0, full)
        paper: dict[str, dict[str, Any]] = {
            "sun_facing": {"sun_elevation_deg": (-30.0, 30.0), "roll_deg": near, "pitch_deg": near},
            "sun_averted": {"sun_elevation_deg": (-30.0, 90.0), "roll_deg": far, "pitch_deg": far},
        }
        strata, unbounded = {}, StratumTable()
        for name, bounds in paper.items():
            given = getattr(self.geometry, name) or unbounded
            bounds |= {"sun_azimuth_deg": turn, "yaw_deg": turn}
            bounds["min_lit_fraction"] = self.geometry.min_lit_fraction
            unset = {key: value for key, value in bounds.items() if getattr(given, key) is None}
            strata[name] = given.model_copy(update=unset)
            # compare values, not whether they were set: the scene of a store has all of them
            if self.is_aimed and strata[name] != unbounded.model_copy(update=bounds):
                raise ValueError(f"geometry.{name}: does not apply beside geometry.aim; leave it out")
        object.__setattr__(self, "geometry", self.geometry.model_copy(update=strata))
        if self.plan.pair_strata and self.geometry.sun_visibility != "as_drawn" and not self.exchanges_views:
            raise ValueError(
                f"plan.pair_strata = true: needs geometry.sun_visibility = 'as_drawn', not "
                f"{self.geometry.sun_visibility!r}, or plan.unusable_views = 'exchange': the Sun of a pair is not "
                "drawn again"
            )
        return self

    def resolved(self) -> dict[str, Any]:
        """Return the whole scene as plain JSON-able data."""
        plain: dict[str, Any] = json.loads(self.model_dump_json())
        return plain

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle a scene whose reflectance comes from a plug-in as plain data, which need no class of it."""
        if is_packaged(type(self.body.photometry)):
            return super().__reduce_ex__(protocol)
        return _restored, (self.resolved(),)


def _restored(plain: dict[str, Any]) -> Scene:
    """Return the scene of plain data in another process, which has to load the scene's plug-ins first."""
    from ..faults import load_plugins

    load_plugins(plain["plugins"])
    return parse_scene(plain, source=plain["title"])


def load_scene(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene by its path or packaged name. Raises InputError.

    `overrides` maps dotted keys, such as `camera.fov_deg`, to values that replace those of the file. A table
    replaces the file's whole table of that name. A relative path in the file (such as a mesh or a texture) starts
    from the file's folder, or from the working folder where nothing lies there. A path in `overrides` starts from
    the working folder.
    """
    scene = read_scene(name_or_path, overrides)
    configure_faults(scene, str(resources.find("scenes", name_or_path)))
    return scene


def read_scene(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Return a scene as `load_scene` does, without a check of its faults, which a study may still change."""
    if not isinstance(overrides, Mapping | None):
        raise InputError(f"overrides = {shown(overrides)}: must be a table of dotted keys and their values")
    path = resources.find("scenes", name_or_path)
    table = toml_files.read_toml(path)
    tables.replace(table, overrides or {}, source=str(path))
    with in_file(str(path)):
        _anchor_paths(table, path.parent, overrides or ())
    scene = parse_scene(table, source=str(path), overrides=tuple(overrides or ()))
    with in_file(str(path)):
        return with_rows(scene)


def parse_scene(table: Mapping[str, Any], *, source: str, overrides: Sequence[str] = ()) -> Scene:
    """Return plain data as a checked scene. Raises InputError; its one sentence names `source`, key and value.

    `overrides` are the dotted keys that replaced values of `source`; the message marks them.
    """
    if "effects" in table:
        raise InputError(
            f"{source}: effects = {shown(table['effects'])}: effects belong in the sensor file, as [effects.NAME]; "
            "name that file by camera.detector"
        )
    camera = table.get("camera")
    for key in OF_A_SENSOR_FILE:
        if isinstance(camera, Mapping) and key in camera:
            mono = '; that of a monochrome camera has pattern = "mono"' if key == "pattern" else ""
            raise InputError(
                f"{source}: camera.{key} = {shown(camera[key])}: is a key of a sensor file, not of [camera]; write "
                f"such a file (vbnfault new sensor NAME) and name it by camera.detector{mono}"
            )
    faults = table.get("faults")
    table = with_named_body(table, source=source)
    of_faults = [f for f in faults.values() if isinstance(f, Mapping)] if isinstance(faults, Mapping) else []
    keys = {key for f in of_faults for key in f}
    if "severity" in {*table, *keys} or any(tables.new_name(key) != key for key in keys if isinstance(key, str)):
        table = _without_levels(table, source, overrides)
    return tables.parse(Scene, table, source=source, overrides=overrides)


def _without_levels(table: Mapping[str, Any], source: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Return the table of a scene with the values that levels of severity stand for. Raises InputError."""
    from ..faults import Levels, without_severity

    faults = table.get("faults", {})
    rest = tables.parse(Scene, {**table, "faults": {}}, source=source, overrides=overrides)
    path = None if rest.severity is None else Path(rest.severity.file)
    levels = Levels(path=path, width_px=rest.camera.width_px)
    if path is not None:
        try:
            _ = levels.table  # a wrong file is refused even if no fault names a level
        except InputError as error:
            raise InputError(f"{source}: severity.file: {error}") from None
    if isinstance(faults, Mapping):
        faults = without_severity(faults, source=source, levels=levels)
    return {key: value for key, value in table.items() if key != "severity"} | {"faults": faults}


def _anchor_paths(table: dict[str, Any], folder: Path, overrides: Collection[str]) -> None:
    """Make relative paths absolute, from the scene file's folder, else from the working folder.

    The paths under the dotted keys `overrides` start from the working folder. Loads the scene's plug-ins, whose
    faults may have keys that hold paths.
    """

    def anchored(path: str, where: str) -> str:
        path_checks.check_path(path, where)
        beside = folder / path
        from_here = where in overrides or path_checks.file_status(beside) is None
        return path_checks.absolute(path if from_here else beside, where)

    def anchor(node: Any, where: str, built_in: tuple[str, ...] = ()) -> None:
        key = where.rsplit(".", 1)[-1]
        if isinstance(node, dict) and isinstance(node.get(key), str) and node[key] not in ("", *built_in):
            node[key] = anchored(node[key], where)
        elif isinstance(node, dict) and isinstance(node.get(key), list):
            node[key] = [anchored(path, where) if isinstance(path, str) and path else path for path in node[key]]

    def anchor_file(node: Any, where: str) -> None:
        key = where.rsplit(".", 1)[-1]
        if isinstance(node, dict) and isinstance(node.get(key), str) and Path(node[key]).suffix:
            anchor(node, where)  # without a suffix it is a packaged name

    anchor(table.get("body"), "body.shape", _SHAPES)
    body = table.get("body")
    anchor(body.get("albedo_map") if isinstance(body, dict) else None, "body.albedo_map.file", (EARTH,))
    anchor(table.get("spacecraft"), "spacecraft.model", _VEHICLES)
    anchor(table.get("severity"), "severity.file")
    anchor_file(table.get("camera"), "camera.lens")
    anchor_file(table.get("camera"), "camera.detector")
    camera = table.get("camera")
    anchor(camera.get("calibration") if isinstance(camera, dict) else None, "camera.calibration.file")
    anchor(table.get("image"), "image.response_file")
    anchor(table.get("trajectory"), "trajectory.file")
    anchor(table.get("spice"), "spice.kernels")
    plugins, faults = table.get("plugins"), table.get("faults")
    if not plugins and not faults:
        return
    from ..faults import load_plugins, path_fields  # here, because a scene without faults needs no optics

    if isinstance(plugins, list) and all(isinstance(name, str) for name in plugins):
        plugins[:] = [anchored(name, "plugins") if name.endswith(".py") else name for name in plugins]
        load_plugins(plugins)
    for name, fault in faults.items() if isinstance(faults, dict) else ():
        for key, packaged in path_fields(name).items():
            (anchor_file if packaged else anchor)(fault, f"faults.{name}.{key}")


def configure_faults(scene: Scene, source: str = "scene") -> dict[str, Fault]:
    """Return the scene's faults in dataset order.

    Parameters
    ----------
    scene
        The scene.
    source
        Name of the scene in messages.

    Raises
    ------
    InputError
        A fault is unknown or does not fit the camera, or the dataset stores a layer that no fault of the scene has.
    """
    from ..faults import dataset_order, from_dict, load_plugins, plugins_of

    with in_file(source):
        load_plugins(scene.plugins)  # a worker has not read the scene file
        parsed = {name: from_dict(name, table, source=source) for name, table in scene.faults.items()}
        faults = {name: parsed[name] for name in dataset_order(parsed)}
        plugins_of(faults, scene.plugins)
        _check_faults(scene, faults)
        _check_layers(scene, faults)
    return faults


def _check_faults(scene: Scene, faults: Mapping[str, Fault]) -> None:
    """Raise InputError if there are too few faults, or if one does not fit the camera."""
    camera, (least, most) = scene.camera, scene.plan.classes_per_sample
    if scene.plan.mode == "per_sample" and faults and least > len(faults):
        raise InputError(
            f"plan.classes_per_sample = [{least}, {most}]: the scene has only {len(faults)} fault classes"
        )
    for number, event in enumerate(scene.event):
        for name in event.faults:
            if name not in faults:
                raise InputError(
                    f"event[{number}].faults: {shown(name)} is no fault class of the scene{_it_has(faults)}"
                )
    if camera.lens:  # a name without a lens is refused before what does not fit to a lens
        with under_key("camera.lens"):
            resources.find("scenes/lenses", camera.lens)
    for name, fault in faults.items():
        where = f"faults.{name}.model = {fault.model!r}"
        if fault.thin_lens_only and camera.lens:
            raise InputError(f"{where}: with camera.lens = {camera.lens!r} {fault.thin_lens_only}")
        if fault.lit_by_surroundings and camera.calibration is not None:
            raise InputError(
                f"{where}: takes light from around the frame, which is rendered for rectilinear cameras only; "
                "leave camera.calibration out, or choose another model or other sources"
            )
        if fault.needs_mosaic and not camera.detector:
            raise InputError(f"{where}: acts inside a detector with a mosaic; name a camera.detector")
        if fault.needs_ccd:
            from ..detector import load_sensor

            with under_key("camera.detector"):
                sensor = load_sensor(camera.detector)
            if sensor.architecture == "cmos":
                raise InputError(
                    f"faults.{name}: acts on charge that a CCD moves, and camera.detector = {camera.detector!r} is "
                    "a CMOS sensor; leave the fault out, or name a CCD"
                )


def _it_has(faults: Mapping[str, Fault]) -> str:
    """Return the clause that lists the fault classes of a scene."""
    return f"; it has {', '.join(faults)}" if faults else "; it has none"


def _check_layers(scene: Scene, faults: Mapping[str, Fault]) -> None:
    """Raise InputError if the dataset stores what the scene's camera and faults do not have."""
    soft = [fault.soft_layer for fault in faults.values() if fault.soft_layer]
    for layer in scene.dataset.layers:
        twin = layer.removeprefix("without_")
        if twin not in (layer, *faults) and layer not in DEFAULT_TWINS:
            raise InputError(f"dataset.layers: {layer!r}: the scene has no such fault")
        if layer.endswith(tuple(f"_{kind}" for kind in SOFT_KINDS)) and layer not in soft:
            known = ", ".join(soft) or "none"
            raise InputError(f"dataset.layers: {layer!r}: no fault of the scene has it; the faults have: {known}")
        if layer in ("raw", "defects") and not scene.camera.detector:
            raise InputError(f"dataset.layers: {layer!r} needs a mosaic: name a camera.detector")
        if layer == "flow" and not (scene.trajectory and scene.trajectory.frames):
            raise InputError(
                "dataset.layers: 'flow' needs the next frame: name a table of poses with a column sequence or "
                "time_s in trajectory.file, or leave it out"
            )
        if layer in ("flow", "point_T_m") and scene.motion is not None and scene.motion.shutter == "rolling":
            raise InputError(
                f"dataset.layers: {layer!r} is that of one pose, and the lines of motion.shutter = 'rolling' have "
                "different ones; leave it out, or choose 'global'"
            )
    for name in scene.dataset.mask_any or ():
        if name not in faults:
            known = ", ".join(faults) or "none"
            raise InputError(f"dataset.mask_any: {name!r}: the scene has no such fault; it has: {known}")


def json_schema(faults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of the scene file; `faults` is the schema of the fault registry."""
    schema = tables.json_schema(Scene)
    return {**schema, "properties": {**schema["properties"], "faults": dict(faults)}}
