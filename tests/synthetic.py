"""Synthetic samples, stores and builds: what the tests of stores and builds share, without a renderer."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.process import activity
from vbnfault.core.quantities import Sample
from vbnfault.dataset import build as bd

FAULTS = ("dust_on_optics", "broken_pixels", "straylight", "vignetting")
LOCALISED = FAULTS[:3]
SAMPLES = 18


def make_spec(size: int = 24, **changes: object) -> st.StoreSpec:
    """A small spec with every kind of optional layer; 4 samples a shard."""
    values: dict = {
        "height": size,
        "width": size + 8,
        "faults": FAULTS,
        "mask_any_faults": LOCALISED,
        "wavelength_nm": (450.0, 550.0, 650.0),
        "layers": ("without_straylight", "mask_effect", "raw", "depth_m", "normal", "semantic", "radiance"),
        "site_names": ("site-0", "site-1", "site-2"),
        "lens_names": ("thin",),
        "detector_names": ("a", "b"),
        "shard_samples": 4,
        "attributes": {"scene": {"body": {"name": "67P"}, "samples": 10}, "scene_hash": "abc", "seed": 7},
    }
    return st.StoreSpec(**{**values, **changes})


def fake_sample(spec: st.StoreSpec, index: int, site: int | None = None) -> Sample:
    """A deterministic sample that satisfies every rule of labelling."""
    rng = np.random.default_rng([11, index])
    h, w = spec.height, spec.width
    injected = rng.random(len(spec.faults)) < 0.6
    y, x = np.mgrid[:h, :w] / h
    shade = np.clip(140 * (y > 0.4) * (0.6 + 0.4 * np.sin(7 * x + index)), 0, 255)
    clean = np.clip(shade[..., None] + rng.normal(8, 2, (h, w, 4)), 0, 255).astype(np.uint8)
    image, mask = clean.copy(), np.zeros((len(spec.faults), h, w), bool)
    for k, fault in enumerate(spec.faults):
        if injected[k]:
            cx, cy, r = rng.uniform(0.2, 0.8, 3)
            mask[k] = np.hypot(x - cx, y - cy) < r / 4 if fault in LOCALISED else True
            image[mask[k]] = np.clip(image[mask[k]] * (0.5, 0.2, 2.0, 0.8)[k], 0, 255).astype(np.uint8)
    layers = {
        "image": image,
        "clean": clean,
        "mask": mask,
        "without_straylight": clean if dict(zip(spec.faults, injected, strict=True)).get("straylight") else image,
        "mask_effect": mask,
        "raw": rng.integers(0, 4096, (h, w), dtype=np.uint16),
        "depth_m": np.where(y > 0.4, 100 / (y + 0.1), np.inf).astype(np.float32),
        "normal": np.zeros((h, w, 3), np.float16),
        "semantic": (y > 0.4).astype(np.uint8),
        "radiance": rng.random((3, h, w)).astype(np.float16),
    }
    scalars: dict = {}
    for name, row in st.SCALARS.items():
        scalars[name] = rng.standard_normal(spec.shape(row)) if row.dtype == "float64" else 0
    site = index // 3 % 3 if site is None else site
    scalars |= {
        "injected": injected,
        "sun_xy_px": (np.nan, np.nan),
        "tries": 1,
        "stratum": index % 2,
        "site": site,
        "split": st.SPLITS[site % 3],
        "resolved": True,
        "parameters": {
            f: {"amplitude": 0.5, "x": index} for f, on in zip(spec.faults, injected, strict=True) if on
        },
        "proposal": json.dumps({"sun_elevation_deg": index / 10}),
    }
    wanted = (*spec.pixel_layers, "mask")
    return Sample(index=index, layers={k: v for k, v in layers.items() if k in wanted}, scalars=scalars)


def filled(path: Path, samples: int = 10, **changes: object) -> st.Store:
    """A finished store."""
    store = st.create(path, make_spec(**changes), samples)
    st.write_samples(store, [fake_sample(store.spec, i) for i in range(samples)])
    return store


def of_a_scene(path: Path, samples: int = 6) -> st.Store:
    """A finished store whose attributes and plan are those of a real scene; its pixels are made up."""
    from conftest import small_scene

    from vbnfault import dataset, pipeline
    from vbnfault.scene import config

    table = small_scene(
        dataset={
            "samples": samples,
            "shard_samples": 2,
            "sites": 3,
            "layers": ["clean", "mask_effect", "depth_m", "normal", "semantic", "radiance"],
            "licence": "CC0-1.0",
            "citation": "A test",
        },
        camera={"width_px": 40, "height_px": 32},
    )
    table["faults"] = {name: {} for name in FAULTS}
    session = pipeline.Session(config.parse_scene(table, source="described"))
    spec = dataset.store_spec(session, (samples,))
    store = st.create(path, spec, samples)
    expected = dataset.planned(spec.attributes, spec.faults)
    made = []
    for i in range(samples):
        sample, planned = fake_sample(spec, i), expected(i, 1)
        injected = planned["injected"].tolist()
        of_fault = {"model": "made_up", "noise_seed": 2**62 + i, "x": [i, i + 0.5]}
        drawn = {f: of_fault for f, on in zip(FAULTS, injected, strict=True) if on}
        masks = np.stack([blobs(spec, i, k) & on for k, on in enumerate(injected)])
        layers = {**sample.layers, "mask": masks, "radiance": made_up_radiance(spec, i)}
        scalars = {**sample.scalars, **planned, "parameters": drawn, "exposure_s": 0.01 * (i + 1)}
        made.append(dataclasses.replace(sample, layers={**layers, "mask_effect": masks}, scalars=scalars))
    st.write_samples(store, made)
    return store


def made_up_radiance(spec: st.StoreSpec, index: int) -> np.ndarray:
    """Made-up radiance of one sample."""
    shape = (len(spec.wavelength_nm), spec.height, spec.width)
    return np.random.default_rng([12, index]).random(shape).astype(spec.radiance_dtype)


def blobs(spec: st.StoreSpec, index: int, fault: int) -> np.ndarray:
    """A mask of several regions: single pixels, rings with holes, lines, whatever chance gives; never empty."""
    rng = np.random.default_rng([13, index, fault])
    if spec.faults[fault] not in LOCALISED:
        return np.ones((spec.height, spec.width), bool)
    y, x = np.mgrid[: spec.height, : spec.width]
    mask = rng.random((spec.height, spec.width)) < 0.01
    for cx, cy, r in rng.uniform((0, 0, 2), (spec.width, spec.height, 9), (3, 3)):
        mask |= np.abs(np.hypot(x - cx, y - cy) - r) < rng.uniform(0.5, 3)
    mask[rng.integers(spec.height)] |= fault == 1
    return mask


def flip(file: Path, position: int) -> None:
    data = bytearray(file.read_bytes())
    data[position] ^= 0x10
    file.write_bytes(bytes(data))


def repaired(store: st.Store, damaged: list[int], before: str) -> None:
    """Exactly `damaged` is reported; building those again restores the digest, touching no other sample."""
    assert st.problem_samples(store) == damaged
    st.write_samples(store, [fake_sample(store.spec, i) for i in damaged])
    assert st.examine(store).problems == []
    assert st.digest(store) == before


# --- builds -----------------------------------------------------------------------------------------------


def site_of(samples: int = SAMPLES) -> np.ndarray:
    """Shards of 4 that share sites, out of order."""
    return np.arange(samples) // 3 % 3


@dataclass(frozen=True)
class Session:
    """Makes fake samples; may raise, die or write down what it was asked for."""

    raises: frozenset[int] = frozenset()
    dies: frozenset[int] = frozenset()
    dies_once: str = ""  # a file that is made at the first death
    log: str = ""
    stage: str = ""  # told before every sample
    warns: str = ""  # before every sample
    dies_writing: str = ""  # a folder of files; a process dies, once each, as it writes the shards 0 and 1

    def __call__(self) -> Session:
        return self

    def simulate(self, index: int) -> Sample:
        if self.log:
            with open(self.log, "a") as log:
                log.write(f"{os.getpid()} {index}\n")
        if self.stage:
            activity.begin(f"{self.stage} {index}")
        if self.warns:
            warnings.warn(self.warns, stacklevel=1)
        if self.dies_writing:
            die_once_as_two_shards_are_written(Path(self.dies_writing))
        if index in self.raises:
            raise KeyError(f"no terrain for {index}")
        if index in self.dies and not (self.dies_once and Path(self.dies_once).exists()):
            if self.dies_once:
                Path(self.dies_once).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return fake_sample(make_spec(), index, site=int(site_of(index + 1)[-1]))


def die_once_as_two_shards_are_written(folder: Path) -> None:
    """Have this process die before it first writes shard 0 or 1, when all samples of the shard are made."""

    def write(store: st.Store, shard: int, *given: Any, **more: Any) -> Any:
        if shard < 2 and not (folder / str(shard)).exists():
            (folder / str(shard)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return _write_shard(store, shard, *given, **more)

    st.Store.write_shard = write  # type: ignore[method-assign]


_write_shard = st.Store.write_shard


def end_unless(process: int) -> None:
    if os.getpid() != process:
        os.kill(os.getpid(), signal.SIGKILL)


@dataclass(frozen=True)
class Deadly:
    """A factory that kills every other process that receives it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return end_unless, (os.getpid(),)


@dataclass(frozen=True)
class Broken:
    """A factory that cannot make a session."""

    def __call__(self) -> Session:
        raise InputError("67P.obj: no such mesh")


def run(out: Path | str, session: object = None, samples: int = SAMPLES, **options: object) -> bd.Summary:
    """Build made-up samples; `options` are fields of `BuildPlan` and of `BuildOptions`."""
    of_plan = {f.name for f in dataclasses.fields(bd.BuildPlan)} & options.keys()
    planned: dict = {"spec": make_spec(), "site": site_of(samples)} | {name: options.pop(name) for name in of_plan}
    how: dict = {"progress": False, **options}
    return bd.build(session or Session(), bd.BuildPlan(**planned), out, bd.BuildOptions(**how))  # type: ignore[arg-type]


def main(out: str, workers: str, samples: str) -> int:
    """A program; `victim` is how it is started."""
    try:
        run(Path(out), workers=int(workers), samples=int(samples))
    except VbnfaultError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0
