"""Spoilt boxes of the crowd's bench: as many misses and false boxes as stated, the same for the same seed."""

from __future__ import annotations

from pathlib import Path

from tests.bench.crowd import spoilt_boxes
from tests.support.crowds import NAMES, boxes_csv, write_calibration


def test_boxes_are_spoilt_as_stated(tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.csv"
    boxes.write_text(boxes_csv(60.0, 5.0), encoding="utf-8")
    calibration = write_calibration(tmp_path / "calibration.toml")
    views, real = 300 * len(NAMES), 900 * len(NAMES)
    for spoil in (1.0, 2.0):
        text = spoilt_boxes(boxes, calibration, spoil, 3)
        count = len(text.splitlines()) - 1
        expected = real * (1.0 - 0.1 * spoil) + 0.5 * spoil * views
        assert abs(count - expected) < 4.0 * (real * 0.1 * spoil + views * 0.5 * spoil) ** 0.5
        assert text == spoilt_boxes(boxes, calibration, spoil, 3)
        assert text != spoilt_boxes(boxes, calibration, spoil, 4)
    tall = [float(line.split(",")[6]) for line in boxes.read_text(encoding="utf-8").splitlines()[1:]]
    kept = [float(line.split(",")[6]) for line in spoilt_boxes(boxes, calibration, 0.0, 3).splitlines()[1:]]
    assert len(kept) == len(tall)
    assert max(abs(a - b) for a, b in zip(tall, kept, strict=True)) < 1e-3
