"""Image coverage of the target and the advice derived from it."""

from __future__ import annotations

import numpy as np
import pytest

from hub.calibration.coverage import (
    MIN_COVERAGE,
    MIN_DETECTIONS,
    CoverageMonitor,
    camera_advice,
    session_advice,
    uncovered_regions,
)
from hub.report import build_report
from hub.report.measures import COLUMNS, ROWS
from protocols.core.errors import Refused
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera
from tests.support.samples import camera_info, observation


def seen(camera: str, u: float, v: float, sequence: int = 0) -> pb.Observation:
    message = observation(camera, sequence)
    message.detections[0].u, message.detections[0].v = u, v
    return message


def whole() -> np.ndarray:
    return np.ones((ROWS, COLUMNS), dtype=bool)


def test_a_marker_that_stays_at_the_left_gives_advice_for_the_right() -> None:
    guidance = CoverageMonitor()
    guidance.handle(camera_info("cam0"))
    for index in range(200):
        guidance.handle(seen("cam0", 20.0 + index % 60, 480 * (index / 200), index))
    (advice,) = guidance.advice()
    assert advice.kind == "narrow"
    assert advice.regions[0] == "right"
    assert f"{100 * guidance.coverage('cam0'):.0f} % of its view" in advice.text
    assert "right" in advice.text


def test_pixels_at_and_outside_the_corners_count_for_corner_cells() -> None:
    guidance = CoverageMonitor()
    guidance.handle(camera_info("cam0"))
    for u, v in ((-0.5, -0.5), (639.5, -0.5), (-0.5, 479.5), (639.5, 479.5), (5000.0, -90.0)):
        guidance.handle(seen("cam0", u, v))
    covered = guidance.covered_cells("cam0")
    assert covered[0, 0]
    assert covered[0, -1]
    assert covered[-1, 0]
    assert covered[-1, -1]
    assert covered.sum() == 4


def test_advice_is_ordered_by_urgency_and_limited_to_two() -> None:
    guidance = CoverageMonitor()
    for name in ("cam0", "cam1", "cam2", "cam3"):
        guidance.handle(camera_info(name))
    for index in range(200):
        guidance.handle(seen("cam0", 100.0, 100.0, index))
        guidance.handle(pb.Observation(schema_version=1, camera="cam1", boot_id="b", sequence=index))
    kinds = [(advice.camera, advice.kind) for advice in guidance.advice(9)]
    assert kinds == [("cam2", "silent"), ("cam3", "silent"), ("cam1", "unseen"), ("cam0", "narrow")]
    assert len(guidance.advice()) == 2


def test_full_coverage_needs_no_advice() -> None:
    assert camera_advice("cam0", 500, 500, whole()) is None
    few = camera_advice("cam0", 500, MIN_DETECTIONS - 1, whole())
    assert few is not None
    assert few.kind == "few"
    half = whole()
    half[:, round(COLUMNS * MIN_COVERAGE) - 1 :] = False
    narrow = camera_advice("cam0", 500, 500, half)
    assert narrow is not None
    assert narrow.regions[0] == "right"


@pytest.mark.parametrize(
    ("rows", "columns", "regions"),
    [
        (slice(None), slice(0, 4), ("right",)),
        (slice(0, 2), slice(None), ("bottom",)),
        (slice(2, None), slice(None), ("top",)),
        (slice(2, None), slice(3, None), ("left", "top")),
    ],
)
def test_uncovered_sides_are_named(rows: slice, columns: slice, regions: tuple[str, ...]) -> None:
    covered = np.zeros((ROWS, COLUMNS), dtype=bool)
    covered[rows, columns] = True
    assert uncovered_regions(covered) == regions


@pytest.mark.parametrize(
    ("target", "instruction", "unseen"),
    [
        ("ball", "wave the ball", "cam0 has not seen the ball yet: wave it in front of it"),
        ("light", "move the light", "cam0 has not seen the light yet: move it in front of it"),
        ("tag", "show the tag", "cam0 has not seen the tag yet: show it in front of it"),
        ("person", "walk about", "cam0 has not seen the person yet: walk in front of it"),
        ("vehicle", "drive about", "cam0 has not seen the vehicle yet: drive in front of it"),
        ("", "move the target", "cam0 has not seen the target yet: move it in front of it"),
    ],
)
def test_live_advice_names_what_the_cameras_look_for(target: str, instruction: str, unseen: str) -> None:
    guidance = CoverageMonitor()
    info = camera_info("cam0")
    info.target = target
    guidance.handle(info)
    guidance.handle(pb.Observation(schema_version=1, camera="cam0", boot_id="b", sequence=0))
    assert guidance.instruction() == instruction
    assert [advice.text for advice in guidance.advice()] == [unseen]


@pytest.mark.parametrize(
    ("target", "word"), [("board", "board"), ("light", "light"), ("person", "person"), ("ball", "ball"), ("", "point")]
)
def test_reports_speak_of_what_the_user_moves(target: str, word: str) -> None:
    cameras = {name: RigCamera(name, (640, 480), 30.0) for name in ("cam0", "cam1")}
    rig = Rig(cameras, metadata={"target": target} if target else {})
    reason = "the point hardly moves while both could have seen it"
    page = build_report(Refused("no pair could be synchronised", {"cam0": reason}), rig, Observations({}))
    assert f"ove the {word}: record longer while the {word} moves fast" in page
    assert ("the point" in page) == (word == "point")


def test_a_reset_clears_the_counts_but_not_the_cameras() -> None:
    guidance = CoverageMonitor()
    guidance.handle(camera_info("cam0"))
    guidance.handle(seen("cam0", 10.0, 10.0))
    guidance.reset()
    assert guidance.coverage("cam0") == 0.0
    assert [advice.kind for advice in guidance.advice()] == ["silent"]


def test_a_recorded_session_gives_the_same_advice() -> None:
    rig = Rig({name: RigCamera(name, (640, 480), 30.0) for name in ("cam0", "cam1")})
    time = np.arange(200) / 30
    pixels = np.column_stack([np.full(200, 40.0), np.linspace(0, 479, 200)])
    tracks = gather_tracks(
        ["cam0"] * 200, ["marker"] * 200, np.arange(200), time, pixels, np.full(200, np.nan), order=["cam0", "cam1"]
    )
    unseen, narrow = session_advice(rig, tracks)
    assert (unseen.camera, unseen.kind) == ("cam1", "unseen")
    assert (narrow.camera, narrow.regions[0]) == ("cam0", "right")
    assert [advice.camera for advice in session_advice(rig, tracks, {"cam0": "refused"})] == ["cam0"]
