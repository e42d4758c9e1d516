"""Name the format versions of stores, and describe the metadata of the one before the current one.

This vbnfault reads, verifies and completes stores of the formats 2 and 3, and writes new stores in format 3.
`vbnfault migrate` brings a store from 2 to 3. A store of any other format is refused in a sentence and left alone:
its arrays could not be told from damaged ones, and the samples that are missing would come from other code.
xarray reads the stores of every format.

1 → 2: build again. `spare` and the checksum of the root are new, `distortion` has eight coefficients instead of
       five, `split` is a string instead of a number, and `resolved` and `views` are new. The samples of format 1 do
       not say what these two hold, and were made by other code, so no program can convert a store.
2 → 3: `vbnfault migrate`. Only metadata change: every variable has a description and units of UDUNITS, `y` falls
       from the top of the image so that plots stand upright, `row` is new, and the root names the codec of each
       layer. The values of all other arrays are the same, and so are the digests.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .arrays import Member

FORMAT_VERSION = 3
READ_VERSIONS = (2, 3)
FIRST_PROGRAM = "0.1"  # the versions of vbnfault that wrote format 1
# Stores of the formats from this one on hold the same values, so their digests count as of this one.
DIGEST_VERSION = 2

_UNITS_IN_2 = {"count": "DN", "degree": "deg"}
_IN_PIXELS = ("intrinsics", "sun_xy_px", "x", "y", "x_rendered", "y_rendered")


def in_format_2(members: Mapping[str, Member]) -> dict[str, Member]:
    """Return the arrays of a store of format 3 as format 2 had them."""
    old: dict[str, Member] = {}
    for name, member in members.items():
        if name == "row":
            continue
        attributes = {k: v for k, v in member.attributes.items() if k not in ("description", "axis")}
        units = "px" if name in _IN_PIXELS else _UNITS_IN_2.get(attributes["units"], attributes["units"])
        if member.values is not None and units == "1":
            del attributes["units"]  # names had none
        else:
            attributes["units"] = units
        if name == "y":
            attributes["long_name"] = members["row"].attributes["long_name"]
        if name in ("y", "y_rendered"):
            member = member._replace(values=-np.asarray(member.values))
        old[name] = member._replace(attributes=attributes)
    return old
