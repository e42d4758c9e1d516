"""Write the card of an export: what its files hold, how to read them, and what the store's card says."""

from __future__ import annotations

from ...dataset.card import described
from ...dataset.statistics import Statistics
from ...store import EFFECT_RULE, Store
from .contract import Closing, Format

_ABOUT_MASKS = {
    "footprint": ("- Masks: `footprint`. `mask` is that of the store, by the rules of the table below.",),
    "effect": (
        f"- Masks: `effect`. What is called `mask` here is `mask_effect` of the store, not the footprint of the "
        f"table below: {EFFECT_RULE}. `mask_any` unites these masks and what several "
        "faults change together.",
    ),
}


def export_card(store: Store, kind: Format, closing: Closing, numbers: Statistics, masks: str) -> str:
    """Return the card of an export as Markdown; `masks`: footprint or effect."""
    title = store.attributes.get("title") or "untitled dataset"
    front = ["---", *closing.front, "---", ""] if closing.front else []
    lines = [
        *front,
        f"# {title}, exported as {kind.name}",
        "",
        *([str(store.attributes["description"]), ""] if store.attributes.get("description") else []),
        f"{store.samples} samples of {store.spec.width} x {store.spec.height} px: {kind.summary}",
        "",
        "## Files",
        "",
        *kind.usage,
        *closing.lines,
        *(_ABOUT_MASKS[masks] if "mask_effect" not in kind.layers(store.spec) else ()),
        "- `samples.jsonl`: one line of JSON for each sample, with its file, its split, the names of "
        "its faults, pose, "
        "Sun, exposure, and every drawn parameter of every fault.",
        "- `croissant.json`: this description for programs (Croissant 1.0). `export.json`: what was exported.",
        "",
        "The order of the classes is that of the table below. The intensity channel is: "
        f"{store.attributes.get('intensity_channel', 'luminance of RGB')}.",
        "",
        *described(store, numbers),
    ]
    return "\n".join(lines) + "\n"
