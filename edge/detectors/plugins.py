"""Detectors by name: the shipped ones, those that other packages register, and networks described by a TOML file.

A package registers a detector of its own with an entry point of the group ``syncline.detectors``:

    [project.entry-points."syncline.detectors"]
    hats = "my_package.hats:make_detector"

where ``make_detector(options: DetectorOptions) -> Detector`` (a class with such a constructor serves too).
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Literal, get_args

from edge.detectors.base import Detector
from protocols.core.errors import InputError

GROUP = "syncline.detectors"
Kind = Literal["person", "vehicle"]


@dataclass(frozen=True, slots=True)
class DetectorOptions:
    """What a detector is made for: the images of one camera, passed one after the other.

    kind: report only objects of this kind; None = all that it knows. fps: frame rate [Hz], where images come without
    times. prefix: put before the labels of tracks (p0, t0, …), so that those of two cameras differ. seed: of random
    numbers, where it draws any.
    """

    kind: Kind | None = None
    fps: float = 25.0
    prefix: str = ""
    seed: int = 0


def is_plugin(name: str) -> bool:
    """Whether a detector's name stands for a network's TOML file or for another package's entry point."""
    return is_network_file(name) or any(point.name == name for point in entry_points(group=GROUP))


def is_network_file(name: str | Path) -> bool:
    """Whether a detector's name is the path of a network's description."""
    return Path(name).suffix.lower() == ".toml"


def load_detector(
    name_or_path: str | Path, *, kind: Kind | None = None, fps: float = 25.0, prefix: str = "", seed: int = 0
) -> Detector:
    """Make a detector for the images of one camera; make one for each camera, because detectors keep tracks.

    Parameters
    ----------
    name_or_path
        A path that ends in .toml: an ONNX network (see ``edge.detectors.network.description``). Otherwise ``person`` or
        ``vehicle`` (the shipped detectors of motion), or the name of an entry point of the group ``syncline.detectors``.
    kind, fps, prefix, seed
        See ``DetectorOptions``.

    Returns
    -------
    Detector
        ``detect(image, time_s, predictions)`` gives detections in pixels of the image, best first: kind, u and v, box,
        head and foot (None where the image border cuts them), size (head to foot, 0 = not measured), colour of the
        torso, covariance, score, and a label that holds while the object stays in view. One that is also a
        ``BatchDetector`` takes several images at once.

    Raises
    ------
    InputError
        There is no such detector, or its file or model is not usable: one line with file, reason and remedy.
    """
    options = DetectorOptions(kind, fps, prefix, seed)
    if is_network_file(name_or_path):
        from edge.detectors.network.detector import NetworkDetector

        return NetworkDetector.from_file(Path(name_or_path), options)
    name = str(name_or_path)
    if name in get_args(Kind):
        return _shipped(name, options)
    return _from_entry_point(name, options)


def _shipped(name: str, options: DetectorOptions) -> Detector:
    if options.kind not in (None, name):
        raise InputError(f"the detector {name} detects no {options.kind}s", remedy=f"use the detector {options.kind}")
    if name == "person":
        from edge.detectors.people.person import PersonDetector

        return PersonDetector("mog2", options.fps, prefix=f"{options.prefix}p")
    from edge.detectors.moving.vehicle import VehicleDetector

    return VehicleDetector("mog2", options.fps, prefix=f"{options.prefix}t")


def _from_entry_point(name: str, options: DetectorOptions) -> Detector:
    points = entry_points(group=GROUP)
    named = {point.value: point for point in points if point.name == name}  # a package may be found twice
    if not named:
        known = ", ".join([*get_args(Kind), *sorted({point.name for point in points})])
        raise InputError(f"there is no detector {name!r}", remedy=f"give a network's .toml file, or one of {known}")
    if len(named) > 1:
        raise InputError(
            f"several packages have a detector {name!r}: {', '.join(named)}", remedy="uninstall all but one"
        )
    (point,) = named.values()
    return _load(point, options)


def _load(point: EntryPoint, options: DetectorOptions) -> Detector:
    try:
        factory = point.load()
    except (ImportError, AttributeError) as error:
        what = f"the detector {point.name!r} ({point.value}) cannot be loaded: {error}"
        raise InputError(what, remedy="install its package again, with all that it needs") from None
    detector = factory(options)
    if not callable(getattr(detector, "detect", None)):
        what = f"the detector {point.name!r} ({point.value}) has no method detect(image, time_s, predictions)"
        raise InputError(what, remedy="see edge.detectors.base.Detector")
    made: Detector = detector
    return made
