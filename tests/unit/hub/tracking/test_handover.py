"""Tracks at the border of two hubs: one of them publishes, without a gap, and under one label."""

from __future__ import annotations

import numpy as np

from hub.tracking.handover import TrackHandover
from protocols.messages import syncline_pb2 as pb

CENTRES = {"left": np.array([0.0, 0.0, 3.0]), "right": np.array([10.0, 0.0, 3.0])}


def track(label: str, x: float, time: float, kind: str = "", state: str = "confirmed") -> pb.Track:
    """A target on its way to the right at 1 m/s."""
    return pb.Track(
        schema_version=1, label=label, kind=kind, state=state, reference_time_ns=round(time * 1e9),
        position=[x, 0.0, 1.0], velocity=[1.0, 0.0, 0.0], position_covariance=(0.01 * np.eye(3)).ravel().tolist(),
    )  # fmt: skip


def two() -> tuple[TrackHandover, TrackHandover]:
    hubs = TrackHandover("a"), TrackHandover("b")
    for hub, own in zip(hubs, ("left", "right"), strict=True):
        hub.place(CENTRES, frozenset([own]))
    return hubs


def walk(label_a: str, label_b: str, kind: str, offset: float = 0.02) -> list[list[pb.Track]]:
    """What both publish of one target that crosses at 5 m, at each 50 ms."""
    a, b = two()
    out = []
    for step in range(200):
        time = 0.05 * step
        mine = a.own(track(label_a, time, time, kind), time)
        theirs = b.own(track(label_b, time + offset, time, kind), time)
        if mine is not None:
            b.hear(mine, time)
        if theirs is not None:
            a.hear(theirs, time)
        out.append([one for one in (mine, theirs) if one is not None])
    return out


def test_a_marker_is_published_by_one_hub_at_a_time_and_never_by_none() -> None:
    published = walk("ball", "ball", "")
    assert all(published), "no gap"
    assert sum(len(one) == 2 for one in published) <= 3, "twice for as long as a message takes"


def test_a_person_keeps_the_label_of_the_hub_that_met_it_first() -> None:
    published = walk("person-3", "person-8", "person")
    assert all(published)
    assert {one.label for each in published for one in each} == {"a-person-3"}


def test_another_person_has_another_label() -> None:
    published = walk("person-3", "person-8", "person", offset=2.0)
    assert {one.label for each in published for one in each} == {"a-person-3", "b-person-8"}


def test_a_track_that_ends_here_goes_on_there_and_the_end_is_published_once() -> None:
    a, b = two()
    assert b.own(track("ball", 6.0, 0.0), 0.0) is not None
    a.hear(track("ball", 6.0, 0.0), 0.0)
    assert a.own(track("ball", 4.9, 0.1, state="lost"), 0.1) is None, "b has it"
    assert a.own(track("ball", 4.9, 2.0, state="lost"), 2.0) is not None, "b has been silent for long"


def test_without_a_calibration_of_the_site_a_hub_publishes_what_it_has() -> None:
    assert TrackHandover("a").own(track("ball", 99.0, 0.0), 0.0) is not None
