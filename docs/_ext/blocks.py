"""Run the code blocks of a Markdown page, in order, in one folder.

    python docs/_ext/blocks.py docs/tutorial.md --figures docs/figures
    python docs/_ext/blocks.py docs/howto/own_body.md --only bennu --figures docs/figures

runs a page as it is printed, or its blocks with a word in them, and keeps the figures that the page shows. The
tests run every page with small images.

What a fenced block is follows from its language and its first line:

- `sh`: commands of `vbnfault`, one a line; they run in this process.
- `python`: code; the blocks of a page share their names.
- Any block whose first line is a comment with a file's name (`# my_camera.toml`): this file, which is written.
- `toml` without a file's name: a part of a scene, which must be accepted beside a title.
- `text`, `json`, `yaml`: output to read, which does not run.

A comment before a block says that it does not run, and why: `<!-- not run: it downloads 40 MB -->`. Its syntax is
checked all the same. `<!-- needs torch -->` runs the block only where that package is installed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import itertools
import os
import re
import shlex
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_FENCE = re.compile(
    r"(?:^<!-- (?P<mark>not run: [^>]+|needs \w+) -->\n\n?)?^```(?P<language>\w+)\n(?P<text>.*?)^```$",
    flags=re.DOTALL | re.MULTILINE,
)
_FILE = re.compile(r"# ([\w./-]+\.(?:toml|py|csv|txt|yaml))\n")
WIDEST_PX = 720
MOST_BYTES = 250_000
LANGUAGES = ("sh", "python", "toml", "yaml", "text", "json")

# pip and the tests are what continuous integration itself runs
DEVELOPERS = ("pip", "pytest", "python -m pytest", "sphinx-build")


@dataclass(frozen=True)
class Block:
    """Hold one fenced block of a page; `file` and `not_run` are empty where they do not apply."""

    page: str
    line: int
    language: str
    text: str
    file: str
    not_run: str
    needs: str

    @property
    def where(self) -> str:
        """Return page and line for a message."""
        return f"{self.page}:{self.line}"


def blocks(text: str, page: str) -> list[Block]:
    """Return the fenced blocks of a page, in order. Directives, such as `{toctree}`, are none."""
    out = []
    for match in _FENCE.finditer(text):
        mark, file = match["mark"] or "", _FILE.match(match["text"])
        out.append(
            Block(
                page=page,
                line=text.count("\n", 0, match.start()) + 1,
                language=match["language"],
                text=match["text"],
                file=file[1] if file else "",
                not_run=mark.removeprefix("not run: ") if mark.startswith("not run") else "",
                needs=mark.removeprefix("needs ") if mark.startswith("needs") else "",
            )
        )
    return out


def commands(text: str) -> list[list[str]]:
    """Return the commands of a shell block as lists of words; `&&` separates commands like a line's end."""
    out: list[list[str]] = []
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        for connected, group in itertools.groupby(words, key=lambda word: word == "&&"):
            if not connected:
                out.append(list(group))
    return out


def check(block: Block) -> None:
    """Raise an error where a block cannot run by its syntax: unknown options, wrong TOML, wrong Python."""
    if block.language == "python" or block.file.endswith(".py"):
        compile(block.text, block.where, "exec")
    elif block.language == "toml":
        tomllib.loads(block.text)
    elif block.language == "sh":
        for words in commands(block.text):
            if words[0] == "vbnfault":
                parse(words[1:])


def parse(words: list[str]) -> None:
    """Raise an error where the command line has no such command or option; nothing is run."""
    import typer

    from vbnfault import cli

    command: Any = typer.main.get_command(cli.app)
    rest, name = list(words), "vbnfault"
    while rest and getattr(command, "commands", None):
        name = rest.pop(0)
        if name not in command.commands:
            raise ValueError(f"vbnfault {' '.join(words)}: there is no command {name}")
        command = command.commands[name]
    command.make_context(name, rest)


def run_command(words: list[str]) -> int:
    """Run `vbnfault …` in this process and return its exit code."""
    from vbnfault import cli

    before, sys.argv = sys.argv, words
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = before
    return 0


def run_page(
    page: list[Block],
    folder: Path,
    *,
    command: Callable[[list[str]], int] = run_command,
    said: Callable[[], str] = lambda: "",
) -> None:
    """Run the blocks of a page in a folder, which becomes the working folder meanwhile.

    `command` runs one command of the program, `said` returns its last output for a message.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.chdir(folder), contextlib.ExitStack() as python:
        for block in page:
            check(block)
            if block.not_run or (block.needs and importlib.util.find_spec(block.needs) is None):
                continue
            if block.file:
                Path(block.file).parent.mkdir(parents=True, exist_ok=True)
                Path(block.file).write_text(block.text, encoding="utf-8")
            elif block.language == "toml":
                _accept(block)
            elif block.language == "python":
                python.enter_context(_own_modules(folder))
                exec(compile(block.text, block.where, "exec"), names)
            elif block.language == "sh":
                python.close()  # a command is a process of its own: it knows no module of the page
                for words in commands(block.text):
                    if " ".join(words).startswith(DEVELOPERS):
                        continue
                    if words[0] != "vbnfault":
                        raise ValueError(f"{block.where}: {words[0]}: only commands of vbnfault run")
                    with _own_modules(folder):
                        code = command(words)
                    if code:
                        raise RuntimeError(f"{block.where}: {shlex.join(words)}: exit code {code}: {said()}")


def _accept(block: Block) -> None:
    """Raise InputError where a part of a scene is not accepted beside a title."""
    from vbnfault import load_scene

    Path("part.toml").write_text(f'title = "part"\n{block.text}', encoding="utf-8")
    load_scene("part.toml")


@contextlib.contextmanager
def _own_modules(folder: Path) -> Iterator[None]:
    """Let Python import the modules that a page writes; forget them, and the classes that they registered."""
    from vbnfault.core.registry import undoing_registrations
    from vbnfault.faults import plugins, registry

    registry()
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        with undoing_registrations(always=True):
            yield
    finally:
        sys.path.remove(str(folder))
        plugins.loaded.clear()
        for name in set(sys.modules) - before:
            origin = getattr(sys.modules[name], "__file__", None) or ""
            if origin.startswith(str(folder)):
                del sys.modules[name]


def figures(text: str) -> list[str]:
    """Return the names of the figures in `figures/` that a page shows."""
    return re.findall(r"!\[[^\]]*\]\((?:\.\./)?figures/([\w-]+\.png)\)", text)


def keep_figure(made: Path, kept: Path) -> None:
    """Keep an image as a figure, at most `WIDEST_PX` wide and `MOST_BYTES` large.

    A larger one gets a palette, of half as many colours until it is small enough.
    """
    from PIL import Image  # comes with matplotlib

    with Image.open(made) as opened:
        image = opened.convert("RGB")
    if image.width > WIDEST_PX:
        size = (WIDEST_PX, round(image.height * WIDEST_PX / image.width))
        image = image.resize(size, Image.Resampling.BOX)
    image.save(kept, optimize=True)
    colours = 256
    while kept.stat().st_size > MOST_BYTES and colours >= 16:
        # this method keeps the few pixels of the legend's colours
        palette = image.quantize(colours, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
        palette.save(kept, optimize=True)
        colours //= 2


def main() -> None:
    """Run one page at full size and keep its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--only", default="", help="run only the blocks that contain this word")
    parser.add_argument("--figures", type=Path, required=True, help="folder for the figures of the page")
    given = parser.parse_args()
    text = given.page.read_text(encoding="utf-8")
    chosen = [block for block in blocks(text, str(given.page)) if given.only in block.text]
    os.environ["MPLBACKEND"] = "Agg"
    with tempfile.TemporaryDirectory() as folder:
        run_page(chosen, Path(folder))
        made = [name for name in figures(text) if (Path(folder) / name).exists()]
        for name in made:
            keep_figure(Path(folder) / name, given.figures / name)
            print(given.figures / name)


if __name__ == "__main__":
    main()
