"""A store with sequences, without a renderer: a square crosses the frames, and faults come and go."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from synthetic import fake_sample, make_spec

from vbnfault import store as st

FRAMES = (9, 1, 12)
NAMES = ("approach", "still", "leave: night/day")
STEP_S = 0.2


def sequences(
    path: Path, *, size: int = 33, step_s: float = STEP_S, drawn: Mapping[str, Any] | None = None, **changes: object
) -> st.Store:
    """A finished store of three sequences in the splits train, val and test; `size` + 8 columns.

    `drawn` are the parameters of the faults that a frame has.
    """
    spec = make_spec(size, **{"layers": ("clean", "mask_effect"), "sequence_names": NAMES, **changes})
    store = st.create(path, spec, sum(FRAMES))
    made = []
    for sequence, count in enumerate(FRAMES):
        for frame in range(count):
            index = len(made)
            sample = fake_sample(make_spec(size), index, site=sequence)
            image = np.full((spec.height, spec.width, 4), 40 + 12 * frame, np.uint8)
            x = frame * (spec.width - 8) // 12
            image[8:16, x : x + 8] = 250
            injected = np.array([frame >= 3, frame % 2 == 1, False, frame >= 5])
            mask = sample.layers["mask"] & injected[:, None, None]
            mask[0, 20:24, 4:12] = injected[0]
            mask, injected, effect = mask[: len(spec.faults)], injected[: len(spec.faults)], mask.copy()
            effect[0, 23] = False
            layers = {"image": image, "clean": image, "mask": mask, "mask_effect": effect}
            times = {"sequence": sequence, "frame": frame, "time_s": 5.0 + frame * step_s, "injected": injected}
            has = dict(zip(spec.faults, injected.tolist(), strict=True))
            times |= {"velocity_T_m_s": np.zeros(3), "rate_C_rad_s": np.zeros(3)}
            parameters = {name: one for name, one in (drawn or {}).items() if has[name]}
            made.append(
                dataclasses.replace(
                    sample,
                    layers={name: layer for name, layer in layers.items() if name in (*spec.pixel_layers, "mask")},
                    scalars={**sample.scalars, **times, "parameters": parameters},
                )
            )
    st.write_samples(store, made)
    return store
