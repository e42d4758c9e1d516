"""The ROS 2 node of docs/howto/streams.md, run on the message definitions of ROS 2 without ROS itself."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import make_dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import vbnfault

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "streams.md"
sys.path.insert(0, str(PAGE.parents[1] / "_ext"))

import blocks  # noqa: E402

FIELDS = ("header", "height", "width", "encoding", "is_bigendian", "step", "data")  # of sensor_msgs/Image
HEIGHT, WIDTH, PADDING = 48, 64, 8


def image_type() -> Any:
    """Return the message as rosbags reads its definition, or without that package a class with its fields."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        return make_dataclass("Image", FIELDS)
    return get_typestore(Stores.ROS2_HUMBLE).types["sensor_msgs/msg/Image"]


class Node:
    """Stand in for rclpy's class: keep the subscriber, and what is published by topic."""

    def __init__(self, name: str) -> None:
        self.name, self.published = name, {}
        self.subscribers: dict[str, Callable[[Any], None]] = {}

    def create_publisher(self, _kind: type, topic: str, _depth: int) -> SimpleNamespace:
        return SimpleNamespace(publish=lambda message: self.published.setdefault(topic, []).append(message))

    def create_subscription(self, _kind: type, topic: str, function: Callable[[Any], None], _depth: int) -> None:
        self.subscribers[topic] = function


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the node of the page, in a folder with its scene."""
    monkeypatch.chdir(tmp_path)
    files = {block.file: block.text for block in blocks.blocks(PAGE.read_text(encoding="utf-8"), "streams.md")}
    Path("camera.toml").write_text(files["camera.toml"], encoding="utf-8")
    modules = {name: ModuleType(name) for name in ("rclpy", "rclpy.node", "sensor_msgs", "sensor_msgs.msg")}
    vars(modules["rclpy.node"])["Node"] = Node
    vars(modules["sensor_msgs.msg"])["Image"] = image_type()
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    names: dict[str, Any] = {"__name__": "faulty_camera"}
    exec(compile(files["faulty_camera.py"], "faulty_camera.py", "exec"), names)
    return names["FaultyCamera"]()


@pytest.mark.parametrize("big_endian", [0, 1])
@pytest.mark.parametrize(
    ("encoding", "kind", "channels"),
    [("mono8", "u1", 1), ("mono16", "u2", 1), ("rgb8", "u1", 3), ("bgr8", "u1", 3), ("bayer_rggb8", "u1", 1)],
)
def test_a_node_publishes_the_faulty_image_and_its_masks(
    node: Any, encoding: str, kind: str, channels: int, big_endian: int
) -> None:
    if encoding == "bayer_rggb8":
        scene = vbnfault.load_scene("camera.toml", {"image.white_dn": 255})
        node.injector = vbnfault.Injector(scene, effects=False)
    top = np.iinfo(kind).max
    image = np.random.default_rng(3).integers(0.3 * top, 0.6 * top, (HEIGHT, WIDTH, channels)).astype(kind)
    order = ">" if big_endian else "<"
    rows = image.astype(np.dtype(kind).newbyteorder(order)).reshape(HEIGHT, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, PADDING)), constant_values=255)
    header = SimpleNamespace(frame_id="camera")
    fields = (header, HEIGHT, WIDTH, encoding, big_endian, padded.shape[1], padded.ravel())
    node.subscribers["image_raw"](image_type()(**dict(zip(FIELDS, fields, strict=True))))
    (faulty,), (masks,) = node.published["image_faulty"], node.published["image_masks"]
    assert (faulty.encoding, faulty.header, faulty.step) == (encoding, header, WIDTH * image[0, 0].nbytes)
    after = np.frombuffer(faulty.data, np.dtype(kind).newbyteorder("<")).reshape(image.shape)
    bits = np.frombuffer(masks.data, "<u2").reshape(HEIGHT, WIDTH)
    assert masks.encoding == "mono16"
    assert 0 < bits.max() < 1 << len(node.injector.faults)
    changed = (after != image).any(axis=2)
    assert changed.any()
    assert after[changed].max() > 0.4 * top  # white is that of the type
    np.testing.assert_array_equal(after[bits == 0], image[bits == 0])
    colours = image[..., ::-1] if encoding == "bgr8" else image
    expected = node.injector(colours, raw=encoding.startswith("bayer")).image.reshape(image.shape)
    np.testing.assert_array_equal(after, expected[..., ::-1] if encoding == "bgr8" else expected)
