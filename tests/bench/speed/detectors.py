"""Detectors before one camera: CPU a frame, beside the few lines of OpenCV that one would write, on the same frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from edge import scenes
from edge.detectors.marker.ball import MarkerDetector
from edge.detectors.marker.tag import TagDetector
from protocols.geometry.types import Image
from tests.bench import people_detector
from tests.bench.speed.rows import Limit, Row, Section, interleaved
from tests.support.rendered_markers import add_tag, dim_room, exposed, tag_image

_HD = (1280, 720)
_LOW, _HIGH = (5, 120, 80), (18, 255, 255)  # the ball's orange


def in_range(image: Image) -> tuple[float, float]:
    """The ball by colour and moments."""
    mask = cv2.inRange(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), np.array(_LOW), np.array(_HIGH))
    moments = cv2.moments(mask, True)
    area = max(moments["m00"], 1.0)
    return moments["m10"] / area, moments["m01"] / area


def _aruco(image: Image) -> object:
    return _ARUCO.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


_ARUCO = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))


def _markers(quick: bool, found: Section) -> None:
    renderer = scenes.renderer_for(scenes.get_marker_scene("marker", 16), "cam0", np.random.default_rng(16))
    moments = np.linspace(1.0, 30.0, 20 if quick else 60)
    images = [np.asarray(cv2.resize(renderer.render(moment), _HD), dtype=np.uint8) for moment in moments]
    rng = np.random.default_rng(5016)
    tag, tagged = tag_image(cv2.aruco.DICT_APRILTAG_36h11, 17, 400), []
    for index in range(len(images) // 2):
        scene_image = dim_room(5016 + index, *_HD, 50.0)
        add_tag(scene_image, tag, rng.uniform((120, 120), (1160, 600)), 50.0, rng.uniform(-0.7, 0.7, 3), np.zeros(2))
        tagged.append(exposed(np.asarray(scene_image, dtype=np.float64), 4.0, rng))
    detector, tags = MarkerDetector(), TagDetector()
    methods = {
        "ours": lambda: [detector.detect(image) for image in images],
        "plain": lambda: [in_range(image) for image in images],
        "tag": lambda: [tags.detect(image) for image in tagged],
        "aruco": lambda: [_aruco(image) for image in tagged],
    }
    try:
        from pupil_apriltags import Detector

        april = Detector("tag36h11", nthreads=1, quad_decimate=1.0)
        methods["april"] = lambda: [april.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) for image in tagged]
    except ImportError:
        found.missing.append("marker detector beside AprilTag 3: pupil-apriltags is not installed (extra bench)")
    seconds = interleaved(methods, 2 if quick else 5)
    count = {name: len(images if name in ("ours", "plain") else tagged) for name in methods}
    rate = {name: count[name] / value for name, value in seconds.items()}
    limits = {"must": Limit("ours", 30.0), "reach": Limit("ours", 120.0)}
    work = "marker detector 720p, coloured ball"
    found.rows.append(Row(work, rate["ours"], "fps", "cv2.inRange + moments", rate["plain"], False, **limits))
    work = "marker detector 720p, tag with covariance"
    found.rows.append(Row(work, rate["tag"], "fps", "cv2.aruco, AprilTag 36h11", rate["aruco"], False, **limits))
    if "april" in rate:
        found.rows.append(Row(work, rate["tag"], "fps", "AprilTag 3 (pupil-apriltags)", rate["april"], False))


def _people(quick: bool, found: Section) -> None:
    frames, _, _, fps = people_detector.render_video(716, 5, 12.0 if quick else 20.0)
    _, ours = people_detector.from_file(frames, fps)
    model = cv2.createBackgroundSubtractorMOG2(500, 16.0, True)
    for scene_image in frames[:: max(len(frames) // 48, 1)]:
        model.apply(scene_image, learningRate=0.03)
    seconds = interleaved({"mog2": lambda: [model.apply(scene_image) for scene_image in frames]}, 2)
    alone = 1e3 * seconds["mog2"] / len(frames)
    _, boxes = people_detector.plain(frames, fps)
    work = "person detector 640×480, a frame"
    found.rows += [
        Row(work, ours, "ms", "MOG2 alone", alone, must=Limit("ratio", 1 / 1.5)),
        Row(work, ours, "ms", "MOG2, median and boxes", boxes),
    ]


def measure(quick: bool, data: Path) -> Section:
    """Marker and person detectors, one thread."""
    del data
    cv2.setNumThreads(1)
    found = Section()
    _markers(quick, found)
    _people(quick, found)
    return found
