"""Generate the reference pages from the code, so that none of them is typed by hand.

A page under `docs/reference` holds a comment `<!-- generated: NAME -->`. While Sphinx reads the page, the Markdown
of the function that `PAGES` names replaces this comment. Each function returns Markdown and can be called alone.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

_SCENES = Path(__file__).parents[2] / "scenes"

# The unit that the end of a key's name states; the longest one that fits counts.
_UNITS = {
    "_W_m2_nm": "W m⁻² nm⁻¹",
    "_arcsec": "arcsec",
    "_aspheric_mm": "mm⁻³, mm⁻⁵, …",
    "_au": "au",
    "_days": "d",
    "_deg": "°",
    "_deg_day": "°/d",
    "_dn": "DN",
    "_dn_per_e": "DN/e⁻",
    "_dn_rms": "DN",
    "_e": "e⁻",
    "_e_rms": "e⁻",
    "_e_s": "e⁻/s",
    "_eV": "eV",
    "_h": "h",
    "_hz": "Hz",
    "_jd": "d (TDB)",
    "_julian_date": "d (TDB)",
    "_kg_m3": "kg/m³",
    "_krad": "krad",
    "_lsb_rms": "LSB",
    "_m": "m",
    "_magnitude": "mag",
    "_mm": "mm",
    "_cm": "cm",
    "_nA_cm2": "nA/cm²",
    "_nm": "nm",
    "_per_100nm": "1/(100 nm)",
    "_per_km2": "1/km²",
    "_km3": "km³",
    "_per_mm": "1/mm",
    "_percentile": "%",
    "_px": "px",
    "_rad": "rad",
    "_s": "s",
    "_TeV_g": "TeV/g",
    "_um": "µm",
    "_urad": "µrad",
    "_K": "K",
    "_mag_deg": "mag/°",
    "_deg_day2": "°/d²",
    "_years": "a",
    "_fraction_yr": "1/a",
}


def unit_of(key: str) -> str:
    """Return the unit that the end of a key's name states, or "" where it states none."""
    ends = [end for end in _UNITS if f"_{key}".endswith(end)]
    return _UNITS[max(ends, key=len)] if ends else ""


def _cell(text: Any) -> str:
    """Return text that stays within one cell of a Markdown table."""
    parts = re.split(r"(`[^`]*`)", " ".join(str(text).split()))
    return "".join(part if part.startswith("`") else part.replace("*", "\\*") for part in parts).replace("|", "\\|")


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table; columns that are empty in every row are left out."""
    kept = [k for k in range(len(head)) if k == 0 or any(row[k] for row in rows)]
    lines = [[head[k] for k in kept], ["---"] * len(kept), *([_cell(row[k]) for k in kept] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _sentence(text: str) -> str:
    """Return text with a capital letter and a full stop; a symbol or the name of a key keeps its letter."""
    text = text.strip()
    if not text:
        return ""
    first = re.match(r"(?:a |an )?[a-z][a-z'-]+(?= |,|;|:|$)", text)
    if first and first[0] != "none":
        text = text[0].upper() + text[1:]
    return text + ("" if text[-1] in ".!?:" else ".")


def _number(value: float) -> str:
    """Return a limit as a short text."""
    if isinstance(value, int) and value == 2**63 - 1:
        return "2^63 − 1"
    if float(value).is_integer() and abs(value) < 1e9:
        return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.0f}"
    return f"{value:g}".replace("e+0", "e").replace("e+", "e")


def _code(value: Any) -> str:
    """Return a default as code, written as TOML writes it; "" for none."""
    if value is None or value in ([], {}):
        return {"[]": "`[]`"}.get(str(value), "")
    return f"`{json.dumps(value, ensure_ascii=False)}`"


# --- commands ---------------------------------------------------------------------------------------------------


def walk_commands() -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the words of every command behind `vbnfault`, and the command, in alphabetical order."""
    import typer

    from vbnfault import cli

    def walk(words: tuple[str, ...], command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
        inner = getattr(command, "commands", None)
        if inner is None:
            yield words, command
            return
        for name in sorted(inner):
            yield from walk((*words, name), inner[name])

    yield from walk((), typer.main.get_command(cli.app))


def _limits(parameter: Any) -> str:
    """Return the range of a numeric parameter of a command."""
    holder = parameter if hasattr(parameter, "min") else getattr(parameter, "type", None)
    low, high = getattr(holder, "min", None), getattr(holder, "max", None)
    if low is None and high is None:
        return ""
    if high is None:
        return f"at least {_number(low)}"
    return f"{_number(low)} to {_number(high)}" if low is not None else f"at most {_number(high)}"


def commands() -> str:
    """Return every command with its arguments and options."""
    parts = []
    for words, command in walk_commands():
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if p.param_type_name == "option" and p.name != "help"]
        needed = [f"{p.opts[0]} {p.name.strip('_').upper()}" for p in options if p.required]
        names = [f"{a.name.upper()}{'...' if a.nargs != 1 else ''}" for a in arguments]
        usage = " ".join(
            ["vbnfault", *words, *names, *needed, *(["[OPTIONS]"] if len(needed) < len(options) else [])]
        )
        parts.append(
            f"## vbnfault {' '.join(words)}\n\n{inspect.cleandoc(command.help or '')}\n\n```text\n{usage}\n```\n"
        )
        rows = [(f"`{p.name.upper()}`", _sentence(p.help or ""), "", "") for p in arguments]
        for p in options:
            shown = p.opts if p.default is False else (*p.opts, *p.secondary_opts)
            names_shown = " / ".join(f"`{name}`" for name in shown)
            rows.append((names_shown, _sentence(p.help or ""), _option_default(p), _limits(p)))
        if rows:
            parts.append(_table(("argument or option", "meaning", "default", "range"), rows))
    return "\n".join(parts)


def _option_default(option: Any) -> str:
    """Return what an option is if it is not given; "" for a flag that is off."""
    if option.required:
        return "required"
    if isinstance(getattr(option, "show_default", None), str):
        return str(option.show_default)
    if option.default is None or option.default is False or callable(option.default):
        return ""
    if option.default is True:
        return f"`{option.opts[0]}`"
    return _code(option.default if isinstance(option.default, int | float | str | list) else str(option.default))


# --- tables of TOML files, from their JSON Schema -----------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Key:
    """One key of a TOML file."""

    name: str
    default: str
    allowed: str
    meaning: str


@dataclasses.dataclass(frozen=True)
class TomlTable:
    """One table of a TOML file: its header, what it is for, and its keys."""

    header: str
    meaning: str
    keys: tuple[Key, ...]


def tables(schema: Mapping[str, Any], skip: frozenset[str] = frozenset()) -> list[TomlTable]:
    """Return the tables that a JSON Schema describes, the root first, without the keys of the root in `skip`."""
    out: list[TomlTable] = []
    waiting = [("", "", _resolve(schema, schema))]
    while waiting:
        header, dotted, node = waiting.pop(0)
        if header in {table.header for table in out}:
            continue
        keys, inner = [], []
        for key, child in node.get("properties", {}).items():
            if not dotted and key in skip:
                continue
            options = _options(child, schema)
            path = f"{dotted}.{key}" if dotted else key
            inner += [table for option in options for table in _inner_table(path, option, schema)]
            if not all(_inner_table(path, option, schema) for option in options):
                allowed = [_allowed(option, schema) for option in options]
                needed = key in node.get("required", ())
                keys.append(
                    Key(
                        name=key,
                        default="required" if needed else _code(child.get("default")),
                        allowed=" or ".join(dict.fromkeys(filter(None, allowed))),
                        meaning=_resolve(child, schema).get("description", ""),
                    )
                )
        out.append(TomlTable(header, node.get("description", ""), tuple(keys)))
        waiting = inner + waiting
    return out


def _resolve(node: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a node of a JSON Schema with its reference replaced by what it refers to."""
    while "$ref" in node:
        target = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
        node = {**target, **{key: value for key, value in node.items() if key != "$ref"}}
    return node


def _options(node: Mapping[str, Any], schema: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the alternatives of a node of a JSON Schema, without null."""
    node = _resolve(node, schema)
    alternatives = node.get("anyOf") or node.get("oneOf")
    if alternatives:
        return [option for part in alternatives for option in _options(part, schema)]
    return [] if node.get("type") == "null" else [node]


def _inner_table(path: str, node: Mapping[str, Any], schema: Mapping[str, Any]) -> list[tuple[str, str, Any]]:
    """Return header, dotted path and schema of the table that a key holds, in a list; none for a plain value."""
    if "properties" in node:
        model = node["properties"].get("model", {}).get("const")
        return [(f"[{path}] model = {json.dumps(model)}" if model else f"[{path}]", path, node)]
    out = []
    for nested, header, inner in (
        ("items", f"[[{path}]]", path),
        ("additionalProperties", f"[{path}.NAME]", f"{path}.NAME"),
    ):
        child = node.get(nested)
        tables_there = (
            [o for o in _options(child, schema) if "properties" in o] if isinstance(child, Mapping) else []
        )
        for k, table in enumerate(tables_there):
            kind = f" {table.get('title', k + 1)}" if len(tables_there) > 1 else ""
            out.append((f"{header}{kind}", inner, table))
    return out


def _allowed(node: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    """Return in words which values one alternative of a JSON Schema takes."""

    def describe(inner: Mapping[str, Any]) -> str:
        return " or ".join(dict.fromkeys(filter(None, (_allowed(o, schema) for o in _options(inner, schema)))))

    if "const" in node:
        return _code(node["const"])
    if "enum" in node:
        lower = [value for value in node["enum"] if not isinstance(value, str) or value == value.lower()]
        return ", ".join(_code(value) for value in lower or node["enum"])
    kind = node.get("type")
    if kind in ("number", "integer"):
        return _range(node)
    if kind == "boolean":
        return "`true`, `false`"
    if kind == "array":
        if "prefixItems" in node:
            each = list(dict.fromkeys(describe(item) for item in node["prefixItems"]))
            return (
                f"{len(node['prefixItems'])} values, each {each[0]}" if len(each) == 1 else f"[{', '.join(each)}]"
            )
        items = describe(node.get("items", {})) or "any value"
        if node.get("minItems") == node.get("maxItems") == 2:
            return f"2 values, each {items}"
        return f"list, each {items}"
    if kind == "object":
        return "table"
    if "pattern" in node:
        return "a name" if len(node["pattern"]) > 40 else f"text like `{node['pattern']}`"
    return "text" if kind == "string" else ""


def _range(node: Mapping[str, Any]) -> str:
    """Return the range of a number of a JSON Schema."""
    low, high = node.get("minimum", node.get("exclusiveMinimum")), node.get("maximum", node.get("exclusiveMaximum"))
    least = "" if low is None else f"{'above ' if 'exclusiveMinimum' in node else ''}{_number(low)}"
    most = "" if high is None else f"{'below ' if 'exclusiveMaximum' in node else ''}{_number(high)}"
    word = "whole number" if node.get("type") == "integer" else "number"
    if least and most:
        return f"{least} to {most}" if word == "number" else f"{word} {least} to {most}"
    return f"{word}, at least {least}" if least else f"{word}, at most {most}" if most else word


def toml_reference(described: list[TomlTable], root: str) -> str:
    """Return the tables of a TOML file as sections; `root` is the heading of the keys before the first table."""
    parts = []
    for table in described:
        if not table.keys:
            continue
        title = f"`{table.header}`" if table.header else root
        rows = [
            (f"`{key.name}`", _sentence(key.meaning), key.default, unit_of(key.name), key.allowed)
            for key in table.keys
        ]
        meaning = _sentence(table.meaning) if table.header else ""
        parts.append(
            f"## {title}\n\n{meaning}\n\n" + _table(("key", "meaning", "default", "unit", "allowed"), rows)
        )
    return "\n".join(parts)


def scene_tables() -> list[TomlTable]:
    """Return the tables of the scene file, without the faults, which `faults` documents."""
    from vbnfault import faults
    from vbnfault.scene import config

    return tables(config.json_schema(faults.json_schema()), skip=frozenset({"faults"}))


def scene() -> str:
    """Return the keys of the scene file."""
    return toml_reference(scene_tables(), "Top level")


def lens() -> str:
    """Return the keys of a lens file."""
    from vbnfault.core.tables import json_schema
    from vbnfault.lens.prescription_file import PrescriptionFile

    return toml_reference(tables(json_schema(PrescriptionFile)), "Top level")


def sensor() -> str:
    """Return the keys of a sensor file."""
    from vbnfault.core.tables import json_schema
    from vbnfault.detector import Sensor

    return toml_reference(tables(json_schema(Sensor)), "Top level")


def study() -> str:
    """Return the keys of a study file."""
    from vbnfault.core.tables import json_schema
    from vbnfault.study.spec import StudySpec

    return toml_reference(tables(json_schema(StudySpec)), "Top level")


# --- faults -------------------------------------------------------------------------------------------------------


def faults() -> str:
    """Return every fault class with its models and their keys."""
    from vbnfault import faults as registered

    classes = registered.registry()
    keys = {
        name: {node["properties"]["model"]["const"]: node for node in models.get("anyOf", [models])}
        for name, models in registered.json_schema()["properties"].items()
    }
    parts = [_fault_overview(classes)]
    for fault_class, models in classes.items():
        parts.append(f"## {fault_class}\n")
        for model, cls in models.items():
            needs = "a CCD with a mosaic" if cls.needs_ccd else "a detector with a mosaic"
            facts = [f"It acts on: `{'`, `'.join(cls.steps)}`."]
            facts += [f"It needs {needs} (`camera.detector`)."] if cls.needs_mosaic else []
            facts += ["It needs the Sun's position."] if cls.needs_sun else []
            facts += ["Its mask holds the pixels that change."] if cls.effect_mask else []
            facts += [f"Its optional layer is `{cls.soft_layer}`."] if cls.soft_layer else []
            title = f"### {fault_class} / {model}{' (default)' if cls.default and len(models) > 1 else ''}"
            parts.append(f"{title}\n\n{_first_paragraph(cls)}\n\n{' '.join(facts)}\n")
            rows = _fault_keys(keys[fault_class][model])
            parts.append(_table(("key", "meaning", "default", "unit", "allowed"), rows) if rows else "")
    return "\n".join(parts)


def _first_paragraph(cls: type) -> str:
    """Return the first paragraph of a docstring in one line."""
    return " ".join(inspect.cleandoc(cls.__doc__ or "").split("\n\n")[0].split())


def _fault_keys(schema: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the rows of the table of a model's keys, from the JSON Schema of its table."""
    rows = []
    for key, node in schema["properties"].items():
        if key == "model":
            continue
        options = _options(node, schema)
        allowed = " or ".join(dict.fromkeys(_allowed(option, schema) for option in options))
        if len(options) == 2 and options[1].get("type") == "array" and options[0].get("type") != "string":
            allowed = f"one value or [lower, upper], {_allowed(options[0], schema)}"
        meaning, _, unit = node.get("description", "").partition(" [")
        rows.append((f"`{key}`", _sentence(meaning), _code(node.get("default")), unit.rstrip("]"), allowed))
    return rows


def _fault_overview(classes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table of every model and what it does."""
    rows = []
    for fault_class, models in classes.items():
        for model, cls in models.items():
            needs = "CCD" if cls.needs_ccd else "mosaic" if cls.needs_mosaic else ""
            rows.append((f"`{fault_class}` / `{model}`", _first_paragraph(cls), f"`{cls.step}`", needs))
    return _table(("class / model", "what it does", "acts on", "needs"), rows)


# --- the store ----------------------------------------------------------------------------------------------------


def store_arrays() -> dict[str, Any]:
    """Return the schema row of every array that a store may hold, by name; `<fault>` stands for a class."""
    from vbnfault import faults as registered
    from vbnfault import store as stores

    classes = registered.registry()
    soft = {cls.soft_layer: name for name, models in classes.items() for cls in models.values() if cls.soft_layer}
    spec = stores.StoreSpec(
        height=1,
        width=1,
        faults=(*classes, "<fault>"),
        mask_any_faults=(),
        mask_any_joint=True,
        soft_layers=(*(next((s for s, f in soft.items() if f == name), "") for name in classes), ""),
        layers=(*(n for n in stores.LAYERS if n not in stores.REQUIRED_LAYERS), "without_<fault>", *soft),
        wavelength_nm=(550.0,),
    )
    return dict(spec.arrays)


def store() -> str:
    """Return every array of a store with its dimensions, type, unit and meaning."""
    from vbnfault import store as stores

    arrays = store_arrays()
    layers = {n: row for n, row in arrays.items() if {"y", "x"} <= set(row.dims)}
    required = {n: row for n, row in layers.items() if n in stores.REQUIRED_LAYERS}
    optional = {n: row for n, row in layers.items() if n not in required}
    scalars = {n: row for n, row in arrays.items() if n not in layers}

    def rows(part: Mapping[str, Any]) -> str:
        lines = []
        for name, row in part.items():
            meaning = _sentence(row.long_name)
            if row.names:
                kind = "Bits" if row.bits else "Values"
                meaning += f" {kind}: " + ", ".join(f"{k} {flag}" for k, flag in enumerate(row.names)) + "."
            unit = "" if row.units == "1" else row.units
            lines.append((f"`{name}`", meaning, ", ".join(row.dims), row.dtype, unit))
        return _table(("array", "meaning", "dimensions", "type", "unit"), lines)

    return "\n".join(
        [
            f"This vbnfault writes the format version {stores.FORMAT_VERSION}.",
            "\n## Layers that every store has\n",
            rows(required),
            "\n## Optional layers\n\nThe scene key `dataset.layers` names them.\n",
            rows(optional),
            "\n## Values of each sample\n",
            rows(scalars),
        ]
    )


# --- Python -------------------------------------------------------------------------------------------------------


def api() -> str:
    """Return directives that document every public name of `import vbnfault`."""
    import vbnfault

    groups: dict[str, list[str]] = {"Functions": [], "Classes": [], "Errors": [], "Modules": []}
    for name in vbnfault.__all__:
        value = getattr(vbnfault, name)
        if name.startswith("__"):
            continue
        if inspect.ismodule(value):
            groups["Modules"].append(name)
        elif inspect.isclass(value):
            groups["Errors" if issubclass(value, Exception) else "Classes"].append(name)
        else:
            groups["Functions"].append(name)
    parts = []
    for title, names in groups.items():
        parts.append(f"## {title}\n")
        for name in names:
            if title == "Modules":
                parts.append(_module(f"vbnfault.{name}"))
                continue
            kind = "function" if title == "Functions" else "class" if title == "Classes" else "exception"
            members = "" if kind == "function" else "   :members:\n   :exclude-members: model_config\n"
            parts.append(f"```{{eval-rst}}\n.. auto{kind}:: vbnfault.{name}\n{members}```\n")
    return "\n".join(parts)


def _module(name: str) -> str:
    """Return directives that document a module and every name that it exports, functions first."""
    import importlib

    module = importlib.import_module(name)
    lines = [f".. automodule:: {name}", "   :no-members:", ""]
    try:
        exports = {export: getattr(module, export) for export in module.__all__}
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        exports = {}  # an optional library: its how-to page says the same
    for kind, belongs in (("function", inspect.isfunction), ("class", inspect.isclass)):
        for export, value in exports.items():
            if belongs(value):
                members = ["   :members:"] if kind == "class" else []
                lines += [f".. auto{kind}:: {name}.{export}", *members, ""]
    return "```{eval-rst}\n" + "\n".join(lines) + "```\n"


# --- packaged files -----------------------------------------------------------------------------------------------


def catalogue() -> str:
    """Return the packaged scenes, bodies, lenses and detectors with descriptions, and the figures of the scenes."""
    from vbnfault.core.files import resources

    parts = []
    kinds = [("Scenes", "scenes")]
    kinds += [(name.capitalize(), f"scenes/{name}") for name in ("bodies", "lenses", "detectors")]
    for title, folder in kinds:
        rows, figures = [], []
        for file in sorted(resources.data_dir(folder).glob("*.toml")):
            table = tomllib.loads(file.read_text(encoding="utf-8"))
            rows.append(
                (f"`{file.stem}`", table.get("description", table.get("name", "")), table.get("source", ""))
            )
            if (_SCENES / f"{file.stem}.png").exists():
                text = f"Samples of the scene {file.stem}"
                figures.append(f"### {file.stem}\n\n![{text}](../../scenes/{file.stem}.png)\n")
        parts.append(f"## {title}\n\n" + _table(("name", "what it is", "source"), rows))
        parts += figures
    return "\n".join(parts)


PAGES: dict[str, Callable[[], str]] = {
    "api": api,
    "catalogue": catalogue,
    "commands": commands,
    "faults": faults,
    "lens": lens,
    "scene": scene,
    "sensor": sensor,
    "study": study,
    "store": store,
}


def fill(text: str) -> str:
    """Return a page with each comment `<!-- generated: NAME -->` replaced by what its function returns."""
    return re.sub(r"<!-- generated: (\w+) -->", lambda match: PAGES[match[1]](), text)


def setup(app: Any) -> dict[str, Any]:
    """Register the extension with Sphinx."""

    def on_read(_app: Any, docname: str, source: list[str]) -> None:
        if docname.startswith("reference/"):
            source[0] = fill(source[0])

    def outdated(_app: Any, env: Any, *_: Any) -> list[str]:
        return [name for name in env.found_docs if name.startswith("reference/")]

    app.connect("source-read", on_read)
    app.connect("env-get-outdated", outdated)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
