"""Show every fault class of the detector alone, on a scene and in the dark, at full size with its mask.

    python benchmarks/detector_gallery.py --out gallery
    python benchmarks/detector_gallery.py --out gallery --scene physical67p --sample 401
    python benchmarks/detector_gallery.py --out gallery --set camera.detector=generic_ccd --dark-s 5

Writes CLASS_scene.png and CLASS_dark.png for each class. The left half is the image. The right half is its
difference from the clean image, eight times as strong and around grey, with the mask in green.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from vbnfault.core.files.images import write_png
from vbnfault.faults import registry
from vbnfault.pipeline import Session, masks
from vbnfault.pipeline.development import Development
from vbnfault.pipeline.spec import Draw, Frame, SceneExposure, SceneLight
from vbnfault.scene.config import load_scene
from vbnfault.world.cameras import mosaic_sensor

MODELS = {"broken_pixels": "hot_pixels", "broken_lines": "readout"}
CLASSES = [name for name, models in registry().items() for m in models.values() if m.needs_mosaic]


def main() -> None:
    """Write the images and print the drawn parameters."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="navcam67p")
    parser.add_argument("--sample", type=int, default=24)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--dark-s", type=float, default=1.0, help="exposure of the dark pictures")
    parser.add_argument("--only", nargs="*", default=CLASSES)
    given = parser.parse_args()
    overrides = {key: _value(value) for key, _, value in (entry.partition("=") for entry in given.set)}
    scene = load_scene(given.scene, {**overrides, "plan.faulty_fraction": 0.0, "dataset.layers": ["clean"]})
    cmos = mosaic_sensor(scene.camera).architecture == "cmos"
    possible = [name for name in given.only if not (cmos and next(iter(registry()[name].values())).needs_ccd)]
    faults = {name: {"model": MODELS[name]} if name in MODELS else {} for name in possible}
    session = Session(scene.model_copy(update={"faults": faults}))
    frame = session.frame(given.sample)
    given.out.mkdir(parents=True, exist_ok=True)
    for kind in ("scene", "dark"):
        development = frame.injection.development if kind == "scene" else _dark(frame, given.dark_s)
        clean = development.image({}).array
        for name in possible:
            fault = frame.spec.faults[name]
            params = fault.draw(development.context, frame.spec.rng("fault", f"{name}/0"))
            draws = {name: Draw(fault=fault, attempt=0, params=params)}
            image = development.image(draws).array
            effects = {name: development.effect(draws, name)}
            mask = masks.mask_layers({name: fault}, {name: params}, development.context, effects)[0]
            pair = np.hstack([image[..., :3], _seen(image, clean, mask)])
            write_png(given.out / f"{name}_{kind}.png", pair)
            short = {k: v for k, v in params.items() if not isinstance(v, list | dict)}
            print(f"{kind} {name}: mask {mask.mean():.4f}", json.dumps(short), flush=True)


def _value(text: str) -> object:
    """Return a setting's value: parsed as JSON if possible, otherwise the text."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _dark(frame: Frame, exposure_s: float) -> Development:
    """Return the images that the same camera would take without any light."""
    camera = replace(frame.camera, exposure_s=exposure_s)
    rate, light = frame.exposure.rate.merged, frame.exposure.light
    black = light.rendered.with_array(np.zeros_like(light.rendered.array))
    exposure = SceneExposure(
        camera=camera,
        light=SceneLight(lens=light.lens, rendered=black),
        rate=rate.with_array(np.zeros_like(rate.array)),
    )
    return Development(exposure=exposure, context=replace(frame.context, camera=camera), rng=frame.spec.rng)


def _seen(image: np.ndarray, clean: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the amplified difference of two images around grey, with the mask in green."""
    change = 8 * (image[..., :3].astype(np.int16) - clean[..., :3]) + 96
    out = np.clip(change, 0, 255).astype(np.uint8)
    out[mask] = (0.75 * out[mask] + 0.25 * np.array([0, 255, 0])).astype(np.uint8)
    return out


if __name__ == "__main__":
    main()
