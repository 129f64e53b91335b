"""Image coverage of the target, and advice where to move it: which camera has seen too little of it, and where.

A pure estimator: observations in, advice out. Two cameras are calibrated well by motion that crosses much of both
images; a target that stays in one corner constrains a pose only as far as that corner does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Literal

import numpy as np

from hub.report.measures import COLUMNS, ROWS, covered_cells
from hub.report.wording import ANY, VERBS, target_of
from protocols.geometry.types import Bools
from protocols.session.observations import Observations
from protocols.session.rig import Rig

if TYPE_CHECKING:
    from google.protobuf.message import Message

MIN_COVERAGE = 0.35
"""Share of the image cells in which the target should have been seen."""
MIN_DETECTIONS = 90
"""Detections below which a camera can hardly be calibrated with another."""
_MAX_ADVICE = 2  # pieces of advice at a time: people do not follow more
_MAX_ADVISED = 64  # cameras that are considered: of a thousand it would take a second

Kind = Literal["silent", "unseen", "few", "narrow"]


@dataclass(frozen=True, slots=True)
class CoverageAdvice:
    """Advice on one camera. coverage: share of its image in which it saw the target, 0..1. regions: parts of the image
    without the target, as words ("left", "top right"). text: the sentence for a person."""

    camera: str
    kind: Kind
    coverage: float
    regions: tuple[str, ...]
    text: str


class CoverageMonitor:
    """Notes detections of the target in the cells of each camera's image."""

    def __init__(self) -> None:
        from protocols.messages import syncline_pb2 as pb  # a session folder needs no messages

        self._observation, self._info = pb.Observation, pb.CameraInfo
        self._sizes: dict[str, tuple[int, int]] = {}
        self._targets: dict[str, str] = {}
        self._cells: dict[str, bytearray] = {}
        """1 of each cell in which the target was seen, row by row."""
        self._frames: dict[str, int] = {}
        self._rows: dict[str, int] = {}

    def handle(self, message: Message) -> None:
        """Add a CameraInfo or an Observation; other messages are ignored."""
        if isinstance(message, self._info):
            self._sizes[message.camera] = (message.width, message.height)
            self._targets[message.camera] = message.target if message.target in VERBS else ANY
            self._cells.setdefault(message.camera, bytearray(ROWS * COLUMNS))
        elif isinstance(message, self._observation):
            name = message.camera
            self._frames[name] = self._frames.get(name, 0) + 1
            size = self._sizes.get(name)
            if size is None or not (found := message.detections):
                return
            self._rows[name] = self._rows.get(name, 0) + 1
            best = max(found, key=attrgetter("score")) if len(found) > 1 else found[0]
            column = min(max(int((best.u + 0.5) * COLUMNS / size[0]), 0), COLUMNS - 1)
            row = min(max(int((best.v + 0.5) * ROWS / size[1]), 0), ROWS - 1)
            self._cells[name][row * COLUMNS + column] = 1

    def reset(self) -> None:
        """Forget what was seen; the cameras stay known."""
        for cells in self._cells.values():
            cells[:] = bytes(len(cells))
        self._frames.clear()
        self._rows.clear()

    def forget(self, camera: str) -> None:
        """Forget a camera, as if it had never been heard of."""
        for of_camera in (self._sizes, self._targets, self._cells, self._frames, self._rows):
            of_camera.pop(camera, None)

    def covered_cells(self, camera: str) -> Bools:
        """(ROWS, COLUMNS): cells of a camera's image in which it saw the target."""
        cells = self._cells.get(camera, bytes(ROWS * COLUMNS))
        return np.frombuffer(bytes(cells), dtype=np.bool_).reshape(ROWS, COLUMNS)

    def coverage(self, camera: str) -> float:
        """Share of a camera's image in which it saw the target, 0..1."""
        return float(self.covered_cells(camera).mean())

    @property
    def target(self) -> str:
        """What the user moves, in one word: what most cameras look for."""
        sought = list(self._targets.values())
        return max(sought, key=sought.count, default=ANY)

    def instruction(self) -> str:
        """What to do with the target: "wave the ball", "walk about"."""
        verb = VERBS.get(self.target, "move it")
        return verb.replace("it", f"the {self.target}") if verb.endswith(" it") else f"{verb} about"

    def advice(self, max_advice: int = _MAX_ADVICE) -> list[CoverageAdvice]:
        """Advice, the most urgent first; empty when every camera has seen enough."""
        cameras = sorted({*self._sizes, *self._frames})[:_MAX_ADVISED]
        frames, rows = self._frames.get, self._rows.get
        found = [
            camera_advice(name, frames(name, 0), rows(name, 0), self.covered_cells(name), self._targets.get(name, ANY))
            for name in cameras
        ]
        return _most_urgent([advice for advice in found if advice is not None], max_advice)


def camera_advice(camera: str, frames: int, rows: int, covered: Bools, target: str = ANY) -> CoverageAdvice | None:
    """Advice on one camera, None if none is needed. frames: received from it; rows: those with a detection.

    target: what the user moves, see `target_of`.
    """
    do = VERBS.get(target, "move it")
    share = float(covered.mean())
    regions = uncovered_regions(covered)
    if frames == 0:
        return CoverageAdvice(camera, "silent", 0.0, (), f"{camera} sends no frames: check that it runs")
    if rows == 0:
        return CoverageAdvice(camera, "unseen", 0.0, (), f"{camera} has not seen the {target} yet: {do} in front of it")
    percent = f"{camera} has seen the {target} in {100 * share:.0f} % of its view"
    if share < MIN_COVERAGE:
        aim = f" at the {' and the '.join(regions[:2])} of its picture" if regions else ""
        return CoverageAdvice(camera, "narrow", share, regions, f"{percent}: {do}{aim}")
    if rows < MIN_DETECTIONS:
        text = f"{camera} has seen the {target} in {rows} frames only: {do} there for longer"
        return CoverageAdvice(camera, "few", share, regions, text)
    return None


def session_advice(
    rig: Rig, observations: Observations, cameras: Mapping[str, str] | None = None
) -> list[CoverageAdvice]:
    """Advice on a recorded session. cameras: only these are considered, e.g. the refused ones; None = all."""
    found = []
    target = target_of(rig, observations.labels)
    for name, camera in rig.cameras.items():
        if cameras is not None and name not in cameras:
            continue
        pixels = [track.pixels for track in observations.of_camera(name)]
        rows = np.concatenate(pixels) if pixels else np.zeros((0, 2))
        covered = covered_cells(rows, camera.size) if len(rows) else np.zeros((ROWS, COLUMNS), dtype=np.bool_)
        advice = camera_advice(name, max(len(rows), 1), len(rows), covered, target)
        if advice is not None:
            found.append(advice)
    return _most_urgent(found, _MAX_ADVICE)


def uncovered_regions(covered: Bools) -> tuple[str, ...]:
    """Sides and corners of the image without the target, the emptiest first.

    covered: (ROWS, COLUMNS). A side is named if at least two thirds of the outer third of the image there are empty,
    not counting cells of a side already named.
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
    named_cells = np.zeros_like(covered)
    uncovered_sides: list[str] = []
    while len(uncovered_sides) < len(sides):
        empty = {
            name: float((~covered[part] & ~named_cells[part]).sum()) / max(float((~named_cells[part]).sum()), 1.0)
            for name, part in sides.items()
            if name not in uncovered_sides
        }
        name = max(empty, key=lambda side: empty[side])
        if empty[name] < 2 / 3:
            break
        uncovered_sides.append(name)
        named_cells[sides[name]] = True
    corners = {
        "top left": np.s_[:upper, :first],
        "top right": np.s_[:upper, last:],
        "bottom left": np.s_[lower:, :first],
        "bottom right": np.s_[lower:, last:],
        "centre": np.s_[upper:lower, first:last],
    }
    uncovered_corners = [name for name, part in corners.items() if not (covered[part] | named_cells[part]).any()]
    return (*uncovered_sides, *uncovered_corners)


def _most_urgent(found: list[CoverageAdvice], max_advice: int) -> list[CoverageAdvice]:
    order: dict[Kind, int] = {"silent": 0, "unseen": 1, "narrow": 2, "few": 3}
    return sorted(found, key=lambda advice: (order[advice.kind], advice.coverage, advice.camera))[:max_advice]
