"""People and vehicles in a whole video: the place is learnt first, then every frame is looked at."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from deploy.offline.detect import Found, detect_in
from edge.detectors.moving.foreground import ModelName
from edge.detectors.moving.vehicle import VehicleDetector
from edge.detectors.people.person import PersonDetector
from edge.devices.playback.video_reader import Film

if TYPE_CHECKING:
    from edge.detectors.base import Detection
    from edge.devices.base import Image

Moving = PersonDetector | VehicleDetector
HEADER_EXTRA = "head_u,head_v,foot_u,foot_v,box_x,box_y,box_w,box_h"
_PRIME_S, _PRIME_PICTURES = 60.0, 48
_WARM_FRAMES = 400
_FEWEST_FRAMES = 5


def make_detector(what: str, model: ModelName, fps: float) -> Moving:
    """A detector that also tells of what it is not yet sure of: for a recording that is decided at the end."""
    if what == "person":
        return PersonDetector(model, fps, sure_only=False)
    return VehicleDetector(model, fps, sure_only=False)


def find_moving(
    film: Film,
    camera: str,
    detector: Moving,
    tell: Callable[[str, float], None] = lambda text, share: None,
    overlay: Path | None = None,
) -> Found:
    """Look through a film twice: its first minute to learn the place, and all of it. tell: what is done, and how far.

    Labels are those of the video: p0, p1, … of people (``person`` where there is never more than one at a time),
    t0, t1, … of vehicles. overlay: a video to draw what was found into. Raises InputError.
    """
    total = max(film.info.frames, 1)
    _learn(film, detector, tell)
    rows: dict[int, list[tuple[str, Detection]]] = {}

    def told(frame: int) -> None:
        tell(f"frame {frame} of {total}", frame / total)

    found = detect_in(film, camera, detector, told, seen=rows)
    names = _names(rows, detector)
    if overlay is not None:
        from deploy.offline.detect_overlay import draw_overlay

        sure = {
            frame: [(names[one.label], one) for _, one in shown if one.label in names] for frame, shown in rows.items()
        }
        draw_overlay(film, overlay, sure)
    lines = []
    seen = 0
    for shown in rows.values():
        kept = [(row, one) for row, one in shown if one.label in names]
        seen += bool(kept)
        lines += [f"{row.format(label=names[one.label])},{_extra(one)}" for row, one in kept]
    return Found(tuple(lines), found.frames, seen, found.corrupt, found.repaired, found.size, found.fps, found.span)


def _learn(film: Film, detector: Moving, tell: Callable[[str, float], None]) -> None:
    """The background from pictures of the first minute, and how tall people are from its frames in order."""
    fps = film.info.fps
    span = min(film.info.frames or 10**9, round(_PRIME_S * fps))
    every = max(span // _PRIME_PICTURES, 1)
    pictures: list[Image] = []
    tell("learning the background", 0.0)
    for shot in film:
        if shot.frame >= span or len(pictures) > 2 * _PRIME_PICTURES:
            break
        if shot.frame % every == 0:
            pictures.append(shot.image())
    if len(pictures) > 4:
        detector.prime(pictures)
    del pictures
    for shot in film:
        if shot.frame >= min(_WARM_FRAMES, span):
            break
        detector.detect(shot.image(), shot.time)
    detector.rewind()


def _names(rows: dict[int, list[tuple[str, Detection]]], detector: Moving) -> dict[str, str]:
    """Labels of those who turned out to be real, numbered as they appear."""
    order: dict[str, str] = {}
    at_once = 0
    still = _staying(rows) if isinstance(detector, VehicleDetector) else set()
    for shown in rows.values():
        sure = [one for _, one in shown if detector.is_sure(one.label) and one.label not in still]
        at_once = max(at_once, len(sure))
        for one in sorted(sure, key=lambda each: int(each.label[1:])):
            order.setdefault(one.label, f"{one.label[0]}{len(order)}")
    if isinstance(detector, PersonDetector) and at_once == 1:
        return dict.fromkeys(order, "person")
    return order


def _staying(rows: dict[int, list[tuple[str, Detection]]]) -> set[str]:
    """Labels of what was seen in few frames or never got farther than its own length: paint, shadows, swaying trees."""
    seen: dict[str, list[Detection]] = {}
    for shown in rows.values():
        for _, one in shown:
            seen.setdefault(one.label, []).append(one)
    staying = set()
    for label, ones in seen.items():
        # A box that grows at its birth moves its centre: the longest side of its life is what must be passed.
        length = max(max(one.box[2:]) if one.box else one.size for one in ones)
        away = max(math.hypot(one.u - ones[0].u, one.v - ones[0].v) for one in ones)
        if len(ones) < _FEWEST_FRAMES or away < length:
            staying.add(label)
    return staying


def _extra(one: Detection) -> str:
    cells: list[float | None] = []
    for part, length in ((one.head, 2), (one.foot, 2), (one.box, 4)):
        cells += [None] * length if part is None else list(part)
    return ",".join("" if cell is None else f"{cell:.17g}" for cell in cells)
