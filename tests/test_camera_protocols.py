"""Every lens and detector answers its protocol, and nothing else is asked of a camera's parts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_faults_kit import make_context, with_mosaic

from vbnfault.camera import Camera
from vbnfault.core.quantities import Radiance
from vbnfault.detector import Detector, MosaicDetector, ThreeColourDetector
from vbnfault.lens import Lens, RealLens, ThinLens, load_lens
from vbnfault.lens.image_frame import ImageFrame

SIZE = 48


class Foreign:
    """A part of another class that answers what the part inside it answers."""

    def __init__(self, inside: Any) -> None:
        self.inside = inside

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.inside, name)


def test_both_kinds_of_detectors_answer_every_question() -> None:
    questions = {name for name in vars(Detector) if not name.startswith("_")}
    assert len(questions) > 10
    for kind in (ThreeColourDetector, MosaicDetector):
        assert questions <= set(dir(kind)) | set(kind.__dataclass_fields__)


@pytest.mark.parametrize("real", [False, True])
def test_a_camera_of_foreign_classes_takes_the_same_image(real: bool) -> None:
    detector = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=400.0)
    lens: Lens = ThinLens(focal_length_mm=28.0, f_number=4.0)
    if real:
        lens = RealLens(
            prescription=load_lens("nikkor_28_f2p8"), width_px=SIZE, height_px=SIZE, pixel_pitch_um=400.0
        )
    own, foreign = Camera(lens=lens, detector=detector), Camera(lens=Foreign(lens), detector=Foreign(detector))
    gx, gy = lens.guard_px
    light = np.random.default_rng(1).uniform(0, 1, (2, SIZE + 2 * gy, SIZE + 2 * gx)).astype(np.float32)
    radiance = Radiance(array=light, wavelength_nm=np.array([500.0, 600.0]))
    np.testing.assert_array_equal(foreign.expose(radiance, 1e-3).array, own.expose(radiance, 1e-3).array)
    np.testing.assert_array_equal(foreign.seen_directions, own.seen_directions)
    direction = np.array([0.1, -0.2, 1.0])
    np.testing.assert_array_equal(foreign.project(direction), own.project(direction))
    frames = [
        ImageFrame(lens=camera.lens, width_px=SIZE, height_px=SIZE, pixel_pitch_um=400.0)
        for camera in (own, foreign)
    ]
    centres = np.arange(SIZE) + 0.5
    for mine, other in zip(*(frame.slopes(centres, centres) for frame in frames), strict=True):
        np.testing.assert_array_equal(mine, other)
    assert lens.on_frame(radiance).array.shape == (2, SIZE, SIZE)
    assert (frames[1].real_lens("") is lens) == real


def test_what_needs_a_mosaic_says_so() -> None:
    context = make_context(SIZE)
    with pytest.raises(TypeError, match="has no colour mosaic"):
        _ = context.camera.mosaic
    camera = with_mosaic(context).camera
    assert camera.mosaic is camera.detector
