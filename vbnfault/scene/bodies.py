"""Read the packaged tables of named bodies, whose values become the defaults of a scene that names one."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from pydantic import Field

from ..core import tables
from ..core.errors import InputError, shown
from ..core.files import resources, toml_files
from ..core.tables import Table

# A scene that leaves out `body.name` has this body's values, but Lambert's photometry.
DEFAULT = "67p"
# The keys of [body] that describe a body of the user's own, beside its name.
_OWN_KEYS = {"shape", "semi_axes_m", "density_kg_m3", "rotation_period_h", "reflectance", "photometry"}
_OWN_KEYS |= {"pole_ra_deg", "pole_dec_deg", "prime_meridian_deg", "prime_meridian_deg_day2", "albedo_map"}
# Ratio of `difflib` from which an unknown name counts as a misspelling.
_CLOSE = 0.75


class ShapeFile(Table):
    """Name a published shape model that `vbnfault shape` downloads."""

    url: str = Field(description="address of the file")
    source: str = Field(description="who made the model, and from what")
    sha256: str = Field("", pattern="^([0-9a-f]{64})?$", description="checksum, where somebody published it")
    size_bytes: int = Field(0, ge=0, description="size; 0: unknown")


class BodyFile(Table):
    """Describe a named body: published figures, and the tables of a scene that they set."""

    name: str = Field(description="designation of the body")
    description: str = Field(description="what the body is, in a few words")
    also: tuple[str, ...] = Field((), description="other names")
    mean_radius_m: float = Field(gt=0, description="of a sphere of the body's volume")
    length_m: float = Field(gt=0, description="longest extent")
    mass_kg: float = Field(gt=0, description="mass")
    geometric_albedo: float = Field(gt=0, le=1, description="in V or near 550 nm")
    body: dict[str, Any] = Field(description="defaults of the scene's table [body]")
    orbit: dict[str, Any] | None = Field(None, description="default of the scene's table [orbit]")
    patch: dict[str, Any] = Field(
        default_factory=dict, description="its ground: defaults of the scene's table [patch], with their sources"
    )
    spice: dict[str, Any] = Field(default_factory=dict, description="defaults of the scene's table [spice]")
    shape_file: ShapeFile | None = Field(None, description="a published shape model")


@lru_cache(maxsize=1)
def packaged_bodies() -> Mapping[str, BodyFile]:
    """Return the name of each packaged table, such as "bennu", and the table."""
    return {
        name: tables.parse(BodyFile, toml_files.read_toml(path), source=str(path))
        for name, path in resources.packaged("scenes/bodies").items()
    }


def named_body(name: str) -> BodyFile | None:
    """Return the packaged body of a name, in any case and with or without its number, or None."""
    return packaged_bodies().get(_names().get(_plain(name), ""))


def body_to_download(name: str) -> ShapeFile:
    """Return the published shape model of a packaged body. Raises InputError, which lists the bodies with one."""
    body = named_body(name)
    if body is None and name == packaged_bodies()[DEFAULT].name:
        body = packaged_bodies()[DEFAULT]
    if body is None or body.shape_file is None:
        known = ", ".join(key for key, file in packaged_bodies().items() if file.shape_file is not None)
        raise InputError(f"shape {shown(name)}: no body with a known address of a shape model; known: {known}")
    return body.shape_file


def nearest_body(name: str) -> str:
    """Return the packaged name that an unknown name most resembles, or "" if it resembles none."""
    close = difflib.get_close_matches(_plain(name), list(_names()), n=1, cutoff=_CLOSE)
    return _names()[close[0]] if close else ""


def with_named_body(table: Mapping[str, Any], *, source: str) -> Mapping[str, Any]:
    """Return a scene as plain data, in which the values of the body that it names fill the keys that it leaves out.

    A scene that gives the full name of 67P is the same as one that gives no name: only short names, such as "67P",
    select the table. Raises InputError for a name that is probably a misspelling of a packaged one, in a scene that
    describes no body of its own.
    """
    given = table.get("body")
    name = given.get("name") if isinstance(given, Mapping) else None
    table = _with_ground(table, name)
    if not isinstance(name, str) or not isinstance(given, Mapping) or name == packaged_bodies()[DEFAULT].name:
        return table
    body_file = named_body(name)
    if body_file is None:
        near = nearest_body(name)
        if near and _OWN_KEYS.isdisjoint(given):
            known = ", ".join(packaged_bodies())
            raise InputError(
                f"{source}: body.name = {shown(name)}: no packaged body (did you mean {near}?); known: {known}; "
                "for another body give its own shape, density_kg_m3, rotation_period_h, pole and reflectance"
            )
        return table
    filled = {**table, "body": _filled(given, body_file.body)}
    if body_file.orbit is not None and "orbit" not in table:
        filled["orbit"] = body_file.orbit
    spice = table.get("spice", {})
    if body_file.spice and isinstance(spice, Mapping):
        filled["spice"] = {**body_file.spice, **spice}
    return filled


def _with_ground(table: Mapping[str, Any], name: Any) -> Mapping[str, Any]:
    """Return a scene in which the ground of a packaged body fills the keys of [patch] that it leaves out.

    The body is the one that `patch.preset` names, or else the one that `body.name` does.
    """
    patch = table.get("patch", {})
    preset = patch.get("preset", name) if isinstance(patch, Mapping) else None
    ground = named_body(preset) if isinstance(preset, str) else None
    return table if ground is None or not ground.patch else {**table, "patch": {**ground.patch, **patch}}


def _filled(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table [body] with defaults; keys of `photometry` are joined if both name the same model."""
    filled = {**defaults, **given}
    own, default = given.get("photometry"), defaults["photometry"]
    if isinstance(own, Mapping) and own.get("model", default["model"]) == default["model"]:
        filled["photometry"] = {**default, **own}
    is_ellipsoid = filled.get("shape") == "ellipsoid"
    if not is_ellipsoid and "semi_axes_m" not in given:
        filled.pop("semi_axes_m", None)
    if (not is_ellipsoid or "semi_axes_m" in given) and "relief_m" not in given:
        filled.pop("relief_m", None)  # it fits the axes of the table alone
    return filled


def _plain(name: str) -> str:
    """Return a name in lower case, without the number of an asteroid, brackets and repeated spaces."""
    words = " ".join(name.casefold().split())
    return re.sub(r"^\(?\d+\)? +", "", words) or words


@lru_cache(maxsize=1)
def _names() -> Mapping[str, str]:
    """Return the plain form of every name of a packaged body, and the name of its table."""
    return {
        _plain(name): key
        for key, body in packaged_bodies().items()
        for name in (key, body.name, *body.also)
        if name != packaged_bodies()[DEFAULT].name
    }
