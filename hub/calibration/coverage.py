"""Where to wave the marker: which camera has seen too little of it, and in which part of its picture.

A pure estimator: observations in, advice out. Two cameras are tied together by motion that crosses much of both
pictures; a marker that stays in one corner tells of a pose only what that corner can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from google.protobuf.message import Message

from hub.report.measures import COLUMNS, ROWS, covered_parts
from protocols.geometry.types import Bools
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import Observations
from protocols.session.rig import Rig

ENOUGH = 0.35
"""Share of a picture's parts that the marker should have passed through."""
LEAST_ROWS = 90
"""Detections below which a camera can hardly be tied to another."""
_MOST = 2  # pieces of advice at a time: more is not followed

Kind = Literal["silent", "unseen", "few", "narrow"]


@dataclass(frozen=True, slots=True)
class Advice:
    """What one camera lacks. coverage: share of its picture in which it saw the marker, 0..1. where: parts of the
    picture that lack it, as words ("left", "top right"). text: the sentence for a person."""

    camera: str
    kind: Kind
    coverage: float
    where: tuple[str, ...]
    text: str


class Guidance:
    """Counts in which parts of each camera's picture the marker was seen."""

    def __init__(self) -> None:
        self._sizes: dict[str, tuple[int, int]] = {}
        self._counts: dict[str, np.ndarray[tuple[int, int], np.dtype[np.int64]]] = {}
        self._frames: dict[str, int] = {}
        self._rows: dict[str, int] = {}

    def handle(self, message: Message) -> None:
        """Take a CameraInfo or an Observation; others are ignored."""
        if isinstance(message, pb.CameraInfo):
            self._sizes[message.camera] = (message.width, message.height)
            self._counts.setdefault(message.camera, np.zeros((ROWS, COLUMNS), dtype=np.int64))
        elif isinstance(message, pb.Observation):
            name = message.camera
            self._frames[name] = self._frames.get(name, 0) + 1
            size = self._sizes.get(name)
            if not message.detections or size is None:
                return
            self._rows[name] = self._rows.get(name, 0) + 1
            best = max(message.detections, key=lambda one: one.score)
            column = min(max(int((best.u + 0.5) * COLUMNS / size[0]), 0), COLUMNS - 1)
            row = min(max(int((best.v + 0.5) * ROWS / size[1]), 0), ROWS - 1)
            self._counts[name][row, column] += 1

    def start_anew(self) -> None:
        """Forget what was seen; the cameras stay known."""
        for counts in self._counts.values():
            counts[:] = 0
        self._frames.clear()
        self._rows.clear()

    def covered(self, camera: str) -> Bools:
        """(ROWS, COLUMNS): the parts of a camera's picture where it saw the marker."""
        counts = self._counts.get(camera)
        return np.zeros((ROWS, COLUMNS), dtype=np.bool_) if counts is None else np.asarray(counts > 0)

    def coverage(self, camera: str) -> float:
        """Share of a camera's picture in which it saw the marker, 0..1."""
        return float(self.covered(camera).mean())

    def advice(self, most: int = _MOST) -> list[Advice]:
        """What is missing, the worst first; empty when every camera has seen enough."""
        cameras = sorted({*self._sizes, *self._frames})
        found = [
            lacking(name, self._frames.get(name, 0), self._rows.get(name, 0), self.covered(name)) for name in cameras
        ]
        return _worst([advice for advice in found if advice is not None], most)


def lacking(camera: str, frames: int, rows: int, covered: Bools) -> Advice | None:
    """What one camera lacks, None if nothing. frames: it sent; rows: those in which the marker was seen."""
    share = float(covered.mean())
    where = parts_without(covered)
    if frames == 0:
        return Advice(camera, "silent", 0.0, (), f"{camera} sends no frames: check that it runs")
    if rows == 0:
        return Advice(camera, "unseen", 0.0, (), f"{camera} has not seen the marker yet: wave it in front of it")
    percent = f"{camera} has seen the marker in {100 * share:.0f} % of its view"
    if share < ENOUGH:
        aim = f" at the {_listed(where[:2])} of its picture" if where else ""
        return Advice(camera, "narrow", share, where, f"{percent}: wave it{aim}")
    if rows < LEAST_ROWS:
        text = f"{camera} has seen the marker in {rows} frames only: wave it there for longer"
        return Advice(camera, "few", share, where, text)
    return None


def advice_for(rig: Rig, observations: Observations, cameras: Mapping[str, str] | None = None) -> list[Advice]:
    """The same of a recorded session. cameras: only these are looked at, e.g. the refused ones; None = all."""
    found = []
    for name, camera in rig.cameras.items():
        if cameras is not None and name not in cameras:
            continue
        pixels = [track.pixels for track in observations.of_camera(name)]
        rows = np.concatenate(pixels) if pixels else np.zeros((0, 2))
        covered = covered_parts(rows, camera.size) if len(rows) else np.zeros((ROWS, COLUMNS), dtype=np.bool_)
        advice = lacking(name, max(len(rows), 1), len(rows), covered)
        if advice is not None:
            found.append(advice)
    return _worst(found, _MOST)


def parts_without(covered: Bools) -> tuple[str, ...]:
    """Sides and corners of a picture that lack the marker, the emptiest first.

    covered: (ROWS, COLUMNS). A side is named where two thirds of its third are empty, not counting what another side
    has named already.
    """
    rows, columns = covered.shape
    upper, lower = max(1, rows // 3), rows - max(1, rows // 3)
    first, last = max(1, columns // 3), columns - max(1, columns // 3)
    sides = {
        "left": np.s_[:, :first],
        "right": np.s_[:, last:],
        "top": np.s_[:upper, :],
        "bottom": np.s_[lower:, :],
    }
    told = np.zeros_like(covered)
    named: list[str] = []
    while len(named) < len(sides):
        empty = {
            name: float((~covered[part] & ~told[part]).sum()) / max(float((~told[part]).sum()), 1.0)
            for name, part in sides.items()
            if name not in named
        }
        name = max(empty, key=lambda side: empty[side])
        if empty[name] < 2 / 3:
            break
        named.append(name)
        told[sides[name]] = True
    corners = {
        "top left": np.s_[:upper, :first],
        "top right": np.s_[:upper, last:],
        "bottom left": np.s_[lower:, :first],
        "bottom right": np.s_[lower:, last:],
        "centre": np.s_[upper:lower, first:last],
    }
    missed = [name for name, part in corners.items() if not (covered[part] | told[part]).any()]
    return (*named, *missed)


def _worst(found: list[Advice], most: int) -> list[Advice]:
    order: dict[Kind, int] = {"silent": 0, "unseen": 1, "narrow": 2, "few": 3}
    return sorted(found, key=lambda advice: (order[advice.kind], advice.coverage, advice.camera))[:most]


def _listed(words: tuple[str, ...]) -> str:
    return " and the ".join(words)
