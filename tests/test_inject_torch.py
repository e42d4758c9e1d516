"""`vbnfault.torch.Inject`: faults in batches of a training loop, for every model, with the Sun of each image."""

from __future__ import annotations

import pickle
import re
from typing import Any

import pytest
from test_inject import CAMERA, MODELS, only

from vbnfault.core.errors import InputError
from vbnfault.faults import registry
from vbnfault.scene.config import load_scene

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from vbnfault.torch import Inject  # noqa: E402


def test_batches_of_a_training_loop_have_the_draws_of_their_numbers() -> None:
    faults = {"dust_on_optics": {}, "broken_pixels": {"model": "texture"}, "vignetting": {}}
    transform = Inject(faults, camera=CAMERA, probability=0.6, seed=4)
    batch = torch.randint(20, 200, (5, 3, 48, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    images, masks = transform(batch, range(5))
    assert images.shape == batch.shape
    assert images.dtype == batch.dtype
    assert masks.shape == (5, 3, 48, 64)
    again, _ = pickle.loads(pickle.dumps(transform))(batch[3:], [3, 4])
    assert torch.equal(again, images[3:])
    floats, same = transform(batch.float() / 255, range(5))
    assert floats.dtype == torch.float32
    assert torch.equal(same, masks)
    # the numbers of 8 bits are rounded, and rounding of floats moves a count of noise by an electron or two
    assert (floats * 255 - images.float()).abs().max() <= 0.5 + 2 * 255 / CAMERA["full_well_e"]
    with pytest.raises(InputError, match="must be uint8 or float32"):
        transform(batch[0], [0])
    with pytest.raises(InputError, match=r"on meta: must be uint8 or float32 .*, on the CPU"):
        transform(batch.to("meta"), range(5))
    assert transform(batch[:0], [])[1].shape == (0, 3, 48, 64)
    sentence = r"5 images: numbers of shape \[2\] and 5 Suns; must be one for each image"
    with pytest.raises(InputError, match=sentence):
        transform(batch, [0, 1])
    with pytest.raises(InputError, match=r"^Inject: camera\.fov_degrees: unknown key \(did you mean fov_deg"):
        Inject(faults, camera={"fov_degrees": 3})
    with pytest.raises(InputError, match=r"^Inject: faults\.dust_on_optics = 5: must be a table"):
        Inject({"dust_on_optics": 5})
    with pytest.raises(InputError, match="probability = 2: must be from 0 to 1"):
        Inject(faults, probability=2)


@pytest.mark.parametrize("name", MODELS)
def test_every_model_acts_in_a_batch_or_says_why_it_cannot(name: str) -> None:
    fault, _, model = name.partition("/")
    faults = only(load_scene("quickstart"), name).faults
    batch = torch.randint(40, 200, (2, 3, 96, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    batch[:, :, 40:50, 60:70] = 255  # charge that overflows
    if registry()[fault][model].needs_mosaic:
        with pytest.raises(InputError, match=rf"faults\.{fault}\.model = '{model}': .*; name a camera\.detector"):
            Inject(faults, camera=CAMERA)
    camera = {"fov_deg": 20.0, "exposure_s": 0.01, "detector": "generic_ccd"}
    transform = Inject(faults, camera=camera, probability=1, seed=2)
    for images in (batch, batch.float() / 255):
        struck, masks = transform(images, range(2), suns=[(100.0, 20.0), None])
        assert (struck.shape, struck.dtype) == (images.shape, images.dtype)
        assert (masks.shape, masks.dtype) == ((2, 1, 96, 128), torch.bool)
        assert struck.min() >= 0
        assert struck.max() <= images.max()  # white
        if registry()[fault][model].needs_sun:
            assert transform.left_out == {
                fault: "needs the Sun before the camera; give its position: image.sun, --sun or sun="
            }
            assert torch.equal(struck[1], images[1])
            assert not masks[1].any()
        else:
            assert transform.left_out == {}
    # of the faint motes, those that 8 bits show are few
    assert fault == "particles" or (masks[0].any() and not torch.equal(struck[0], images[0]))


def test_a_batch_whose_images_show_no_sun_goes_on_without() -> None:
    transform = Inject({"straylight": {}}, camera=CAMERA, image={"sun": "auto"}, probability=1)
    batch = torch.full((2, 1, 64, 64), 40, dtype=torch.uint8)
    batch[1, 0, 20:26, 40:46] = 255
    struck, _ = transform(batch, range(2))
    assert torch.equal(struck[0], batch[0])
    assert not torch.equal(struck[1], batch[1])
    assert list(transform.left_out) == ["straylight"]
    with pytest.raises(InputError, match=r"image\.sun"):
        transform(batch, range(2), suns=[(0.0, 0.0, 0.0)] * 2)


@pytest.mark.parametrize(
    ("keys", "numbers", "sentence"),
    [
        ({"probability": "a"}, range(2), "probability = 'a'"),
        ({}, 5, "2 images: numbers of shape []"),
        ({}, torch.tensor([0.1, 0.2]), "numbers: "),
        ({}, [0.1, 0.2], "numbers: [0.1, 0.2]: must be whole numbers"),
    ],
)
def test_mistakes_of_a_training_loop_are_named(keys: dict[str, Any], numbers: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        Inject({"dust_on_optics": {}}, camera=CAMERA, **keys)(torch.zeros((2, 1, 64, 64)), numbers)
