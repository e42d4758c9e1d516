"""Check the types of a store's root attributes, so that what reads them may rely on these."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from typing import Any

from ..core.errors import InputError, shown, without_middle
from ..core.process.environment import MOST_SAMPLES
from ..core.quantities import SOFT_KINDS

# Dotted keys of the root attributes that are tables wherever they are present; * stands for every key of a table.
_TABLES = (
    "optics",
    "detector",
    "detector.sensor",
    "detector.sensor.sources",
    "retake",
    "retake.source",
    "versions",
    "fault_models",
    "scene",
    "scene.faults",
    "scene.faults.*",
    "scene.plugins",
    "scene.plugins.*",
    "scene.body",
    "scene.body.photometry",
    *(f"scene.{table}" for table in ("camera", "dataset", "geometry", "plan", "sky", "spice")),
)
# Types of the fields of `StoreSpec`, and of the elements of its tuples → what they are in JSON, and in words.
_TYPES: dict[str, tuple[tuple[type, ...], str]] = {
    "str": ((str,), "a text"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a number"),
    "bool": ((bool,), "true or false"),
    "Mapping": ((dict,), "a table"),
}
# What else holds for the values of some fields of `StoreSpec`, and in words; a scene has fewer pixels.
_MOST_PIXELS, _MOST_RENDERED, _MOST_WISHED = 32768, 65536, 2**31
_RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "height": (lambda n: 1 <= n <= _MOST_PIXELS, f"be from 1 to {_MOST_PIXELS}"),
    "width": (lambda n: 1 <= n <= _MOST_PIXELS, f"be from 1 to {_MOST_PIXELS}"),
    "shard_samples": (lambda n: 0 <= n <= _MOST_WISHED, f"be from 0 to {_MOST_WISHED}"),
    "distortion_residual_px": (lambda pair: len(pair) == 2, "have 2 elements"),
    "coefficients": (lambda names: 1 <= len(names) <= 32, "have from 1 to 32 elements"),
    "centre_of_mass_T_m": (lambda vector: vector is None or len(vector) == 3, "have 3 elements"),
    "attitude_references": (
        lambda names: len(names) == 2 and {*names} <= {"sun", "nadir", "centre"},
        "be 2 of sun, nadir and centre",
    ),
    "rendered_shape": (
        lambda shape: len(shape) in (0, 2) and all(0 < n <= _MOST_RENDERED for n in shape),
        f"be 2 numbers from 1 to {_MOST_RENDERED}",
    ),
}
# The most flags that the samples have together, one for each sample and class.
_MOST_FLAGS = 2**28
# Fields of `StoreSpec` that become names of arrays, of folders and of files of an export.
_NAMES = ("faults", "soft_layers")
# Fields and root attributes that are shown as texts, and of those the ones that may have several lines.
_TEXTS = (
    "coefficients",
    "mask_kinds",
    "mask_rules",
    "site_names",
    "lens_names",
    "detector_names",
    "sample_names",
    "sequence_names",
)
_TEXTS_OF_ROOT = ("title", "licence", "description", "citation", "intensity_channel", "scene_hash", "command")
_OF_LINES = ("description", "citation", "mask_rules", "command")
_NAME = re.compile("[a-z][a-z0-9_]{0,127}")
_MOST_CLASSES, _LONGEST_TEXT = 1024, 65536
# Fields of `StoreSpec` with one element for each class, or none.
_OF_CLASSES = ("mask_kinds", "mask_rules", "soft_layers")


def check_attributes(attributes: Mapping[str, Any]) -> None:
    """Raise InputError where a root attribute of a store is not of the type that vbnfault writes."""
    for path in _TABLES:
        for key, value in _values_at(attributes, path.split(".")):
            if not isinstance(value, dict):
                raise InputError(f"{without_middle(key)} = {shown(value)}: must be a table")
    for path in ("fault_models.*", "scene.faults.*.model"):
        for key, value in _values_at(attributes, path.split(".")):
            if not isinstance(value, str):
                raise InputError(f"{without_middle(key)} = {shown(value)}: must be a text")
    _check_blocks(attributes.get("blocks", [1]))
    notes = attributes.get("versions_of_samples", [])
    if not isinstance(notes, list) or not all(
        isinstance(n, dict) and {"versions", "samples"} <= {*n} for n in notes
    ):
        raise InputError(
            f"versions_of_samples = {shown(notes)}: must be a list of tables with versions and samples"
        )
    if "retake" in attributes:
        _check_retake(attributes["retake"])


def number_of_samples(attributes: Mapping[str, Any]) -> int:
    """Return how many samples the root attributes of a store count. Raises InputError if that is no such number."""
    samples = attributes["samples"]
    if type(samples) is not int or not 0 <= samples <= MOST_SAMPLES:
        raise InputError(f"samples = {shown(samples)}: must be a whole number from 0 to {MOST_SAMPLES}")
    return samples


def check_names(spec: Any, samples: int) -> None:
    """Raise InputError unless the names and texts of a `StoreSpec` can stand in paths, pages and files of exports.

    What names an array, a folder or a file is lower-case letters, digits and underscores. Every other text can be
    printed.
    """
    for field in _NAMES:
        for name in getattr(spec, field):
            if not _NAME.fullmatch(name) and (name or field == "faults"):
                raise InputError(
                    f"store.{field} = {shown(name)}: must be at most 128 lower-case letters, digits, underscores "
                    "and begin with a letter"
                )
    for name in filter(None, spec.soft_layers):
        if name.rpartition("_")[2] not in SOFT_KINDS:
            raise InputError(f"store.soft_layers = {shown(name)}: must end in {' or '.join(SOFT_KINDS)}")
    for field in ("faults", "layers"):
        values = getattr(spec, field)
        if len(values) > _MOST_CLASSES or len({*values}) < len(values):
            raise InputError(f"store.{field}: must be at most {_MOST_CLASSES} different names")
    if samples * len(spec.faults) > _MOST_FLAGS:
        raise InputError(
            f"samples = {samples}: must be at most {_MOST_FLAGS // len(spec.faults)} with so many classes"
        )
    texts = [(f"store.{field}", text) for field in _TEXTS for text in getattr(spec, field)]
    for key in _TEXTS_OF_ROOT:
        text = spec.attributes.get(key)
        if text is not None and not isinstance(text, str):
            raise InputError(f"{key} = {shown(text)}: must be a text")
        texts.append((key, text or ""))
    for key, text in texts:
        lines = text.replace("\n", "").replace("\t", "") if key.rpartition(".")[2] in _OF_LINES else text
        if not lines.isprintable() or len(text) > _LONGEST_TEXT:
            raise InputError(
                f"{key} = {shown(text)}: must be a text of printable characters, at most {_LONGEST_TEXT}"
            )


def _values_at(table: Mapping[str, Any], path: list[str], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the value of every entry of a table at a path, where there is one."""
    first, *rest = path
    for key in table if first == "*" else {first} & {*table}:
        where, value = f"{above}{key}", table[key]
        if not rest:
            yield where, value
        elif isinstance(value, dict):
            yield from _values_at(value, rest, f"{where}.")


def _check_blocks(blocks: Any) -> None:
    """Raise InputError unless the blocks of a store are a list of numbers of samples."""
    if not isinstance(blocks, list) or not blocks or not all(type(n) is int and n > 0 for n in blocks):
        raise InputError(f"blocks = {shown(blocks)}: must be a list of whole numbers above 0")


def _check_retake(retake: Mapping[str, Any]) -> None:
    """Raise InputError unless `retake` says which samples of which store were taken, and how often."""
    repeats, ranges = retake.get("repeats"), retake.get("samples")
    if type(repeats) is not int or repeats < 1:
        raise InputError(f"retake.repeats = {shown(repeats)}: must be a whole number above 0")
    if not isinstance(ranges, list) or not all(
        isinstance(r, list) and len(r) == 2 and all(type(n) is int for n in r) for r in ranges
    ):
        raise InputError(f"retake.samples = {shown(ranges)}: must be a list of pairs of whole numbers")
    if not isinstance(retake.get("source"), dict) or not isinstance(retake["source"].get("faults"), list):
        raise InputError("retake.source: must be a table with faults")
    check_attributes(retake["source"])


def check_plain_spec(plain: Any, spec: type) -> None:
    """Raise InputError where the root attribute `store` is not what `StoreSpec.plain` returns."""
    if not isinstance(plain, dict):
        raise InputError(f"store = {shown(plain)}: must be a table")
    for field in fields(spec):
        if field.name not in plain:
            continue
        value = plain[field.name]
        start = f"store.{field.name} = {shown(value)}: must"
        if words := _wrong_type(str(field.type), value):
            raise InputError(f"{start} be {words}")
        holds, words = _RULES.get(field.name, (lambda _: True, ""))
        if not holds(value):
            raise InputError(f"{start} {words}")
        if field.name in _OF_CLASSES and len(value) not in (0, count := len(plain.get("faults", ()))):
            raise InputError(f"{start} have {count} elements")


def _wrong_type(kind: str, value: Any) -> str:
    """Return in words which type a value should have, as it is written in `StoreSpec`; "" if it has that."""
    optional, element = kind.endswith(" | None"), kind.removeprefix("tuple[")
    types, words = next(known for name, known in _TYPES.items() if element.startswith(name))
    is_list = element != kind
    if value is None and optional:
        return ""
    if is_list and isinstance(value, list | tuple) and all(type(one) in types for one in value):
        return ""
    if not is_list and type(value) in types:
        return ""
    words = f"a list, each {words}" if is_list else words
    return f"{words}, or null" if optional else words
