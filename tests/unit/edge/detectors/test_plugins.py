"""Detectors that other packages register by entry points, as an installed package does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from edge.detectors.people.person import PersonDetector
from edge.detectors.plugins import detector_revision, is_plugin, load_detector
from protocols.core.errors import InputError
from tests.support.videos import write_video

MODULE = '''
from edge.detectors.base import Detection, Detector, DetectorOptions

class Brightest:
    """Detects the brightest pixel."""

    def __init__(self, options: DetectorOptions) -> None:
        self.options = options

    def detect(self, image, time_s=None, predictions=()):
        v, u = divmod(int(image[:, :, 1].argmax()), image.shape[1])
        return [Detection(float(u), float(v), label=f"{self.options.prefix}p0", kind=self.options.kind or "person")]

def nothing(options):
    return None
'''


def install(folder: Path, package: str, entries: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a package with a module and its metadata, as pip does."""
    (folder / f"{package}.py").write_text(MODULE)
    info = folder / f"{package}-2.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 2.5\n")
    (info / "entry_points.txt").write_text(f"[syncline.detectors]\n{entries}\n")
    monkeypatch.syspath_prepend(str(folder))


def test_a_registered_detector_is_made_with_the_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_plugin("brightest")
    install(tmp_path, "syncline_bright", "brightest = syncline_bright:Brightest", monkeypatch)
    assert is_plugin("brightest")
    detector = load_detector("brightest", kind="vehicle", prefix="cam1-", seed=4)
    image = np.zeros((30, 40, 3), np.uint8)
    image[12, 7] = 255
    (found,) = detector.detect(image)
    assert (found.u, found.v, found.kind, found.label) == (7.0, 12.0, "vehicle", "cam1-p0")
    assert detector_revision("brightest") == "brightest syncline_bright 2.5"


def test_the_command_uses_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "syncline_bright", "brightest = syncline_bright:Brightest", monkeypatch)
    video, out = tmp_path / "a.mp4", tmp_path / "a.csv"
    write_video(video, [np.zeros((48, 64, 3), np.uint8)] * 3, [0.0, 0.1, 0.2])
    assert run(["detect", "vehicle", str(video), "--detector", "brightest", "--out", str(out)]) == 0
    header, *rows = (line.split(",") for line in out.read_text().splitlines())
    assert [(row[header.index("label")], row[header.index("kind")]) for row in rows] == [("vehicle", "vehicle")] * 3
    assert run(["detect", "marker", str(video), "--detector", "brightest", "--out", str(out)]) == 2


def test_shipped_names_are_the_shipped_detectors() -> None:
    assert isinstance(load_detector("person"), PersonDetector)
    with pytest.raises(InputError, match="the detector person detects no vehicles"):
        load_detector("person", kind="vehicle")


def test_what_cannot_be_made_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = "none = syncline_bad:nothing\ngone = syncline_bad:missing\nlost = no_such_module:x\ntwin = syncline_bad:A"
    install(tmp_path, "syncline_bad", entries, monkeypatch)
    (tmp_path / "more").mkdir()
    install(tmp_path / "more", "syncline_more", "twin = syncline_more:Brightest", monkeypatch)
    for name, message in (
        ("none", r"'none' \(syncline_bad:nothing\) has no method detect"),
        ("gone", "cannot be loaded: .*missing"),
        ("lost", "cannot be loaded: No module named 'no_such_module'"),
        ("twin", "several packages have a detector 'twin'"),
        ("other", "there is no detector 'other'; .*person, vehicle, gone, lost, none, twin"),
    ):
        with pytest.raises(InputError, match=message):
            load_detector(name)
