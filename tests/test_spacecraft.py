"""The vehicle: files into parts, materials, poses, and the default lander."""

from __future__ import annotations

import json
import struct
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from poses_kit import columns_of, row
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.files import meshes
from vbnfault.pipeline import Session
from vbnfault.scene.config import parse_scene
from vbnfault.world import assemble, spacecraft
from vbnfault.world.spacecraft import HingePose, Material, Part, Spacecraft, load_spacecraft

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import lander

CORNERS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\n"
OBJ = (
    "# a comment that says o nothing\nmtllib missing.mtl\n"
    + CORNERS
    + "vt 0 0\nvn 0 0 1\n"
    + "o bus\nusemtl gold foil\nf 1/1/1 2/1/1 3/1/1\nf 1 3 4\nusemtl white_paint\nf 5//1 6//1 7//1\n"
    + "o wing\ng panel\nusemtl cells\ns off\nf 1 2 3 4\ng yoke\nusemtl gold foil\nf -1 -2 -3\nf 1 1 2\n"
)


@pytest.fixture
def obj(tmp_path: Path) -> Path:
    path = tmp_path / "vehicle.obj"
    path.write_text(OBJ, encoding="utf-8")
    return path


def write(folder: Path, text: str, name: str = "vehicle.obj") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def box(material: str, centre: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix(centre))
    mesh.visual = TextureVisuals(material=PBRMaterial(name=material))
    return mesh


@pytest.fixture
def glb(tmp_path: Path) -> Path:
    """bus ─ wing (moved by 2 along x) ─ panel (mirrored in x), a box each."""
    scene = trimesh.Scene()
    scene.add_geometry(box("gold"), node_name="bus", geom_name="bus_mesh")
    moved = trimesh.transformations.translation_matrix([2, 0, 0])
    scene.add_geometry(box("cells"), "wing", "wing_mesh", parent_node_name="bus", transform=moved)
    mirrored = np.diag([-1.0, 1, 1, 1])
    scene.add_geometry(
        box("black_paint", (1, 0, 0)), "panel", "panel_mesh", parent_node_name="wing", transform=mirrored
    )
    path = tmp_path / "vehicle.glb"
    scene.export(path)
    return path


# ------------------------------------------------------------------------------------ files


def test_obj_parts_and_materials(obj: Path) -> None:
    vehicle = load_spacecraft(
        obj, materials={"gold foil": "gold_mli", "panel": "solar_cell", "bus": 0.5, "wing/yoke": "aluminium"}
    )
    # a part's own name, or its parent's, goes before its material's
    assert [(part.name, part.material.name, len(part.faces)) for part in vehicle.parts] == [
        ("bus", "grey_0.5", 2),
        ("bus", "grey_0.5", 1),
        ("wing/panel", "solar_cell", 2),
        ("wing/yoke", "aluminium", 1),  # of its two faces one has no area
    ]
    np.testing.assert_array_equal(
        vehicle.parts[3].vertices_B_m[vehicle.parts[3].faces[0]], [[1, 1, 1], [1, 0, 1], [0, 0, 1]]
    )
    assert set(vehicle.names) == {"bus", "wing", "wing/panel", "panel", "wing/yoke", "yoke"}


def test_obj_materials_of_the_file(obj: Path) -> None:
    vehicle = load_spacecraft(obj, materials={"gold foil": "gold_mli"}, default_material="black_mli")
    assert [part.material.name for part in vehicle.parts] == ["gold_mli", "white_paint", "black_mli", "gold_mli"]


def test_obj_without_names_is_one_part_of_the_default_material(tmp_path: Path) -> None:
    vehicle = load_spacecraft(
        write(tmp_path, (CORNERS + "f 1 2 3\nf 4 5 6 7\n").replace("\n", "\r\n"), "plain.obj")
    )
    assert [part.name for part in vehicle.parts] == ["plain"]
    assert len(vehicle.parts[0].faces) == 3
    assert vehicle.parts[0].material.name == "grey_0.3"


def test_obj_with_groups_only_and_scattered_pieces(tmp_path: Path) -> None:
    text = CORNERS + "g left\nf 1 2 3\ng right\nf 2 3 4\ng left\nf 3 4 5\n"
    vehicle = load_spacecraft(write(tmp_path, text))
    assert [(part.name, len(part.faces)) for part in vehicle.parts] == [("left", 2), ("right", 1)]


def test_glb_node_tree(glb: Path) -> None:
    vehicle = load_spacecraft(glb, materials={"cells": "solar_cell", "bus": "gold_mli", "panel": 0.1})
    parts = {part.name: part for part in vehicle.parts}
    assert set(parts) == {"bus", "bus/wing", "bus/wing/panel"}
    # `bus` holds for the nodes below; the panel has its own
    assert {name: part.material.name for name, part in parts.items()} == {
        "bus": "gold_mli",
        "bus/wing": "gold_mli",
        "bus/wing/panel": "grey_0.1",
    }
    centre = {name: part.vertices_B_m.mean(axis=0) for name, part in parts.items()}
    np.testing.assert_allclose(centre["bus/wing"], [2, 0, 0], atol=1e-6)
    np.testing.assert_allclose(centre["bus/wing/panel"], [1, 0, 0], atol=1e-6)  # 2 - 1
    for part in vehicle.parts:  # the mirrored node too is wound outwards
        assert trimesh.Trimesh(part.vertices_B_m, part.faces, process=False).volume == pytest.approx(1)
    of_the_file = load_spacecraft(glb, materials={"cells": "solar_cell"})
    assert [part.material.name for part in of_the_file.parts] == ["grey_0.3", "solar_cell", "black_paint"]


def test_glb_mesh_of_two_materials(glb: Path) -> None:
    raw = glb.read_bytes()
    (length,) = struct.unpack_from("<I", raw, 12)
    tree = json.loads(raw[20 : 20 + length])
    node = next(n for n in tree["nodes"] if n["name"] == "bus")
    other = next(n for n in tree["nodes"] if n["name"] == "wing")
    tree["meshes"][node["mesh"]]["primitives"] += tree["meshes"][other["mesh"]]["primitives"]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = raw[20 + length :]
    glb.write_bytes(raw[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + raw[16:20] + text + rest)
    vehicle = load_spacecraft(glb, materials={"cells": 0.2, "gold": 0.6})
    bus = [part for part in vehicle.parts if "wing" not in part.name.split("/")]
    assert all(part.name.split("/")[0] == "bus" for part in bus)
    assert sorted(part.material.name for part in bus) == ["grey_0.2", "grey_0.6"]


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_units(obj: Path, unit: Any, metres: float) -> None:
    mesh = load_spacecraft(obj, unit=unit).merged()
    np.testing.assert_allclose(np.ptp(mesh.vertices_B_m, axis=0), metres, rtol=1e-6)


def test_placement(obj: Path) -> None:
    keys = {"model": str(obj), "unit": "cm", "roll_deg": 90.0, "yaw_deg": 90.0, "translation_m": [0.0, 0.5, -2.0]}
    placed = assemble.spacecraft(parse_scene({"title": "t", "spacecraft": keys}, source="t.toml"))
    assert placed is not None
    # Rx(90) Rz(90): x -> y -> z, y -> -x, z -> -y
    x, y, z = load_spacecraft(obj).merged().vertices_B_m.T * 0.01
    np.testing.assert_allclose(placed.vertices_B_m, np.stack([-y, -z + 0.5, x - 2.0], axis=1), atol=1e-6)


# ------------------------------------------------------------------------------------ malformed input


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "file is empty"),
        ("hello\n", "has no faces"),
        (CORNERS, "has no faces"),
        (CORNERS + "f 1 2 9\n", "line 8: expected vertex numbers from 1 to 7, found 9"),
        (CORNERS + "f 1 2 x\n", "line 8: expected 'f a b c', three vertex numbers or more, found '1 2 x'"),
        (CORNERS + "f 1 1 2\nf 3 3 3\n", "no face has an area"),
        ("v 0 0 0\nv 900 0 0\nv 0 800 0\nf 1 2 3\n", "measures 900 m in the unit 'm'"),
    ],
)
def test_malformed_obj(tmp_path: Path, text: str, says: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=says) as caught:
        load_spacecraft(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"unsupported spacecraft type '\.stl'; allowed are \.obj, \.glb, \.gltf"):
        load_spacecraft(write(tmp_path, "solid", "a.stl"))


@pytest.mark.parametrize("content", [b"\0", b"glTF\2\0\0\0" + b"\xff" * 40, b"solid nothing", b"glTF\1\0\0\0"])
def test_malformed_glb(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "vehicle.glb"
    path.write_bytes(content)
    with pytest.raises(
        InputError, match=r"its JSON is unreadable|is cut short: a chunk of \d+ bytes|a GLB of version 2"
    ):
        load_spacecraft(path)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"materials": {"wng": 0.5}}, "spacecraft material 'wng': no such name; the vehicle has bus, cells, "),
        (
            {"materials": {"wing": "chrome"}},
            "spacecraft material 'wing' = 'chrome': must be a grey value 0 to 1, a",
        ),
        (
            {"poses": {"leg": HingePose(hinge_B_m=(0, 0, 0), axis_B=(1, 0, 0))}},
            "spacecraft pose 'leg': no such name; the vehicle has bus, panel, wing, wing/panel, wing/yoke, yoke",
        ),
    ],
)
def test_refused_settings(obj: Path, settings: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        load_spacecraft(obj, **settings)
    with pytest.raises(InputError, match=r"axis = \[0, 0, 0\]"):
        HingePose(hinge_B_m=(0, 0, 0), axis_B=(0, 0, 0))


# ------------------------------------------------------------------------------------ poses


def test_a_quarter_turn_about_a_hinge(obj: Path) -> None:
    at_rest = load_spacecraft(obj)
    hinge = HingePose(hinge_B_m=(1.0, 2.0, 0.0), axis_B=(0.0, 0.0, 3.0), angle_deg=90.0)
    posed = at_rest.posed({"wing": hinge})  # which leaves the vehicle as it was
    for before, after in zip(load_spacecraft(obj).parts, posed.parts, strict=True):
        x, y, z = before.vertices_B_m.T
        expected = before.vertices_B_m
        if before.name.startswith("wing/"):  # (x, y) - hinge -> (-dy, dx)
            expected = np.stack([1 - (y - 2), 2 + (x - 1), z], axis=1)
        np.testing.assert_allclose(after.vertices_B_m, expected, atol=1e-12)
        np.testing.assert_array_equal(after.faces, before.faces)
    for before, kept in zip(load_spacecraft(obj).parts, at_rest.parts, strict=True):
        np.testing.assert_array_equal(kept.vertices_B_m, before.vertices_B_m)


def test_any_turn_follows_rodrigues(obj: Path) -> None:
    axis, point, angle = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.7]), 37.0
    pose = HingePose(hinge_B_m=tuple(point), axis_B=tuple(axis), angle_deg=angle)
    k, t = axis / np.linalg.norm(axis), np.radians(angle)
    v = load_spacecraft(obj).parts[0].vertices_B_m - point
    turned = v * np.cos(t) + np.cross(k, v) * np.sin(t) + np.outer(v @ k, k) * (1 - np.cos(t)) + point
    np.testing.assert_allclose(pose.moved(v + point), turned, atol=1e-12)


def test_nested_poses_turn_the_inner_first(obj: Path) -> None:
    # hinges are those at rest: the panel turns on the wing, and its hinge goes along as the wing turns
    outer = HingePose(hinge_B_m=(0.0, 0.0, 0.0), axis_B=(0.0, 0.0, 1.0), angle_deg=90.0)
    inner = HingePose(hinge_B_m=(0.0, 1.0, 0.0), axis_B=(1.0, 0.0, 0.0), angle_deg=180.0)
    rest = {part.name: part for part in load_spacecraft(obj).parts}
    both = {part.name: part for part in load_spacecraft(obj, poses={"wing": outer, "panel": inner}).parts}
    x, y, z = rest["wing/panel"].vertices_B_m.T
    np.testing.assert_allclose(both["wing/panel"].vertices_B_m, np.stack([-(2 - y), x, -z], axis=1), atol=1e-12)
    x, y, z = rest["wing/yoke"].vertices_B_m.T
    np.testing.assert_allclose(both["wing/yoke"].vertices_B_m, np.stack([-y, x, z], axis=1), atol=1e-12)


# ------------------------------------------------------------------------------------ materials


@pytest.mark.parametrize(
    ("name", "absorptance"),  # Fortescue, Swinerd & Stark 2011, table 11.3
    [
        ("white_paint", 0.12),
        ("black_paint", 0.95),
        ("gold_mli", 0.40),
        ("silver_mli", 0.14),
        ("aluminium", 0.21),
        ("solar_cell", 0.88),
    ],
)
def test_solar_absorptance_of_the_named_spectra(name: str, absorptance: float) -> None:
    fine = np.arange(300.0, 2501.0)
    sun = spectra.solar_irradiance_W_m2_nm(fine)
    material = spacecraft.make_material(name)
    mean = np.trapezoid(material.at(fine) * sun, fine) / np.trapezoid(sun, fine)
    assert mean == pytest.approx(1 - absorptance, abs=0.03)
    assert "Fortescue" in material.source
    assert 0 < min(material.reflectance) <= max(material.reflectance) < 1
    assert (np.diff(material.wavelength_nm) > 0).all()


def test_merged_mesh(obj: Path) -> None:
    table = {"wavelength_nm": [400.0, 700.0], "value": [0.1, 0.7]}
    vehicle = load_spacecraft(obj, materials={"bus": 0.5, "panel": table, "yoke": 0.5})
    mesh = vehicle.merged()
    assert (mesh.vertices_B_m.dtype, mesh.faces.dtype, mesh.face_material.dtype) == (np.float32, np.int32, np.int32)
    assert [m.name for m in mesh.materials] == ["grey_0.5", "panel"]
    assert mesh.face_material.tolist() == [0, 0, 0, 1, 1, 0]
    corners = np.concatenate([part.vertices_B_m[part.faces] for part in vehicle.parts])
    np.testing.assert_allclose(mesh.vertices_B_m[mesh.faces], corners, rtol=1e-7)
    reflectance = mesh.reflectance(np.array([350.0, 400.0, 550.0, 700.0, 900.0]))
    np.testing.assert_allclose(reflectance, [[0.5] * 5, [0.1, 0.1, 0.4, 0.7, 0.7]])
    assert reflectance.dtype == np.float64


# ------------------------------------------------------------------------------------ the default vehicle


LEGS = {
    f"leg_{at}": 1.0 if "front" in at else -1.0 for at in ("front_left", "front_right", "back_left", "back_right")
}


def posed(**angles_deg: float) -> Spacecraft:
    """The default vehicle with joints turned, by the beginnings of their names; front and hind legs fold apart."""
    rest = spacecraft.default_spacecraft()
    turns = {
        name: replace(hinge, angle_deg=LEGS.get(name, 1.0) * angle)
        for start, angle in angles_deg.items()
        for name, hinge in rest.hinges.items()
        if name.startswith(start)
    }
    return rest.posed(turns)


POSES: list[dict[str, float]] = [{}, {"solar": -90}, {"solar": 37, "antenna": -40, "leg": 100}]


def test_the_default_vehicle_is_what_its_maker_makes() -> None:
    made = meshes.read_obj(lander.lander().encode(), "made")
    for part, kept in zip(made, spacecraft.default_spacecraft().parts, strict=True):
        assert (part.name, part.material) == (kept.name, kept.material.name)
        np.testing.assert_allclose(part.vertices[part.faces], kept.vertices_B_m[kept.faces], atol=1e-12)


@pytest.mark.parametrize("angles", POSES)
def test_default_parts_are_closed_and_clear_of_the_pupil(angles: dict[str, float]) -> None:
    vehicle = posed(**angles)
    merged = vehicle.merged()
    near = np.linalg.norm(merged.vertices_B_m, axis=1) < 0.3
    assert (merged.vertices_B_m[near, 2] < -0.009).all()  # the barrel alone, behind
    assert merged.blocked_fraction(65.0, 32) < 0.03
    for part in vehicle.parts:
        mesh = trimesh.Trimesh(part.vertices_B_m, part.faces, process=False)
        assert mesh.is_watertight, part.name
        assert mesh.is_winding_consistent, part.name
        assert mesh.volume > 0, part.name
        assert mesh.area_faces.min() > 0, part.name


def test_what_the_camera_sees_of_the_default_vehicle() -> None:
    mesh = spacecraft.default_spacecraft().merged()
    assert mesh.blocked_fraction(65.0) == pytest.approx(0.0166, abs=0.002)
    rng = np.random.default_rng(1)
    angle, turn = np.radians(35.0) * np.sqrt(rng.random(1500)), 2 * np.pi * rng.random(1500)
    cone = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    assert not mesh.blocked(cone).any()
    # of the corners of a field of 65° only the lower ones, +y, and mirror images of each other
    slope = 0.96 * np.tan(np.radians(32.5))
    corners = np.array([[x, y, 1.0] for y in (-slope, slope) for x in (-slope, slope)])
    assert mesh.blocked(corners).tolist() == [False, False, True, True]
    # behind the camera is the bus
    assert mesh.blocked(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])).tolist() == [True, False]


def test_default_poses() -> None:
    def normal(angle_deg: float) -> np.ndarray:
        parts = {p.name: p for p in posed(solar=angle_deg).parts}
        cells, panel = (parts[f"solar_array_left/{n}"].vertices_B_m.mean(axis=0) for n in ("cells", "panel"))
        return (cells - panel) / np.linalg.norm(cells - panel)

    np.testing.assert_allclose(normal(0), [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(normal(-90), [0, 0, 1], atol=1e-9)

    def pads(angle_deg: float) -> dict[str, np.ndarray]:
        parts = posed(leg=angle_deg).parts
        return {p.name: p.vertices_B_m.mean(axis=0) for p in parts if p.name.endswith("footpad")}

    deployed, folded = pads(0), pads(90)
    assert len(deployed) == 4
    for name in deployed:  # up is -y
        assert folded[name][1] < deployed[name][1]
    vehicle = spacecraft.default_spacecraft()
    one = vehicle.posed({"solar_array_left": replace(vehicle.hinges["solar_array_left"], angle_deg=30.0)})
    moved = {
        a.name for a, b in zip(one.parts, vehicle.parts, strict=True) if (a.vertices_B_m != b.vertices_B_m).any()
    }
    assert moved == {f"solar_array_left/{n}" for n in ("yoke", "panel", "cells")}
    assert set(vehicle.hinges) <= set(vehicle.names)


def write_box(path: Path, low: tuple[float, ...], high: tuple[float, ...]) -> str:
    """Write a closed box as an OBJ file and return its path."""
    box = trimesh.creation.box(bounds=[low, high])
    lines = [
        "o bus",
        *(f"v {x} {y} {z}" for x, y, z in box.vertices),
        *(f"f {a} {b} {c}" for a, b, c in box.faces + 1),
    ]
    path.write_text("\n".join(lines))
    return str(path)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((-1, -1, -1), (1, 1, 1)),  # around the camera
        ((-0.2, -0.3, -0.01), (0.4, 0.3, 0.5)),  # a part of it alone
        ((-3, -3, 0.5), (3, 3, 0.6)),  # a wall before it
    ],
)
@pytest.mark.parametrize("flown", [False, True])
def test_a_model_that_hides_the_whole_frame_is_named(tmp_path: Path, low: Any, high: Any, flown: bool) -> None:
    """By a build and a description before anything is rendered, and by a sample, with bounds and with poses."""
    table = {"spacecraft": {"model": write_box(tmp_path / "box.obj", low, high)}, "dataset": {"samples": 1}}
    table["patch"] = {"facet_m": 12.0, "radius_m": 60.0, "boulders": False, "max_triangles": 60_000}
    scene = parse_scene({"title": "t", "camera": {"fov_deg": 60.0}, **table}, source="t.toml")
    poses = columns_of([row("a", (9e3, 0.0, 0.0), (1.0, 0.0, 0.0))]) if flown else None
    for act in (Session.warn_of_doubts, lambda session: session.simulate(0)):
        with pytest.raises(
            InputError, match=r"spacecraft\.model: box\.obj: hides the whole frame .*'bus'.*translation_m"
        ):
            act(Session(scene, poses=poses))


def test_a_model_that_hides_most_of_the_frame_is_warned_of(tmp_path: Path) -> None:
    """A wall in the right two thirds of the frame; in the right third it is not remarkable."""
    slope = np.tan(np.radians(30))
    for left, warns in ((-1 / 3, True), (1 / 3, False)):
        model = write_box(tmp_path / "wall.obj", (left * slope, -1, 1.0), (2, 1, 1.1))
        table = {"title": "t", "camera": {"fov_deg": 60.0}, "spacecraft": {"model": model}}
        session = Session(parse_scene(table, source="t.toml"))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            session.warn_of_doubts()
        # 10 or 11 of 16 columns of rays
        assert [("wall.obj" in str(w.message), "69 % of the frame" in str(w.message)) for w in told] == [
            (True, True)
        ] * warns


def test_blocked_against_a_sphere() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0).apply_translation((0, 0, 4))
    grey = Material(name="grey", wavelength_nm=(550.0,), reflectance=(0.3,))
    part = Part(name="ball", vertices_B_m=ball.vertices, faces=ball.faces, material=grey)
    mesh = Spacecraft(parts=(part,)).merged()
    # tan² of asin(1/4) over that of the half field, times π/4; 96² rays, 1280 faces within the ball: 2 %
    expected = np.pi / 4 * np.tan(np.arcsin(0.25)) ** 2 / np.tan(np.radians(20)) ** 2
    assert mesh.blocked_fraction(40.0, 96) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("angles", POSES)
def test_default_keeps_clear_of_the_pupil(angles: dict[str, float]) -> None:
    mesh = posed(**angles).merged()
    near = np.linalg.norm(mesh.vertices_B_m, axis=1) < 0.3
    assert (mesh.vertices_B_m[near, 2] < -0.009).all()  # the barrel alone, behind
    assert mesh.blocked_fraction(65.0, 32) < 0.03
