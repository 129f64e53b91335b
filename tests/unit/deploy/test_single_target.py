"""What a detector finds beside the only target of a video is removed; several targets are named as such."""

from __future__ import annotations

import csv

from deploy.offline.single_target import rows_of_head_and_foot, rows_of_one_target
from edge.detectors.base import Detection
from edge.offline.detections import HEADER, detection_rows


def _rows(*labels: tuple[str, range], kind: str = "person") -> tuple[str, ...]:
    """Rows of labels in ranges of frames."""
    at: dict[int, list[Detection]] = {}
    for label, frames in labels:
        for frame in frames:
            at.setdefault(frame, []).append(Detection(10.0, 20.0, 30.0, 0.9, label, kind=kind))
    return tuple(detection_rows("cam", {frame: (frame / 10, seen) for frame, seen in sorted(at.items())}))


def _labels(rows: tuple[str, ...]) -> list[tuple[int, str]]:
    frame, label = (HEADER.split(",").index(name) for name in ("frame", "label"))
    return [(int(row[frame]), row[label]) for row in csv.reader(rows)]


def test_a_few_false_detections_do_not_cost_the_camera() -> None:
    rows, removed, targets = rows_of_one_target(_rows(("p0", range(100)), ("p1", range(40, 44)), ("p2", range(70, 71))))
    assert (removed, targets) == (5, 1)
    assert _labels(rows) == [(frame, "person") for frame in range(100)]


def test_a_track_that_was_lost_in_between_is_one_target() -> None:
    rows, removed, targets = rows_of_one_target(
        _rows(("p0", range(50)), ("p1", range(20, 22)), ("p2", range(52, 53)), ("p3", range(60, 100)))
    )
    assert (removed, targets) == (3, 1)
    assert _labels(rows) == [(frame, "person") for frame in (*range(50), *range(60, 100))]


def test_a_track_that_goes_on_for_some_frames_beside_its_successor_is_one_target() -> None:
    rows, removed, targets = rows_of_one_target(_rows(("p0", range(100, 200)), ("p1", range(108))))
    assert (removed, targets) == (8, 1)
    assert _labels(rows) == [(frame, "person") for frame in range(200)]
    assert rows_of_one_target(_rows(("p0", range(100, 200)), ("p1", range(130)))) == ((), 0, 2)


def test_who_is_elsewhere_beside_the_target_is_another_one() -> None:
    here, there = (Detection(u, 20.0, 30.0, 0.9, label, kind="person") for u, label in ((10.0, "a"), (500.0, "b")))
    seen = {n: (n / 10, [*[here] * (n < 100), *[there] * (n >= 97)]) for n in range(107)}
    rows, removed, targets = rows_of_one_target(tuple(detection_rows("cam", seen)))
    assert (removed, targets) == (10, 1)
    assert _labels(rows) == [(frame, "person") for frame in range(100)]


def test_more_than_a_tenth_beside_it_is_a_second_target() -> None:
    assert rows_of_one_target(_rows(("p0", range(100)), ("p1", range(20, 31)))) == ((), 0, 2)
    assert rows_of_one_target(_rows(("p0", range(100)), ("p1", range(20, 30))))[1:] == (10, 1)
    assert rows_of_one_target(_rows(("p0", range(9)), ("p1", range(9)), ("p2", range(9))))[2] == 3


def test_one_label_and_none_stay_as_they_are() -> None:
    one = _rows(("tag-3", range(5)), kind="corner")
    assert rows_of_one_target(one) == (one, 0, 1)
    assert rows_of_one_target(()) == ((), 0, 0)


def test_a_person_is_the_points_of_head_and_foot() -> None:
    """The representative point wanders by a tenth of the height: no pair of cameras was synchronised by it."""
    seen = [
        Detection(10.0, 20.0, 100.0, 0.9, "p0", kind="person", head=(11.0, 2.0), foot=(12.0, 102.0)),
        Detection(10.0, 20.0, 100.0, 0.9, "p0", kind="person", head=(13.0, 2.0)),
    ]
    rows = rows_of_head_and_foot(detection_rows("cam", {n: (n / 10, [one]) for n, one in enumerate(seen)}))
    table = list(csv.DictReader([HEADER, *rows]))
    ends = [(row["frame"], row["label"], float(row["u"]), float(row["v"])) for row in table]
    assert ends == [
        ("0", "person-head", 11.0, 2.0),
        ("0", "person-foot", 12.0, 102.0),
        ("1", "person-head", 13.0, 2.0),
    ]
    assert float(table[0]["cov_vv"]) < 0.1 * float(table[1]["cov_vv"])
    assert not any(row["kind"] or row["head_u"] or row["box_x"] for row in table)
