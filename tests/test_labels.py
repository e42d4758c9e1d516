"""Masks: effect, footprint, union and outline on small arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vbnfault.detector.effects.downlink import Companding, Compression
from vbnfault.pipeline import masks, record

images = arrays(np.uint8, (3, 5, 4), elements=st.sampled_from([0, 1, 128, 254, 255]))
SHAPE = (4, 6)


# ------------------------------------------------------------------------------------ effect


@given(images, images)
def test_effect_is_any_channel_differing_and_symmetric(a: np.ndarray, b: np.ndarray) -> None:
    got = masks.effect(a, b)
    assert got.dtype == bool
    assert got.shape == (3, 5)
    for y, x in np.ndindex(3, 5):
        assert got[y, x] == any(a[y, x, c] != b[y, x, c] for c in range(4))
    np.testing.assert_array_equal(got, masks.effect(b, a))


def test_effect_takes_read_only_and_strided_images() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 2, (2, 8, 10, 4), dtype=np.uint8)
    a.flags.writeable = False
    expected = (a != b).any(axis=-1)
    assert 0 < expected.sum() < 80
    np.testing.assert_array_equal(masks.effect(a, b), expected)
    np.testing.assert_array_equal(masks.effect(a[::2, ::-1], b[::2, ::-1]), expected[::2, ::-1])
    np.testing.assert_array_equal(masks.effect(a, np.asfortranarray(b)), expected)


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
CONTEXT: Any = SimpleNamespace(shape=SHAPE, camera=None)


def test_mask_layers_in_the_order_of_the_faults() -> None:
    seen = np.zeros(SHAPE, bool)
    seen[2, 3] = True
    drawn = {
        "straylight": {},
        "pixels": {"row": 1},
        "ghost": {},
    }  # dust is not injected, the order is another
    got = masks.mask_layers(FAULTS, drawn, CONTEXT, {"straylight": seen})
    assert got.shape == (4, *SHAPE)
    assert got.dtype == bool
    assert not got[0].any()
    row = np.zeros(SHAPE, bool)
    row[1] = True
    np.testing.assert_array_equal(got[1], row)
    np.testing.assert_array_equal(got[2], seen)
    assert not got[3].any()


def test_mask_layers_of_nothing_drawn_are_empty() -> None:
    assert not masks.mask_layers(FAULTS, {}, CONTEXT, {"straylight": np.ones(SHAPE, bool)}).any()


def test_a_class_labelled_by_effect_needs_its_effect() -> None:
    with pytest.raises(KeyError, match="straylight"):
        masks.mask_layers(FAULTS, {"straylight": {}}, CONTEXT, {})


# ------------------------------------------------------------------------------------ union


@given(
    arrays(bool, (4, 3, 5)),
    st.sets(st.sampled_from(["dust", "pixels", "straylight", "ghost", "not in the scene"])),
)
def test_union_is_any_of_its_members(layers: np.ndarray, members: set[str]) -> None:
    got = masks.union(layers, FAULTS, members)
    expected = np.zeros((3, 5), bool)
    for k, name in enumerate(FAULTS):
        if name in members:
            expected = expected | layers[k]
    assert got.dtype == bool
    np.testing.assert_array_equal(got, expected)


# ------------------------------------------------------------------------------------ outline


@given(arrays(bool, (6, 7)))
def test_outline_is_the_part_of_the_mask_with_a_neighbour_outside(mask: np.ndarray) -> None:
    got = masks.outline(mask)
    # beyond the frame counts as inside: a mask cut by the edge of the image has no line there
    padded = np.pad(mask, 1, constant_values=True)
    for y, x in np.ndindex(6, 7):
        assert got[y, x] == (mask[y, x] and not padded[y : y + 3, x : x + 3].all())


def test_in_a_ccd_charge_that_runs_out_of_a_footprint_is_labelled_too() -> None:
    fault, seen = {"rays": Labelled(steps=("light", "raw"))}, np.zeros(SHAPE, bool)
    detector = SimpleNamespace(mosaic=None)
    seen[:, 2] = True
    for ccd in (True, False):
        context: Any = SimpleNamespace(shape=SHAPE, camera=SimpleNamespace(is_ccd=ccd, detector=detector))
        effects = {"rays": seen} if ccd else {}
        (mask,) = masks.mask_layers(fault, {"rays": {"row": 1}}, context, effects)  # type: ignore[arg-type]
        assert mask[1].all()
        assert mask[:, 2].all() == ccd


# ------------------------------------------------------------------------------------ rules in words


@given(images, images, st.sampled_from([1.5, 2.0, 126.0, 127.0, 254.0, 255.0]))
def test_strong_effect_is_any_channel_differing_by_its_level(a: np.ndarray, b: np.ndarray, least_dn: float) -> None:
    expected = (np.abs(a.astype(int) - b) >= least_dn).any(axis=2)
    np.testing.assert_array_equal(masks.effect(a, b, least_dn), expected)


@pytest.mark.parametrize(
    ("effect_mask", "level_dn", "steps", "of_a_ccd", "of_cmos", "compressed"),
    [
        (True, 1.0, ("electrons",), "effect", "effect", "effect"),
        (True, 0.5, ("electrons",), "effect", "effect", "effect"),
        (True, 2.0, ("electrons",), "strong effect", "strong effect", "strong effect"),
        (False, 1.0, ("electrons", "rgbi"), "footprint", "footprint", "footprint"),
        (False, 1.0, ("rgbi", "charge"), "footprint and effect", "footprint", "footprint and effect"),
        (False, 1.0, ("light",), "footprint and effect", "footprint", "footprint and effect"),
        (False, 1.0, ("offsets",), "footprint", "footprint", "footprint and effect"),
        (False, 1.0, ("raw",), "footprint", "footprint", "footprint"),
    ],
)
def test_kind_of_a_mask(
    effect_mask: bool, level_dn: float, steps: tuple[str, ...], of_a_ccd: str, of_cmos: str, compressed: str
) -> None:
    fault: Any = SimpleNamespace(effect_mask=effect_mask, effect_level_dn=level_dn, steps=steps)
    effects = (Companding(bits=12), Compression(codec="jpeg2000"))
    spread: Any = SimpleNamespace(mosaic=SimpleNamespace(sensor=SimpleNamespace(effects=effects)))
    three: Any = SimpleNamespace(mosaic=None)
    for is_ccd, detector, kind in ((True, three, of_a_ccd), (False, three, of_cmos), (False, spread, compressed)):
        where: Any = SimpleNamespace(camera=SimpleNamespace(is_ccd=is_ccd, detector=detector))
        assert masks.kind(fault, where.camera) == kind
        assert masks.spreads(fault, where) == (kind == "footprint and effect")


@dataclass(frozen=True)
class Thresholds:
    """Two thresholds, of which one has a unit, and a field that is none."""

    mask_loss: float = field(default=0.25, metadata={"doc": "loss of light"})
    mask_level: float = field(default=3.0, metadata={"doc": "least change", "unit": "dn"})
    strength: float = field(default=1.0, metadata={"doc": "strength", "unit": "dn"})


def test_footprint_rule_names_every_threshold_its_value_and_unit() -> None:
    rule = masks.footprint_rule(Thresholds())  # type: ignore[arg-type]
    assert rule == "loss of light: mask_loss = 0.25; least change: mask_level = 3 dn"
    assert "mask" not in masks.footprint_rule(Labelled())  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------ points of truth


def test_points_of_truth_lie_at_their_depth_along_their_rays() -> None:
    """A plane that is z = 5 m before the camera: x = 5 u, y = 5 v in C, then turned by hand and moved to T."""
    u, v = np.meshgrid([-0.5, 0.0, 1.0], [-0.25, 0.75])
    depth = np.full((2, 3), 5.0, dtype=np.float32)
    depth[0, 1] = np.inf  # sky
    # C's x, y, z are L's y, z, x; L's are T's -x, -y, z
    L_from_C = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    frame: Any = SimpleNamespace(
        rendering=SimpleNamespace(truth=SimpleNamespace(depth_m=depth)),
        camera=SimpleNamespace(seen_directions=np.stack([u, v, np.ones_like(u)], axis=-1)),
        spec=SimpleNamespace(
            terrain=SimpleNamespace(
                site=SimpleNamespace(
                    T_from_L=np.diag([-1.0, -1.0, 1.0]), position_T_m=np.array([100.0, 200.0, 300.0])
                )
            )
        ),
        pose=SimpleNamespace(L_from_C=L_from_C, position_L_m=np.array([7.0, 8.0, 9.0])),
    )
    want = np.stack([100 - (7 + 5 + 0 * u), 200 - (8 + 5 * u), 300 + (9 + 5 * v)], axis=-1)
    want[0, 1] = np.nan
    np.testing.assert_allclose(record.points_T_m(frame), want, rtol=1e-14)
