"""Every packaged scene builds a small store with its own geometry, faults, lens and detector, and is read back."""

from __future__ import annotations

import itertools
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray

from vbnfault import dataset, pipeline, store
from vbnfault.cli.options import SceneOptions
from vbnfault.core.files import resources
from vbnfault.scene import config

# Small images over coarse ground: the scene's own camera, faults and bounds of geometry stay.
_SMALL = {"camera.width_px": 64, "camera.height_px": 64, "render.samples_per_pixel": 4, "dataset.sites": 1}


@pytest.mark.parametrize("name", sorted(resources.packaged("scenes")))
def test_every_packaged_scene_builds_a_store_that_verifies(name: str, tmp_path: Path) -> None:
    whole = config.load_scene(name)
    samples = min(2, whole.dataset.samples)
    coarse = {"patch.facet_m": max(whole.patch.facet_m, 15.0), "patch.radius_m": min(whole.patch.radius_m, 60.0)}
    small = {**_SMALL, **coarse, "dataset.samples": samples}
    if whole.is_aimed:  # each sample has its own terrain
        small["patch.boulders"] = False
    if whole.trajectory:  # the samples are of the first sequence; facets are as fine as pixels, up to this limit
        flights = whole.resolved()["trajectory"].get("flight", [])
        # a hop lasts as long as it must
        flown = [f if f["kind"] == "relocation" else {**f, "frames": min(f["frames"], 6)} for f in flights]
        small |= {"patch.max_triangles": 100_000, "trajectory.flight": [{**f, "sequences": 1} for f in flown]}
    if whole.camera.detector:  # so small a corner of a sensor may have no defect that could show in any view
        small["plan.on_invisible"] = "drop"
    scene = config.load_scene(name, small)
    path = tmp_path / "small.zarr"
    summary = dataset.build_scene(scene, path, source=name)
    assert summary.built == samples
    opened = store.open_store(path)
    report = store.examine(opened, expected=dataset.planned(opened.attributes, opened.spec.faults))
    assert report.problems == []
    assert whole.camera.detector or report.counts.missing == {}
    with xarray.open_zarr(path) as data:
        assert data["image"].shape == (samples, 64, 64, 4)
        assert set(whole.dataset.layers) <= {*data.data_vars, "without_straylight"}
        assert list(data["fault"].values) == list(opened.spec.faults)
        # nothing is stored for a sample that is not finished
        assert np.asarray(data["done"].values).all()
        for variable in data.data_vars.values():
            variable.load()


def test_every_image_of_quickstart_shows_lit_ground() -> None:
    small = {**_SMALL, "dataset.sites": 4, "patch.max_triangles": 100_000}
    session = pipeline.Session(config.load_scene("quickstart", small))
    for index in range(session.scene.dataset.samples):
        intensity = session.frame(index).images.clean.array[..., 3]
        # asked for is 0.2 by rays; the ground is brighter than 16 DN except where the light is grazing
        assert (intensity >= 16).mean() > 0.15, index


@pytest.mark.parametrize("name", sorted(resources.packaged("scenes")))
def test_the_commands_in_a_scenes_comments_are_accepted(name: str) -> None:
    """Each `--set` that a scene file shows names keys and values that its faults take."""
    text = (resources.data_dir("scenes") / f"{name}.toml").read_text(encoding="utf-8")
    shown = [shlex.split(line.lstrip("# ")) for line in text.splitlines() if line.startswith("#     vbnfault ")]
    for words in shown:
        assert words[2] == name
        settings = [value for option, value in itertools.pairwise(words) if option == "--set"]
        pipeline.configure_faults(SceneOptions(settings=settings).load(name), name)
