"""Make pages of HTML that need no other file, from Jinja templates: one layout, one style, and tables.

The reports of studies and of datasets share `html_page.html`, so that they look alike, on light and dark screens
and in print. Every value is escaped, unless it is `Markup`, and a page allows no script and no address.
"""

from __future__ import annotations

import base64
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from numpy.typing import NDArray

from .files.images import encoded
from .files.whole_files import write_whole

_PACKAGE = Path(__file__).parents[1]
_LOSSLESS_PX, _QUALITY = 160, 88  # smaller images are PNG, others WebP
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@cache
def _environment() -> jinja2.Environment:
    """Return what renders the templates of this package."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PACKAGE),
        autoescape=lambda name: not str(name).endswith(".md"),  # Markdown is text
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        extensions=["jinja2.ext.do"],
    )
    environment.filters |= {"digits": grouped_digits, "minus": with_minus, "number": number_text}
    return environment


def rendered(template: str, **values: Any) -> str:
    """Return the text of a template, a file of this package such as `study/report.html`, with what it names."""
    return _environment().get_template(template).render(values).strip() + "\n"


def write_page(path: Path, template: str, **values: Any) -> None:
    """Write a page, as `rendered`, at once under its name. Raises OSError if the file cannot be written."""
    style = (_PACKAGE / "core/html_page.css").read_text(encoding="utf-8")
    write_whole(path, rendered(template, links=[], style=style, **values))


def grouped_digits(number: int) -> str:
    """Return a whole number with narrow spaces between its thousands."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def with_minus(text: str) -> str:
    """Return a number with a real minus sign."""
    return text.replace("-", "\N{MINUS SIGN}")


def power_of_ten(exponent: int) -> str:
    """Return a power of ten as text: 10⁶."""
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def number_text(value: float, digits: int = 3, unit: str = "") -> str:
    """Return a number with its unit as short text, with a real minus sign and powers of ten; – for none."""
    if not np.isfinite(value):
        return "–"
    text = f"{value:.{digits}g}"
    if 1000 <= abs(float(text)) < 100_000:
        text = f"{float(text):.0f}"
    leading, _, power = text.partition("e")
    if power:
        text = power_of_ten(int(power)) if leading == "1" else f"{leading}·{power_of_ten(int(power))}"
    return with_minus(text) + ("" if unit in ("", "1") else f" {unit}")


def data_url(data: bytes, kind: str) -> str:
    """Return the content of a file as an address within the page; `kind` such as image/png."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def image_url(image: NDArray[np.uint8], side_px: int) -> str:
    """Return an image [y, x] or [y, x, 3] as an address within the page, its longer side at most `side_px`."""
    factor = side_px / max(image.shape[:2])
    if factor < 1:
        size = tuple(max(1, round(n * factor)) for n in image.shape[1::-1])
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if max(image.shape[:2]) <= _LOSSLESS_PX:
        return data_url(encoded(image, ".png"), "image/png")
    return data_url(encoded(image, ".webp", _QUALITY), "image/webp")
