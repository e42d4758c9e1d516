"""Compare faults in images with the corruptions of imagecorruptions and Albumentations that are like them.

`inject_speed.py` prints the table. Each corruption and the fault that is like it act on the same image of 8 bits in
turns. Beside the processor times stands a figure that physics fixes, measured on both. The other packages have
their mildest settings, and where they leave the strength open, that of the fault.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from turns import in_turns

from vbnfault import Injector
from vbnfault.camera import Camera
from vbnfault.core.quantities import Electrons
from vbnfault.scene.config import Scene

Arm = Callable[[int], Any]
Act = Callable[[np.ndarray, int], np.ndarray]  # from an image and its number

PAPER: dict[str, dict[str, Any]] = {
    "dust_on_optics": {"model": "gaussian"},
    "broken_pixels": {"model": "texture"},
    "broken_lines": {"model": "texture"},
    "straylight": {"model": "texture"},
    "vignetting": {"model": "cos4"},
    "optics_degradation": {"model": "gaussian"},
}
HOT = {"model": "hot_pixels", "years": [5, 5], "growth_factor": [100, 100], "dose_TeV_g": [1, 1]}
FULL_WELL_E, READ_E, BRIGHT_E, DARK_E = 13500.0, 13.0, 10000.0, 2500.0
SUN_SIGMA_PX, SUN_RADIUS_PX, SUN_OVER_WHITE = 2.9, 4.0, 1e5  # of the widest blur of the paper
FLARE_PX, NEAR_SUN_PX = 512, 60  # size of the image of a flare; how near to the Sun its glare is left aside


def injector(faults: Mapping[str, Any], image: Mapping[str, Any] | None = None, **camera: Any) -> Injector:
    """Return what injects faults into images of a camera; masks alone, without what each fault changes."""
    tables = {"title": "benchmark", "dataset": {"seed": 1}, "faults": dict(faults), "image": dict(image or {})}
    return Injector(Scene.model_validate({**tables, "camera": {"exposure_s": 0.01, **camera}}), effects=False)


def textured(size_px: int, channels: int = 1) -> np.ndarray:
    """Return an image of soft texture with black and white in it, uint8[y, x] or [y, x, channel]."""
    noise = np.random.default_rng(0).normal(90, 60, (size_px, size_px, channels))
    smooth = cv2.GaussianBlur(noise, (0, 0), 9).reshape(noise.shape) - 90
    image = np.clip(90 + smooth * 20, 0, 255).astype(np.uint8)
    return image[..., 0] if channels == 1 else image


def injected(faults: Mapping[str, Any], image: Mapping[str, Any] | None = None, **camera: Any) -> Act:
    """Return a function from an image and its number to the image with faults."""
    run = injector(faults, image, **camera)
    return lambda given, number: run(given, number).image


# --- figures ----------------------------------------------------------------------------------------------------


def noise_of_light(act: Act) -> float:
    """Return the variance of a flat of 10,000 e⁻ in an image with half as dark a flat, over light plus readout."""
    return variance_e2(act)[0] / (BRIGHT_E + READ_E**2)


def brighter_over_darker(act: Act) -> float:
    """Return how many times the variance of 2,500 e⁻ that of 10,000 e⁻ has."""
    bright, dark = variance_e2(act)
    return bright / dark


def variance_e2(act: Act) -> tuple[float, float]:
    """Return the variances of the bright and the dark half of an image without noise, of green."""
    image = np.full((256, 512, 3), round(BRIGHT_E / FULL_WELL_E * 255), np.uint8)
    image[:, 256:] = round(DARK_E / FULL_WELL_E * 255)
    green = act(image, 0)[..., 1] / 255 * FULL_WELL_E
    return float(green[:, :256].var()), float(green[:, 256:].var())


def light_kept(act: Act) -> float:
    """Return the light of a bright disc on a dark sky after the blur over that before, in an sRGB image."""
    image = np.full((128, 128, 3), 10, np.uint8)
    cv2.circle(image, (64, 64), 6, (240, 240, 240), -1)
    return float(linear(act(image, 0)).sum() / linear(image).sum())


def linear(srgb: np.ndarray) -> np.ndarray:
    """Return light over that of white, by IEC 61966-2-1."""
    code = srgb / 255
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def sun() -> np.ndarray:
    """Return light with the Sun's disc in it, in times of white, float32[y, x, 3]."""
    light = np.full((128, 128, 3), 0.1, np.float32)
    cv2.circle(light, (64, 64), round(SUN_RADIUS_PX), (SUN_OVER_WHITE,) * 3, -1)
    return light


def white_around_sun(act: Act) -> float:
    """Return how many pixels are white after the blur, over those of light that spreads before it saturates."""
    spread = cv2.GaussianBlur(sun(), (35, 35), SUN_SIGMA_PX)
    shown = act(np.rint(255 * np.minimum(sun(), 1)).astype(np.uint8), 0)
    return float((shown[..., 1] == 255).sum() / (spread[..., 1] >= 1).sum())


def off_the_line(at: Callable[[tuple[float, float]], Act]) -> float:
    """Return how far the added light's centre is from the line through Sun and centre, rms of eight Suns, in px."""
    image = np.full((FLARE_PX, FLARE_PX, 3), 40, np.uint8)
    y, x = np.mgrid[:FLARE_PX, :FLARE_PX] + 0.5 - FLARE_PX / 2
    offsets = []
    for k in range(8):
        angle = 2 * np.pi * (k + 0.3) / 8
        along = np.array([np.cos(angle), np.sin(angle)])
        at_px = 0.33 * FLARE_PX * along
        added = np.maximum(at(tuple(at_px + FLARE_PX / 2))(image, k).astype(float) - image, 0).sum(axis=2)
        added[np.hypot(x - at_px[0], y - at_px[1]) < NEAR_SUN_PX] = 0
        if added.any():
            offsets.append((added * (x * along[1] - y * along[0])).sum() / added.sum())
    return float(np.sqrt(np.mean(np.square(offsets))))


def shine_in_the_dark(act: Act) -> float:
    """Return the highest number that is added to a black image."""
    return float(act(np.zeros((512, 512, 3), np.uint8), 0).max())


def defects_that_stay(act: Act) -> float:
    """Return which fraction of the pixels that differ in an image do so in the next, too."""
    flat = np.full((256, 256, 3), 100, np.uint8)
    first, second = ((act(flat, k) != flat).any(axis=2) for k in (0, 1))
    return float((first & second).sum() / first.sum())


# --- rows -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """Name a corruption and the fault that is like it, what each makes of an image, and a figure of both.

    `there` and `here` get an image and its number; where `figure` moves the Sun, they get its position first.
    """

    name: str
    fault: str
    there: Any
    here: Any
    figure: Callable[[Any], float]
    physics: float
    meaning: str
    moves_sun: bool = False

    def acts(self, size_px: int) -> tuple[Act, Act]:
        """Return both as functions of an image and its number, with a Sun in the image."""
        if not self.moves_sun:
            return self.there, self.here
        sun_px = (0.68 * size_px, 0.3 * size_px)
        return self.there(sun_px), self.here(sun_px)


@cache
def camera_of(run: Injector, shape: tuple[int, ...]) -> Camera:
    """Return the camera of images of a shape."""
    return run(np.zeros(shape, np.uint8)).camera


def camera_noise(image: np.ndarray, number: int) -> np.ndarray:
    """Take light without noise by a camera, which draws its own noise."""
    camera = camera_of(CAMERA, image.shape)
    white = camera.detector.white_e
    light = Electrons(array=(image / np.float32(255) * white).astype(np.float32), white_e=white)
    return CAMERA(light, number, camera=camera).image[..., :3]


CAMERA = injector({}, full_well_e=FULL_WELL_E, read_noise_e_rms=READ_E)


def flare(**table: Any) -> Callable[[tuple[float, float]], Act]:
    """Return what makes a function that adds straylight of a Sun at a position."""
    run = injector({"straylight": table}, fov_deg=20.0)
    return lambda sun_px: lambda image, number: run(image, number, sun=sun_px).image


def blurred_sun(image: np.ndarray, number: int) -> np.ndarray:
    """Blur the Sun before it saturates, of which an image of 8 bits no longer has the light."""
    if (image == 255).all(axis=2).any() and image.shape == sun().shape:
        camera = camera_of(BLUR, image.shape)
        light = Electrons(array=sun() * camera.detector.white_e, white_e=camera.detector.white_e)
        return BLUR(light, number, camera=camera).image[..., :3]
    return BLUR(image, number).image


BLUR = injector(
    {"optics_degradation": {"filter_size_px": [17, 17], "scale_with_resolution": False, "unclipped": True}}
)


def rows() -> list[Row]:
    """Return the comparisons. Raises ImportError without the other packages."""
    import albumentations as alb
    import imagecorruptions

    def of(transform: Any) -> Act:
        def act(image: np.ndarray, number: int) -> np.ndarray:
            transform.set_random_seed(number)
            return transform(image=image)["image"]

        return act

    def corrupted(name: str, severity: int = 1) -> Act:
        return lambda image, number: imagecorruptions.corrupt(image, severity, name)

    def sun_flare(method: str) -> Callable[[tuple[float, float]], Act]:
        def at(sun_px: tuple[float, float]) -> Act:
            def act(image: np.ndarray, number: int) -> np.ndarray:
                x, y = (p / n for p, n in zip(sun_px, image.shape[1::-1], strict=True))
                roi = (x, y, x + 1e-6, y + 1e-6)
                return of(alb.RandomSunFlare(flare_roi=roi, src_radius=40, method=method, p=1))(image, number)

            return act

        return at

    iso = of(alb.ISONoise(color_shift=(0.01, 0.01), intensity=(0.1, 0.1), p=1))
    smooth = of(alb.GaussianBlur(sigma_limit=(SUN_SIGMA_PX,) * 2, blur_limit=0, p=1))
    shot, defocus = corrupted("shot_noise"), corrupted("defocus_blur")
    light = "variance of a flat of 10,000 e⁻, over that of light and readout"
    more = "variance of 10,000 e⁻ over that of 2,500 e⁻, both rounded to 8 bits"
    kept = "light of an sRGB image after the blur over that before"
    white = "white pixels around the Sun over those of light that spreads before it saturates"
    line = "distance of the added light from the line through Sun and centre, px rms"
    dark = "highest number that is added to a black image"
    stay = "fraction of the changed pixels that the next image has, too"
    srgb = injected(
        {"optics_degradation": {"filter_size_px": [17, 17], "scale_with_resolution": False}}, {"response": "srgb"}
    )
    hot = injected({"broken_pixels": HOT}, detector="generic_cmos")
    dust = injected({"dust_on_optics": {"model": "gaussian"}})
    traced, texture = flare(model="traced"), flare(model="texture")
    blur, sensor = "optics_degradation", "the detector's noise"
    code_e = FULL_WELL_E / 255
    lit = (BRIGHT_E + READ_E**2 + code_e**2 / 12) / (DARK_E + READ_E**2 + code_e**2 / 12)
    return [
        Row("shot_noise", sensor, shot, camera_noise, noise_of_light, 1, light),
        Row("ISONoise", sensor, iso, camera_noise, noise_of_light, 1, light),
        Row("ISONoise", sensor, iso, camera_noise, brighter_over_darker, lit, more),
        Row("defocus_blur", blur, defocus, srgb, light_kept, 1, kept),
        Row("GaussianBlur", blur, smooth, srgb, light_kept, 1, kept),
        Row("GaussianBlur", f"{blur}, unclipped", smooth, blurred_sun, white_around_sun, 1, white),
        Row("RandomSunFlare", "straylight/texture", sun_flare("overlay"), texture, off_the_line, 0, line, True),
        Row("RandomSunFlare", "straylight/traced", sun_flare("physics_based"), traced, off_the_line, 0, line, True),
        Row("spatter", "dust_on_optics", corrupted("spatter"), dust, shine_in_the_dark, 0, dark),
        Row("impulse_noise", "broken_pixels", corrupted("impulse_noise"), hot, defects_that_stay, 1, stay),
        Row("PixelDropout", "broken_pixels", of(alb.PixelDropout(p=1)), hot, defects_that_stay, 1, stay),
    ]


def table(size_px: int, rounds: int) -> str:
    """Return the table, or a sentence that says what is missing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of versions that Albumentations looks for
            compared = rows()
    except ImportError as error:
        return f"not compared with other packages: {error}"
    image, arms = textured(size_px, 3), {}
    for number, row in enumerate(compared):
        for side, act in zip(("there", "here"), row.acts(size_px), strict=True):
            arms[f"{side} {number}"] = lambda k, act=act: act(image, k)
    turns = in_turns(arms, rounds)
    head = ("there", "CPU ms", "here", "CPU ms", "there", "here", "physics")
    lines = ["{:<18}{:>6}  {:<30}{:>6}  {:>8}{:>8}{:>9}  figure".format(*head)]
    for number, row in enumerate(compared):
        used = [turns.processor_ms[f"{side} {number}"] for side in ("there", "here")]
        figures = [round(row.figure(act), 3) for act in (row.there, row.here)]
        lines.append(
            f"{row.name:<18}{used[0]:6.0f}  {row.fault:<30}{used[1]:6.0f}  "
            f"{figures[0]:8.3g}{figures[1]:8.3g}{row.physics:9.3g}  {row.meaning}"
        )
    return "\n".join([*lines, str(turns)])
