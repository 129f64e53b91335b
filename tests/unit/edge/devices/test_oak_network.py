"""Detections of an OAK's network in real depthai messages: conversion to pixels, labels, matching to their frame."""

from __future__ import annotations

import io
import json
import tarfile
import threading
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.agents.camera import CameraAgent
from edge.detectors.network.boxes import BoxLabeller, NetworkBox
from edge.devices.base import Frame
from edge.devices.live.oak import OakCamera, OakStream, boxes_in_image, open_archive, open_stream
from edge.devices.settings import OakSettings
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.errors import InputError
from protocols.topics import OBSERVATION
from tests.support.receiving import collect
from tests.support.threads import running

dai = pytest.importorskip("depthai", reason="the extra `oak` is not installed: the OAK driver is not tested")

SENSOR = (1920, 1200)
SIZE = (640, 400)  # a third of the sensor
NETWORK = (300, 300)  # letterboxed: 300x187.5 of it is picture, 56 rows of it above are not
SCALE = NETWORK[0] / SENSOR[0]
SETTINGS = OakSettings(size=SIZE, fps=50.0)
_KEPT: list[Any] = []


def network_transform() -> Any:
    """The transformation from the sensor's image to the network's input."""
    made = dai.ImgTransformation(*SENSOR)
    made.addScale(SCALE, SCALE)
    made.addPadding(56, 57, 0, 0)
    return made


def image_transform() -> Any:
    """The transformation from the sensor's image to the delivered image."""
    made = dai.ImgTransformation(*SENSOR)
    made.addScale(SIZE[0] / SENSOR[0], SIZE[1] / SENSOR[1])
    return made


def results(number: int, *found: tuple[str, float, tuple[float, float, float, float]], transformed: bool = True) -> Any:
    """A message of boxes: label, confidence, and left, top, right, bottom in the sensor's pixels."""
    message = dai.ImgDetections()
    listed = []
    for name, confidence, (left, top, right, bottom) in found:
        one = dai.ImgDetection()
        one.labelName, one.confidence = name, confidence
        one.xmin, one.xmax = left * SCALE / NETWORK[0], right * SCALE / NETWORK[0]
        one.ymin, one.ymax = (top * SCALE + 56) / NETWORK[1], (bottom * SCALE + 56) / NETWORK[1]
        listed.append(one)
    message.detections = listed
    message.setSequenceNum(number)
    if transformed:
        transformation = network_transform()
        assert transformation.getSize() == (NETWORK[0], 300)
        message.setTransformation(transformation)
    return message


def picture(number: int, end_s: float = 0.0) -> Any:
    made = dai.ImgFrame()
    pixels = np.full((SIZE[1], SIZE[0], 3), (number, 20, 200), np.uint8)
    made.setCvFrame(pixels, dai.ImgFrame.Type.BGR888i)
    made.setTransformation(image_transform())
    made.setSequenceNum(number)
    made.setTimestamp(timedelta(seconds=end_s))
    return made


def test_boxes_of_a_letterboxed_network_are_mapped_to_the_delivered_image() -> None:
    message = results(0, ("person", 0.6, (300.0, 150.0, 600.0, 900.0)), ("car", 0.9, (900.0, 600.0, 1500.0, 1050.0)))
    car, person = boxes_in_image(message, picture(0), SIZE)
    assert (car.label, person.label) == ("car", "person")
    assert car.confidence == pytest.approx(0.9)
    assert (person.left, person.top, person.width, person.height) == pytest.approx((100, 50, 100, 250), abs=0.01)
    assert (car.left, car.top, car.width, car.height) == pytest.approx((300, 200, 200, 150), abs=0.01)
    assert [box.label for box in boxes_in_image(message, picture(0), SIZE, keep=("person",))] == ["person"]


def test_invalid_boxes_are_dropped_and_results_without_a_transformation_are_refused() -> None:
    nan = float("nan")
    good = (300.0, 150.0, 600.0, 900.0)
    odd = [("person", 0.9, (nan, 150.0, 600.0, 900.0)), ("person", 0.9, (300.0, 150.0, 300.0, 900.0))]
    outside = ("person", 0.9, (2000.0, 150.0, 2400.0, 900.0))
    assert boxes_in_image(results(0, *odd, ("person", nan, good), outside), picture(0), SIZE) == []
    with pytest.raises(InputError, match="carry no image transformation"):
        boxes_in_image(results(0, ("person", 0.9, good), transformed=False), picture(0), SIZE)


def test_people_keep_their_track_labels_and_a_marker_its_class() -> None:
    labeller = BoxLabeller("cam4-")
    seen = []
    for step in range(8):
        people = [
            NetworkBox("person", 0.9, 100.0 + 15.0 * step, 50.0, 40.0, 120.0),
            NetworkBox("person", 0.8, 400.0, 60.0, 40.0, 110.0),
        ]
        marker = NetworkBox("ball", 0.7, 200.0, 300.0, 16.0, 16.0)
        seen.append(labeller.detections([*(people if step % 2 else people[::-1]), marker], step * 40_000_000, SIZE))
    walker = {one.label for found in seen for one in found if one.kind == "person" and one.u < 300.0}
    stander = {one.label for found in seen for one in found if one.kind == "person" and one.u > 300.0}
    assert len(walker) == len(stander) == 1
    assert walker != stander
    assert all(name.startswith("cam4-p") for name in walker | stander)
    person = next(one for one in seen[0] if one.u < 300.0 and one.kind == "person")
    assert (person.u, person.size, person.box) == (119.5, 120.0, (100.0, 50.0, 40.0, 120.0))
    assert (person.head, person.foot) == ((119.5, 49.5), (119.5, 169.5))
    assert person.covariance == pytest.approx((4.0, 0.0, 36.0))
    ball = seen[0][-1]
    assert (ball.label, ball.kind, ball.u, ball.v, ball.size) == ("ball", "marker", 207.5, 307.5, 16.0)


def stream(pictures: list[Any], found: list[Any]) -> OakStream:
    """A real host-only pipeline that sends these pictures and results."""

    class Board(dai.node.ThreadedHostNode):
        def __init__(self) -> None:
            super().__init__()
            self.out, self.results = self.createOutput(), self.createOutput()
            self.done = threading.Event()

        def run(self) -> None:
            for one in pictures:
                self.out.send(one)
            for one in found:
                self.results.send(one)
            self.done.set()

    pipeline = dai.Pipeline(False)
    board = pipeline.create(Board)
    queue = board.out.createOutputQueue(maxSize=32, blocking=False)
    detection_queue = board.results.createOutputQueue(maxSize=32, blocking=False)
    pipeline.start()
    # depthai joins a Python node's thread with the interpreter held: it must have ended before the pipeline goes.
    assert board.done.wait(20.0)
    _KEPT.append((pipeline, board, queue, detection_queue))
    return OakStream(pipeline, queue, detection_queue)


def test_detections_are_delivered_with_their_own_frame_at_its_mid_exposure() -> None:
    """The network skips images 1 and 3; the image of result 5 was lost."""
    box = (300.0, 150.0, 600.0, 900.0)
    pictures = [picture(number, 100.0 + number / 50.0) for number in (0, 1, 2, 3, 4, 6)]
    other = (900.0, 150.0, 1200.0, 900.0)
    found = [results(0), *(results(number, ("person", 0.9, box)) for number in (2, 4, 5, 6))]
    found[3] = results(5, ("person", 0.9, box), ("person", 0.8, other))
    camera = OakCamera(SETTINGS, prefix="cam4", connect=lambda settings: stream(pictures, found))
    camera.open()
    got: list[Frame] = []
    for _ in range(8):
        frame = camera.read(0.2)
        if frame is not None:
            got.append(frame)
    _KEPT[-1][0].stop()
    camera.close()
    assert [frame.frame for frame in got] == [0, 2, 4, 6]
    assert [int(frame.image[5, 5, 0]) for frame in got] == [0, 2, 4, 6], "the picture itself"
    middles = [one.getTimestamp(dai.CameraExposureOffset.MIDDLE) for one in pictures if one.getSequenceNum() % 2 == 0]
    assert [frame.device_time_ns for frame in got] == [(m // timedelta(microseconds=1)) * 1000 for m in middles]
    assert [len(frame.detections or ()) for frame in got] == [0, 1, 1, 1]
    assert all(frame.detections is not None for frame in got), "no detections differ from no detector"
    assert len({one.label for frame in got for one in frame.detections or ()}) == 1


def test_an_agent_publishes_the_boards_detections_and_runs_no_detector() -> None:
    class UnusedDetector:
        def detect(self, *_: object) -> list[Any]:
            raise AssertionError("the board has already detected")

    pictures = [picture(number, 100.0 + number / 50.0) for number in range(3)]
    found = [results(number, ("ball", 0.75, (300.0, 150.0, 600.0, 450.0))) for number in range(3)]
    camera = OakCamera(SETTINGS, prefix="cam4", connect=lambda settings: stream(pictures, found))
    hub = MemoryHub()
    subscription = MemoryBus(hub).subscribe(OBSERVATION)
    with running(CameraAgent(camera, UnusedDetector(), MemoryBus(hub), "cam4").run):
        messages: list[Any] = [received.message for received in collect(subscription, 3)]
    _KEPT[-1][0].stop()
    assert [(m.frame, len(m.detections)) for m in messages] == [(0, 1), (1, 1), (2, 1)]
    one = messages[0].detections[0]
    assert (one.label, one.kind, one.score) == ("ball", "marker", pytest.approx(0.75))
    assert (one.u, one.v, one.size) == pytest.approx((149.5, 99.5, 100.0), abs=0.01)


def archive(file: Path, classes: list[str]) -> Path:
    """An archive in depthai's format; its network is a hundred zero bytes."""
    image = {"name": "images", "dtype": "float32", "input_type": "image", "shape": [1, 3, 288, 512], "layout": "NCHW"}
    image["preprocessing"] = {"mean": [0, 0, 0], "scale": [1, 1, 1]}
    head = {"parser": "YOLO", "outputs": ["o"], "metadata": {"classes": classes, "n_classes": len(classes)}}
    head["metadata"] |= {"iou_threshold": 0.5, "conf_threshold": 0.5, "max_det": 300, "subtype": "yolov6"}  # type: ignore[operator]
    model = {"metadata": {"name": "x", "path": "x.dlc", "precision": "float16"}, "inputs": [image], "heads": [head]}
    model["outputs"] = [{"name": "o", "dtype": "float32"}]
    with tarfile.open(file, "w:xz") as tar:
        for name, data in (
            ("config.json", json.dumps({"config_version": "1.0", "model": model}).encode()),
            ("x.dlc", bytes(100)),
        ):
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
    return file


def test_a_bad_archive_is_refused_before_a_board_is_searched_for(tmp_path: Path) -> None:
    good = archive(tmp_path / "good.tar.xz", ["person", "car"])
    assert open_archive(good, ("car",)).getInputSize() == (512, 288)
    with pytest.raises(InputError, match="the network has no class cat; use some of person, car"):
        open_archive(good, ("person", "cat"))
    with pytest.raises(InputError, match="does not exist"):
        open_stream(OakSettings(nn=tmp_path / "gone.tar.xz"))
    (tmp_path / "text.tar.xz").write_text("no archive")
    with pytest.raises(InputError, match="depthai cannot read this NN archive") as error:
        OakCamera(OakSettings(nn=tmp_path / "text.tar.xz")).open()
    assert "\n" not in str(error.value)
