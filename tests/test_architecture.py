"""Who may import whom: the table of modules, kept by reading the sources."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import vbnfault

ROOT = Path(vbnfault.__file__).parent


def documented_imports() -> dict[str, set[str]]:
    """Return the packages that each row of CONTRIBUTING's table lets its package import, `core` included."""
    text = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.partition("| package |")[2].partition("\n\n")[0]
    rows = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("| `")]
    assert all(len(cells) == 4 for cells in rows)
    meaning = text.partition("Words in capitals stand for several packages: ")[2].partition("\n\n")[0]
    groups: dict[str, set[str]] = {}

    def packages(cell: str) -> set[str]:
        return set(re.findall(r"`(\w+)`", cell)).union(*(groups[word] for word in re.findall("[A-Z]{2,}", cell)))

    for words, members in re.findall(r"([A-Z]+) for ([^;]+)", meaning):
        groups[words] = packages(members)
    names = [re.findall(r"\w+", cells[0])[0] for cells in rows]
    assert len(set(names)) == len(names)
    return {name: packages(cells[3]) | {"core"} for name, cells in zip(names, rows, strict=True)}


# Package of vbnfault → the packages that it may import. Data flows one way: the rows of the page are in an order in
# which every package stands above those that it imports; a new package has to be given its place there.
MAY_IMPORT = documented_imports()

ONLY = {  # distribution → the packages or modules that import it
    "mitsuba": {"render"},
    "drjit": {"core.process.llvm", "render"},
    "zarr": {"store"},
    "numcodecs": {"store"},
    "obstore": {"store.bucket"},
    "dask": {"dataset.dask"},
    "distributed": {"dataset.dask"},
    "torch": {
        "detect.losses",
        "detect.model_files",
        "detect.networks",
        "detect.training",
        "detect.training_data",
        "inject.transform",
        "train.datasets",
        "train.loader",
        "train.slots",
        "train.windows",
    },
    "torchvision": {"detect.networks"},
    "onnxruntime": {"detect.model_files"},
    "typer": {"cli"},
    "pyarrow": {"core.files.column_files", "output.event_files", "output.export.formats.huggingface", "study"},
    "SALib": {"study"},
    "sklearn": {"fit.two_samples"},
    "spiceypy": {"core.files.spice"},
    "h5py": {"output.event_files"},
    "OpenEXR": {"core.files.images"},
    "tifffile": {"core.files.tiff"},
    "astropy": {"inject.files"},
    "av": {"core.files.films"},
    "pdr": {"inject.planetary"},
    "pds4_tools": {"inject.planetary"},
}


@dataclass(frozen=True)
class Import:
    """One import statement: of `target` (dotted), by `module` (dotted, within vbnfault), where and when."""

    module: str
    target: str
    line: int
    at_load: bool  # run when the module is loaded: neither in a function nor for the type checker only

    @property
    def unit(self) -> str:
        return self.module.split(".")[0]

    @property
    def target_unit(self) -> str | None:
        parts = self.target.split(".")
        return (parts[1] if len(parts) > 1 else "__init__") if parts[0] == "vbnfault" else None


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


@cache
def sources() -> dict[str, ast.Module]:
    return {module_name(p): ast.parse(p.read_text(encoding="utf-8")) for p in sorted(ROOT.rglob("*.py"))}


def is_module(dotted: str) -> bool:
    parts = dotted.split(".")[1:]
    return ROOT.joinpath(*parts).is_dir() or ROOT.joinpath(*parts).with_suffix(".py").is_file()


def targets(node: ast.Import | ast.ImportFrom, module: str) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    base = node.module or ""
    if node.level:
        inside = ["vbnfault"] if module == "__init__" else ["vbnfault", *module.split(".")]
        package = inside if ROOT.joinpath(*inside[1:]).is_dir() else inside[:-1]
        package = package[: len(package) - (node.level - 1)]
        base = ".".join([*package, base] if base else package)
    for alias in node.names:  # `from . import plan` imports a module, `from .plan import Plan` a name of one
        dotted = f"{base}.{alias.name}"
        yield dotted if dotted.startswith("vbnfault.") and is_module(dotted) else base


def imports_of(module: str) -> Iterator[Import]:
    def walk(node: ast.AST, at_load: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import | ast.ImportFrom):
                for target in targets(child, module):
                    yield Import(module, target, child.lineno, at_load)
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
                for part in child.body:
                    yield from walk(ast.Module([part], []), False)
                yield from walk(ast.Module(child.orelse, []), at_load)
            else:
                inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                yield from walk(child, at_load and not inside)

    return walk(sources()[module], True)


@cache
def imports() -> tuple[Import, ...]:
    return tuple(i for module in sources() for i in imports_of(module))


# ------------------------------------------------------------------------------------ the reading itself


def test_the_walk_reads_every_form_of_import() -> None:
    found = {(i.module, i.target, i.at_load) for i in imports()}
    assert ("scene.plan", "vbnfault.scene.config", True) in found  # from . import config
    assert ("scene.plan", "vbnfault.core.errors", True) in found  # from ..core.errors import InputError
    assert ("pipeline.spec", "vbnfault.render.description", True) in found  # from ..render.description import …
    assert ("faults.contract", "vbnfault.camera", True) in found  # from ..camera import Camera
    assert ("body.patch", "vbnfault.body.noise", True) in found  # from vbnfault.body.noise import …
    assert ("pipeline.resolve", "vbnfault.render", False) in found  # within a function
    assert ("render.runtime", "mitsuba", True) in found  # import mitsuba as mi
    assert len(sources()) > 30


# ------------------------------------------------------------------------------------ the table


def test_every_module_has_its_place_in_the_table() -> None:
    assert {module.split(".")[0] for module in sources()} == set(MAY_IMPORT)


def test_the_top_folder_holds_packages_only() -> None:
    assert {path.name for path in ROOT.glob("*.py")} == {"__init__.py", "__main__.py"}


@pytest.mark.parametrize("unit", sorted(MAY_IMPORT))
def test_imports_keep_to_the_table(unit: str) -> None:
    allowed = MAY_IMPORT[unit] | {unit, "__init__"}
    wrong = [
        f"vbnfault/{i.module.replace('.', '/')}.py:{i.line} imports {i.target}"
        for i in imports()
        if i.unit == unit and i.target_unit is not None and i.target_unit not in allowed
    ]
    assert not wrong


def test_no_private_name_crosses_a_package() -> None:
    private = [
        f"vbnfault/{module.replace('.', '/')}.py:{node.lineno} imports {alias.name}"
        for module, tree in sources().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.level > 1 or (node.module or "").startswith("vbnfault"))
        for alias in node.names
        if alias.name.startswith("_") and not alias.name.endswith("__")
    ]
    assert not private


@pytest.mark.parametrize("library", ONLY)
def test_only_one_unit_imports(library: str) -> None:
    wrong = [
        f"vbnfault/{i.module.replace('.', '/')}.py:{i.line}"
        for i in imports()
        if i.target.split(".")[0] == library and not {i.unit, i.module} & ONLY[library]
    ]
    assert not wrong


def requirements() -> list[Requirement]:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [Requirement(line) for line in project["dependencies"]]


def test_every_required_package_that_is_imported_is_declared() -> None:
    """And the next versions are refused that rename what is used here: Mitsuba 3.10 has other meshes."""
    declared = {required.name: required.specifier for required in requirements()}
    imported = {i.target.partition(".")[0] for i in imports() if i.target_unit is None}
    names = importlib.metadata.packages_distributions()
    needed = {name.replace("_", "-") for module in imported for name in names.get(module, [])}
    optional = {
        "SALib",
        "astropy",
        "av",
        "dask",
        "distributed",
        "h5py",
        "obstore",
        "onnxruntime",
        "onnxscript",
        "pdr",
        "pds4-tools",
        "scikit-learn",
        "spiceypy",
        "torch",
        "torchvision",
        "vbnfault",
    }
    assert needed - optional <= declared.keys() | {"pydantic-core"}  # pydantic requires one version of it
    for name, version in (("mitsuba", "3.10.0"), ("drjit", "1.6.0"), ("zarr", "4.0.0"), ("pydantic", "3.0.0")):
        assert version not in declared[name]
        assert importlib.metadata.version(name) in declared[name]


def test_an_installation_needs_no_compiler() -> None:
    """Numba and its LLVM are 208 MB."""
    found, left = set[str](), [required.name for required in requirements()]
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            asked = [Requirement(line) for line in importlib.metadata.requires(name) or []]
            left += [r.name for r in asked if r.marker is None or r.marker.evaluate({"extra": ""})]
    assert {"pandas", "networkx"} <= found  # of xarray and scikit-image
    assert not found & {"numba", "llvmlite", "torch", "astropy"}


def fault_files() -> set[str]:
    """Modules of `faults` that define a model: a class with a `model` of its own."""
    return {
        module
        for module, tree in sources().items()
        if module.startswith("faults.")
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        and any(isinstance(a, ast.Assign) and getattr(a.targets[0], "id", "") == "model" for a in node.body)
    }


# What every fault builds upon: none of these files knows a single fault.
CONTRACT = {f"faults.{name}" for name in ("context", "contract", "fields", "models", "planes")}


def test_faults_import_no_other_fault() -> None:
    files = fault_files()
    assert {"faults.straylight", "faults.dust", "faults.vignetting"} <= files
    wrong = [
        f"{i.module} imports {i.target}"
        for i in imports()
        if i.module in files | CONTRACT and i.target.removeprefix("vbnfault.") in files - {i.module}
    ]
    assert not wrong


# The only places outside faults/ that know a fault: the default layers, whose names are a contract with all readers
# of a store, and the figures of flares, which are about straylight alone.
KNOW_A_FAULT = {"scene.sampling": {"without_straylight"}, "output.flare_images": {"straylight"}}


def texts(tree: ast.Module) -> list[ast.Constant]:
    """The string constants of a module, without its docstrings."""
    bodies = [getattr(node, "body", None) for node in ast.walk(tree)]
    first = [body[0] for body in bodies if isinstance(body, list) and body]
    docstrings = {id(node.value) for node in first if isinstance(node, ast.Expr)}
    strings = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [node for node in strings if id(node) not in docstrings]


def test_no_fault_has_a_name_outside_faults() -> None:
    """What sets a fault apart is said by the attributes of its class, so that a plug-in can say it, too."""
    from vbnfault.faults import registry

    classes = set(registry())
    pattern = re.compile(rf"\bfaults\.({'|'.join(classes)})\b")
    # a class of one word, such as smear, has the name of its physics, which detector and lens name, too
    names = {name for name in classes if "_" in name} | {"straylight", "vignetting", "cos4", "texture_file"}
    names |= {f"without_{name}" for name in classes}
    wrong = [
        f"vbnfault/{module.replace('.', '/')}.py:{node.lineno} names {node.value!r}"
        for module, tree in sources().items()
        if module.split(".")[0] != "faults"
        for node in texts(tree)
        if (node.value in names or pattern.search(node.value)) and node.value not in KNOW_A_FAULT.get(module, ())
    ]
    assert not wrong
    files = fault_files()
    imported = [i for i in imports() if i.unit != "faults" and i.target.removeprefix("vbnfault.") in files]
    assert not imported


# ------------------------------------------------------------------------------------ cycles


def assert_no_cycle(edges: dict[str, set[str]]) -> None:
    try:
        tuple(TopologicalSorter(edges).static_order())
    except CycleError as error:
        pytest.fail("import cycle: " + " → ".join(error.args[1]))


def test_no_cycles_between_units() -> None:
    units: dict[str, set[str]] = {}
    for i in imports():  # lazy and type-only imports included
        # the top `__init__` names what users may call, and all may take the version from it
        if i.target_unit not in (None, i.unit) and "__init__" not in (i.unit, i.target_unit):
            units.setdefault(i.unit, set()).add(str(i.target_unit))
    assert len(units) > 10
    assert_no_cycle(units)


def test_no_cycles_between_modules_as_they_load() -> None:
    modules: dict[str, set[str]] = {}
    for i in imports():
        target = i.target.removeprefix("vbnfault.")
        if i.at_load and i.target_unit is not None and target != i.module:
            modules.setdefault(i.module, set()).add(target)
    assert_no_cycle(modules)


# --------------------------------------------------------------------------------- docstrings

# A docstring begins with a verb in the imperative, not with one of these or a word in -s, -ed or -ing.
NO_VERB = {"A", "An", "The", "This", "What", "Which", "How", "Whether", "Some", "One", "Number", "Position"}


def definitions(body: list[ast.stmt], name: str, public: bool = True) -> Iterator[tuple[str, ast.AST, bool]]:
    """Yield each function, method and class with its dotted name, and whether it is public."""
    for node in body:
        if isinstance(node, ast.If | ast.Try):
            yield from definitions(node.body, name, public)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            own = f"{name}.{node.name}"
            yield own, node, public and not node.name.startswith("_")
            if isinstance(node, ast.ClassDef):
                yield from definitions(node.body, own, public and not node.name.startswith("_"))


def fault_of_docstring(text: str | None) -> str:
    """Return what is wrong with a docstring, or an empty text."""
    if text is None:
        return "is missing"
    first = text.split("\n\n")[0]
    if not re.search(r"\.(\s|$)", first):
        return "has no full stop behind its first sentence"
    word = text.split()[0].strip(",.:")
    # "Pass" and "Bring" are verbs
    if word in NO_VERB or not word[0].isupper() or re.search(r"([^s]s|ed|[A-Za-z]{3}ing)$", word):
        return f"begins with {word!r} instead of a verb in the imperative"
    return ""


def test_every_docstring_begins_with_an_imperative_sentence() -> None:
    wrong = []
    for module, tree in sources().items():
        units = [(module, tree, True), *definitions(tree.body, module)]
        for name, node, public in units:
            assert isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            text = ast.get_docstring(node)
            if public or text is not None:
                fault = fault_of_docstring(text)
                wrong += [f"{name}: its docstring {fault}"] * bool(fault)
    assert not wrong, "\n".join(wrong)


# ------------------------------------------------------------------------------------ Mitsuba


LIGHT = tuple(
    unit for unit in MAY_IMPORT if unit not in ("__init__", "__main__", "store", "dataset", "output", "cli")
)


@pytest.mark.parametrize("modules", [(), LIGHT, ("faults",)], ids=["vbnfault", "all light ones", "faults"])
def test_mitsuba_stays_unloaded(modules: tuple[str, ...]) -> None:
    script = ["import sys", "import vbnfault", *(f"import vbnfault.{m}" for m in modules)]
    if "faults" in modules:
        script.append("assert len(vbnfault.faults.registry()) >= 6")
    heavy = {"mitsuba", "drjit", "zarr", "dask", "distributed", "typer", "pytest", "hypothesis"}
    heavy.add("vbnfault.render.runtime")
    script.append(f"loaded = sorted({heavy} & set(sys.modules)); assert not loaded, loaded")
    done = subprocess.run([sys.executable, "-c", "; ".join(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
