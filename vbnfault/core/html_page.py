"""Make pages of HTML that need no other file: one layout, one style, and tables.

The reports of studies and of datasets share it, so that they look alike, on light and dark screens and in print.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from .whole_files import write_whole


@dataclass(frozen=True)
class Section:
    """Hold one section of a page: its identifier, its heading and its content as markup."""

    name: str
    heading: str
    content: str

    def markup(self) -> str:
        """Return the section as an element of the page."""
        return f'<section id="{self.name}"><h2>{escaped(self.heading)}</h2>{self.content}</section>'


@dataclass(frozen=True, kw_only=True)
class Page:
    """Hold what a page consists of.

    Attributes
    ----------
    title, description
        Title and first paragraph, as text.
    facts
        Numbers below the title, by name; empty ones are left out.
    sections
        Sections, which the page links to below its title.
    style, script
        CSS behind the common style, and JavaScript at the end of the page.
    """

    title: str
    description: str
    facts: Mapping[str, str]
    sections: Sequence[Section]
    style: str = ""
    script: str = ""

    def markup(self) -> str:
        """Return the whole page."""
        links = "".join(f'<a href="#{part.name}">{escaped(part.heading)}</a>' for part in self.sections)
        body = "".join(part.markup() for part in self.sections)
        top = f'{facts(self.facts)}<nav aria-label="Sections">{links}</nav>'
        script = f"<script>{self.script}</script>" if self.script else ""
        return (
            '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escaped(self.title)}</title><style>{common_style()}{self.style}</style></head><body><main>"
            f"<header><h1>{escaped(self.title)}</h1><p>{escaped(self.description)}</p>"
            f"{top}</header>{body}</main>{script}</body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the page, at once under its name. Raises OSError if the file cannot be written."""
        write_whole(path, self.markup())


def common_style() -> str:
    """Return the style that all pages share."""
    return resources.files(__package__).joinpath("html_page.css").read_text(encoding="utf-8")


def escaped(text: object) -> str:
    """Return a text with the characters that mean something in HTML escaped."""
    return html.escape(str(text))


def facts(values: Mapping[str, str]) -> str:
    """Return short values with their names as a list in columns; empty values are left out."""
    items = "".join(f"<div><dt>{escaped(k)}</dt><dd>{escaped(v)}</dd></div>" for k, v in values.items() if v)
    return f'<dl class="facts">{items}</dl>'


def html_table(
    heads: Iterable[str],
    rows: Sequence[Sequence[str]],
    *,
    numbers: Iterable[int] = (),
    faint: Sequence[bool] = (),
    group: int = 1,
) -> str:
    """Return a table.

    Parameters
    ----------
    heads, rows
        Headings as text, cells as markup.
    numbers
        Columns of numbers, which are aligned at the right.
    faint
        Rows that are written in a fainter colour.
    group
        The first cell of every so many rows spans all of them.
    """
    heads, right = list(heads), set(numbers)
    classes = [' class="number"' if k in right else "" for k in range(len(heads))]
    head = "".join(f"<th{c}>{escaped(text)}</th>" for c, text in zip(classes, heads, strict=True))
    body = []
    for k, row in enumerate(rows):
        cells = [f"<td{c}>{cell}</td>" for c, cell in zip(classes, row, strict=True)]
        if group > 1:
            cells[0] = "" if k % group else cells[0].replace("<td", f'<td rowspan="{group}"', 1)
        mark = ' class="floor"' if k < len(faint) and faint[k] else ""
        body.append(f"<tr{mark}>{''.join(cells)}</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'


def grouped_digits(number: int) -> str:
    """Return a whole number with narrow spaces between its thousands."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def with_minus(text: str) -> str:
    """Return a number with a real minus sign."""
    return text.replace("-", "\N{MINUS SIGN}")


def data_url(data: bytes, kind: str) -> str:
    """Return the content of a file as an address within the page; `kind` such as image/png."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def embedded_json(value: Any) -> str:
    """Return data as JSON that may stand within a script element: no text in it can end the element."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
