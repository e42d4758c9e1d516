"""The contact sheet shows every chosen sample, its masks in their colours, and says what it cannot do."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import ALL_FAULTS
from synthetic import FAULTS, fake_sample, make_spec

from vbnfault import store as st
from vbnfault.core.errors import InputError
from vbnfault.output import contact_sheet


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> st.Store:
    """7 samples, the third unfinished."""
    store = st.create(tmp_path_factory.mktemp("report") / "s.zarr", make_spec(64), 7)
    st.write_samples(store, [fake_sample(store.spec, i) for i in range(7) if i != 2])
    return store


def near(image: np.ndarray, colour: tuple[int, int, int], within: int = 2) -> int:
    """How many pixels of an RGB image are of this colour, each channel `within` some DN."""
    return int((np.abs(image.astype(int) - colour).max(-1) <= within).sum())


def test_the_sheet_has_a_tile_for_each_finished_sample(store: st.Store, tmp_path: Path) -> None:
    assert contact_sheet.preview(store.path, tmp_path / "all.png") == 6
    assert contact_sheet.preview(store.path, tmp_path / "few.png", max_samples=4) == 4
    big, small = (cv2.imread(str(tmp_path / n))[..., ::-1] for n in ("all.png", "few.png"))
    assert big.shape[0] * big.shape[1] > small.shape[0] * small.shape[1]
    assert len(np.unique(big.reshape(-1, 3), axis=0)) > 100


def test_masks_can_be_left_out(store: st.Store, tmp_path: Path) -> None:
    contact_sheet.preview(store, tmp_path / "with.png")
    contact_sheet.preview(store, tmp_path / "without.png", masks=False)
    sheets = [cv2.imread(str(tmp_path / n))[..., ::-1] for n in ("with.png", "without.png")]
    for k in range(3):  # outlines, antialiased, come on top of the legend and the captions
        with_masks, without = (near(sheet, contact_sheet.COLOURS[k], within=60) for sheet in sheets)
        assert with_masks > without + 100


def test_overlay_colours_the_mask_and_nothing_else() -> None:
    rgb = np.full((60, 80, 3), 100, np.uint8)
    mask = np.zeros((4, 60, 80), bool)
    mask[1, 20:40, 30:50] = True
    mask[2, :5] = True
    out = contact_sheet.overlay(rgb, mask, [False, True, False, False])
    inside = 100 * 0.7 + np.array(contact_sheet.COLOURS[1]) * 0.3
    assert np.abs(out[30, 40] - inside).max() <= 1  # truncation to uint8
    far = np.ones((60, 80), bool)
    far[18:42, 28:52] = False  # a pixel's width of outline, antialiased
    np.testing.assert_array_equal(out[far], rgb[far])
    assert (rgb == 100).all()


def test_a_mask_over_the_whole_frame_is_a_border() -> None:
    rgb = np.full((60, 80, 3), 100, np.uint8)
    out = contact_sheet.overlay(rgb, np.ones((4, 60, 80), bool), [False, False, False, True])
    np.testing.assert_array_equal(out[10:50, 10:70], 100)
    assert near(out, contact_sheet.COLOURS[3]) > 200


def test_a_class_that_marks_whole_images_is_a_border_however_much_its_mask_covers() -> None:
    rgb = np.full((60, 80, 3), 100, np.uint8)
    mask = np.zeros((1, 60, 80), bool)
    mask[0, ::2] = True
    out = contact_sheet.overlay(rgb, mask, [True], localised=[False])
    np.testing.assert_array_equal(out[10:50, 10:70], 100)
    assert near(out, contact_sheet.COLOURS[0]) > 200


def test_a_lone_broken_pixel_survives_shrinking() -> None:
    mask = np.zeros((1024, 1024), bool)
    mask[517, 301] = True
    small = contact_sheet._resized_mask(mask, (320, 320))
    assert 1 <= small.sum() <= 4
    assert small[161:163, 93:96].any()


def test_abbreviations_are_short_and_distinct() -> None:
    short = contact_sheet.abbreviations((*ALL_FAULTS, "dark_offset"))
    assert short["dust_on_optics"] == "DO"
    assert short["straylight"] == "St"
    assert len(set(short.values())) == 7
    assert max(map(len, short.values())) <= 4
    assert list(contact_sheet.abbreviations(FAULTS)) == list(FAULTS)


def test_what_cannot_be_shown_is_one_sentence(store: st.Store, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such store"):
        contact_sheet.preview(tmp_path / "none", tmp_path / "a.png")
    empty = st.create(tmp_path / "empty.zarr", make_spec(), 3)
    with pytest.raises(InputError, match="no sample is finished"):
        contact_sheet.preview(empty, tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a.png: cannot be written: No such file or directory"):
        contact_sheet.preview(store, tmp_path / "folder" / "a.png")
    with pytest.raises(InputError, match=r"must end in .png"):
        contact_sheet.preview(store, tmp_path / "a.jpg")
    with pytest.raises(InputError, match="must be at least 1"):
        contact_sheet.preview(store, tmp_path / "a.png", max_samples=0)
