"""Detectors by name: the shipped ones, those that other packages register, and networks described by a TOML file.

A package registers a detector of its own with an entry point of the group ``syncline.detectors``:

    [project.entry-points."syncline.detectors"]
    hats = "my_package.hats:make_detector"

where ``make_detector(options: DetectorOptions) -> Detector`` (a class with such a constructor serves too).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import get_args

from edge.detectors.base import Detector, DetectorOptions, Kind
from protocols.core.errors import InputError

GROUP = "syncline.detectors"


def is_plugin(name: str) -> bool:
    """Whether a detector's name stands for a network's TOML file or for another package's entry point."""
    return is_network_file(name) or any(point.name == name for point in entry_points(group=GROUP))


def unknown_detector(name: str, known: Sequence[str]) -> InputError:
    """The error for a name that no detector has. known: the names that may stand in its place."""
    remedy = f"use one of {', '.join(known)}, or a network's .toml file"
    if Path(name).suffix.lower() == ".onnx":
        remedy = "give the .toml file that describes the network; see docs/guide/detectors.md"
    return InputError(f"there is no detector {name!r}", remedy=remedy)


def is_network_file(name: str | Path) -> bool:
    """Whether a detector's name is the path of a network's description."""
    return Path(name).suffix.lower() == ".toml"


def detector_revision(name_or_path: str | Path) -> str:
    """A text that changes when a detector may detect something else: a hash of its files, or its package's version.

    Raises InputError where a file of a network cannot be read.
    """
    if is_network_file(name_or_path):
        from edge.detectors.network.description import network_digest

        return network_digest(Path(name_or_path))
    dists = {point.dist for point in entry_points(group=GROUP) if point.name == name_or_path}
    return " ".join([str(name_or_path), *sorted(f"{one.name} {one.version}" for one in dists if one is not None)])


def load_detector(
    name_or_path: str | Path, *, kind: Kind | None = None, fps: float = 25.0, prefix: str = "", seed: int = 0
) -> Detector:
    """Make a detector for the images of one camera; make one for each camera, because detectors keep tracks.

    Parameters
    ----------
    name_or_path
        A path that ends in .toml: an ONNX network (see ``edge.detectors.network.description``). Otherwise ``person`` or
        ``vehicle`` (shipped: what moves before the background), or an entry point of the group ``syncline.detectors``.
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
    options = DetectorOptions(kind, fps if fps > 0.0 and math.isfinite(fps) else 25.0, prefix, seed)
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
        raise unknown_detector(name, [*get_args(Kind), *sorted({point.name for point in points})])
    if len(named) > 1:
        raise InputError(
            f"several packages have a detector {name!r}: {', '.join(named)}", remedy="uninstall all but one"
        )
    (point,) = named.values()
    return _load(point, options)


def _load(point: EntryPoint, options: DetectorOptions) -> Detector:
    try:
        factory: Callable[[DetectorOptions], Detector] = point.load()
    except (ImportError, AttributeError) as error:
        what = f"the detector {point.name!r} ({point.value}) cannot be loaded: {error}"
        raise InputError(what, remedy="install its package again, with all that it needs") from None
    detector = factory(options)
    if not callable(getattr(detector, "detect", None)):
        what = f"the detector {point.name!r} ({point.value}) has no method detect(image, time_s, predictions)"
        raise InputError(what, remedy="see edge.detectors.base.Detector")
    return detector
