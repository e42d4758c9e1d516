"""Take the images of a sample: the image with its faults, the clean twin, and the twins without one fault."""

from __future__ import annotations

from .spec import Images, Injection, SampleSpec, stored_layers


def take_images(spec: SampleSpec, injection: Injection) -> Images:
    """Take the images that the scene stores. They share radiance, exposure and noise."""
    draws, development = injection.draws, injection.development
    layers = stored_layers(spec.scene, spec.faults)
    image = development.image(draws)
    twins = [layer.removeprefix("without_") for layer in layers if layer.startswith("without_")]
    return Images(
        image=image,
        clean=development.image({}),
        without={name: development.twin(draws, name) if name in draws else image for name in twins},
        raw=development.raw(draws) if "raw" in layers else None,
        defects=development.defects(draws) if "defects" in layers else None,
    )
