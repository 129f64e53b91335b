"""Tracklets of people and their clusters by colour."""

from __future__ import annotations

import numpy as np
import pytest

from hub.tracking.calibration.people import END_STD, PeopleTracklets
from protocols.messages import syncline_pb2 as pb

GREEN = pb.Colour(red=60, green=140, blue=80)


def frame(camera: str, number: int, *places: float) -> pb.Observation:
    """People of one colour, 200 px tall, at these columns."""
    message = pb.Observation(camera=camera, boot_id="boot0", frame=number, device_time_ns=number * 100_000_000)
    for u in places:
        message.detections.add(
            u=u, v=300.0, size=200.0, kind="person", head=[u, 200.0], foot=[u, 400.0], colour=GREEN
        )  # fmt: skip
    return message


def of_frames(second: list[tuple[float, ...]]) -> PeopleTracklets:
    """One camera that sees somebody at 100 px in every frame, and one that sees ``second``."""
    tracklets = PeopleTracklets()
    for number, places in enumerate(second):
        tracklets.handle(frame("cam0", number, 100.0))
        tracklets.handle(frame("cam1", number, *places))
    return tracklets


def test_a_detection_that_jumps_to_and_fro_is_one_person() -> None:
    # Every third frame the box is joined with a shadow: two tracklets, by turns.
    found = of_frames([(700.0,) if number % 3 == 2 else (100.0,) for number in range(150)]).observations()
    assert set(found.labels) == {"walker1-head", "walker1-foot"}
    assert set(found.cameras) == {"cam0", "cam1"}


def test_two_of_one_colour_in_one_frame_are_ambiguous() -> None:
    assert not len(of_frames([(100.0, 700.0)] * 150).observations())


def test_heads_and_feet_have_the_stds_of_such_ends() -> None:
    found = of_frames([(100.0,)] * 150).observations()
    for (_, label), track in found.tracks.items():
        assert track.std is not None
        assert track.std == pytest.approx(np.full(len(track), 200.0 * END_STD[label.rpartition("-")[2]]))
