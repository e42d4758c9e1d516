"""Show notebooks as pages of the documentation, with the outputs that are kept in them.

Sphinx reads a notebook as Markdown: its text, its code, the text that the code printed, and its figures. Nothing is
run meanwhile; the tests run the cells as the blocks of a page.
"""

from __future__ import annotations

import json
from typing import Any


def markdown(notebook: str, outputs: bool = True) -> str:
    """Return the text of a notebook file as Markdown, on request without what its cells gave."""
    parts = []
    for cell in json.loads(notebook)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts += [_shown(output) for output in cell["outputs"]] if outputs else []
    return "\n\n".join(parts) + "\n"


def _shown(output: dict[str, Any]) -> str:
    """Return one output of a cell as Markdown: a figure, or else its text."""
    data = output.get("data", {})
    if "image/png" in data:
        return f"![Figure that the cell draws](data:image/png;base64,{''.join(data['image/png']).strip()})"
    text = "".join(output.get("text") or data.get("text/plain", ""))
    return f"```text\n{text.rstrip()}\n```"


def setup(app: Any) -> dict[str, Any]:
    """Register the extension in Sphinx."""

    def on_read(app: Any, docname: str, source: list[str]) -> None:
        if app.env.doc2path(docname).suffix == ".ipynb":
            source[0] = markdown(source[0])

    app.add_source_suffix(".ipynb", "markdown")
    app.connect("source-read", on_read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
