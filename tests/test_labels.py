"""Masks: effect, footprint, union and outline on small arrays."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vbnfault import labels

images = arrays(np.uint8, (3, 5, 4), elements=st.sampled_from([0, 1, 128, 254, 255]))
SHAPE = (4, 6)


# ------------------------------------------------------------------------------------ effect


def test_effect_marks_a_difference_of_one_in_any_channel() -> None:
    image = np.full((*SHAPE, 4), 7, np.uint8)
    without = image.copy()
    for channel, (y, x) in enumerate([(0, 0), (1, 5), (3, 2), (2, 4)]):
        without[y, x, channel] = 8 if channel % 2 else 6
    expected = np.zeros(SHAPE, bool)
    expected[[0, 1, 3, 2], [0, 5, 2, 4]] = True
    np.testing.assert_array_equal(labels.effect(image, without), expected)
    assert not labels.effect(image, image).any()


@given(images, images)
def test_effect_is_any_channel_differing_and_symmetric(a: np.ndarray, b: np.ndarray) -> None:
    got = labels.effect(a, b)
    assert got.dtype == bool
    assert got.shape == (3, 5)
    for y, x in np.ndindex(3, 5):
        assert got[y, x] == any(a[y, x, c] != b[y, x, c] for c in range(4))
    np.testing.assert_array_equal(got, labels.effect(b, a))


def test_effect_takes_read_only_and_strided_images() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 2, (2, 8, 10, 4), dtype=np.uint8)
    a.flags.writeable = False
    expected = (a != b).any(axis=-1)
    assert 0 < expected.sum() < 80
    np.testing.assert_array_equal(labels.effect(a, b), expected)
    np.testing.assert_array_equal(labels.effect(a[::2, ::-1], b[::2, ::-1]), expected[::2, ::-1])
    np.testing.assert_array_equal(labels.effect(a, np.asfortranarray(b)), expected)


# ------------------------------------------------------------------------------------ mask layers


@dataclass(frozen=True)
class Labelled:
    """What `mask_layers` needs of a fault: a footprint at a row, or the effect rule, or neither."""

    effect_mask: bool = False
    has_footprint: bool = True
    steps: tuple[str, ...] = ("electrons",)

    def footprint(self, params: dict[str, Any], context: Any) -> np.ndarray | None:
        assert not self.effect_mask, "a class labelled by its effect has its footprint asked for"
        if not self.has_footprint:
            return None
        mask = np.zeros(context.shape, bool)
        mask[params["row"]] = True
        return mask


FAULTS: Any = {
    "dust": Labelled(),
    "pixels": Labelled(),
    "straylight": Labelled(effect_mask=True),
    "ghost": Labelled(has_footprint=False),
}
CONTEXT: Any = SimpleNamespace(shape=SHAPE)


def test_mask_layers_in_the_order_of_the_faults() -> None:
    seen = np.zeros(SHAPE, bool)
    seen[2, 3] = True
    drawn = {
        "straylight": {},
        "pixels": {"row": 1},
        "ghost": {},
    }  # dust is not injected, the order is another
    got = labels.mask_layers(FAULTS, drawn, CONTEXT, {"straylight": seen})
    assert got.shape == (4, *SHAPE)
    assert got.dtype == bool
    assert not got[0].any()
    row = np.zeros(SHAPE, bool)
    row[1] = True
    np.testing.assert_array_equal(got[1], row)
    np.testing.assert_array_equal(got[2], seen)
    assert not got[3].any()


def test_mask_layers_of_nothing_drawn_are_empty() -> None:
    assert not labels.mask_layers(FAULTS, {}, CONTEXT, {"straylight": np.ones(SHAPE, bool)}).any()


def test_a_class_labelled_by_effect_needs_its_effect() -> None:
    with pytest.raises(KeyError, match="straylight"):
        labels.mask_layers(FAULTS, {"straylight": {}}, CONTEXT, {})


# ------------------------------------------------------------------------------------ union


@given(
    arrays(bool, (4, 3, 5)),
    st.sets(st.sampled_from(["dust", "pixels", "straylight", "ghost", "not in the scene"])),
)
def test_union_is_any_of_its_members(masks: np.ndarray, members: set[str]) -> None:
    got = labels.union(masks, FAULTS, members)
    expected = np.zeros((3, 5), bool)
    for k, name in enumerate(FAULTS):
        if name in members:
            expected = expected | masks[k]
    assert got.dtype == bool
    np.testing.assert_array_equal(got, expected)


# ------------------------------------------------------------------------------------ outline


def test_outline_of_a_square_is_its_border() -> None:
    mask = np.zeros((9, 9), bool)
    mask[2:7, 1:6] = True
    expected = mask.copy()
    expected[3:6, 2:5] = False
    np.testing.assert_array_equal(labels.outline(mask), expected)


@given(arrays(bool, (6, 7)))
def test_outline_is_the_part_of_the_mask_with_a_neighbour_outside(mask: np.ndarray) -> None:
    got = labels.outline(mask)
    # beyond the frame counts as inside: a mask cut by the edge of the image has no line there
    padded = np.pad(mask, 1, constant_values=True)
    for y, x in np.ndindex(6, 7):
        assert got[y, x] == (mask[y, x] and not padded[y : y + 3, x : x + 3].all())


def test_in_a_ccd_charge_that_runs_out_of_a_footprint_is_labelled_too() -> None:
    fault, seen = {"rays": Labelled(steps=("light", "raw"))}, np.zeros(SHAPE, bool)
    seen[:, 2] = True
    for ccd in (True, False):
        context: Any = SimpleNamespace(shape=SHAPE, camera=SimpleNamespace(is_ccd=ccd))
        effects = {"rays": seen} if ccd else {}
        (mask,) = labels.mask_layers(fault, {"rays": {"row": 1}}, context, effects)  # type: ignore[arg-type]
        assert mask[1].all()
        assert mask[:, 2].all() == ccd
