"""Short-term tracking of detections in the image: prediction of boxes, association, track initiation and deletion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from edge.detectors.base import Detection, Prediction
from protocols.geometry.types import Floats

_GATE = 13.8  # chi2 of 2 degrees of freedom, 0.999
_COLOUR_STD = 60.0  # std of colours [8-bit steps]
_LOG_SIZE_STD = 0.2  # std of the logarithm of the size
Box = tuple[float, float, float, float]
_CONFIRM_HITS = 3  # detections after which a tracklet is confirmed
_COAST_S = 1.2  # for which a confirmed one goes on unseen
_MIN_DIRECTNESS = 0.35  # displacement over the path length
_TENTATIVE_COAST_S = 0.25  # the same before it is confirmed: a flicker ends
# largest number of height samples that count; weight of the prior in samples
_MAX_HEIGHT_SAMPLES, _PRIOR_HEIGHT_SAMPLES = 20, 2.0


@dataclass(slots=True)
class ImageTracklet:
    """One tracked object in the image.

    box: x, y, w, h [px]. velocity: of its foot point [px/s]. min_displacement: over its shorter side, before it counts
    as moving. ghost: whether it seems to be the former place of an object that has left. relative_height: its height
    over that of the height model. path_length: [px].
    """

    name: str
    box: Box
    time: float
    velocity: Floats = field(default_factory=lambda: np.zeros(2))
    hits: int = 1
    born: float = 0.0
    birthplace: tuple[float, float] = (0.0, 0.0)
    min_displacement: float = 0.35
    moved: bool = False
    ghost: bool = False
    path_length: float = 0.0
    colour: Floats | None = None
    height_samples: int = 0
    relative_height: float = 1.0

    @property
    def confirmed(self) -> bool:
        """Whether it has been detected often enough."""
        return self.hits >= _CONFIRM_HITS

    def update_height(self, relative_height: float) -> None:
        """Add a measurement of its height over that of the height model."""
        self.height_samples += 1
        weight = 1.0 / (min(self.height_samples, _MAX_HEIGHT_SAMPLES) + _PRIOR_HEIGHT_SAMPLES)
        self.relative_height *= float(np.clip(relative_height / self.relative_height, 0.7, 1.4)) ** weight

    def predicted_box(self, time: float) -> Box:
        """Its predicted box [px] at a time [s], by constant velocity."""
        x, y, w, h = self.box
        ahead = min(max(time - self.time, 0.0), 1.0)
        return x + ahead * float(self.velocity[0]), y + ahead * float(self.velocity[1]), w, h

    def update(self, box: Box, time: float, colour: Floats | None, gain: float = 0.6) -> None:
        """Update with a detection. gain: 0..1, weight of the box against the prediction."""
        expected = self.predicted_box(time)
        before = self.box[0] + 0.5 * self.box[2], self.box[1] + 0.5 * self.box[3]
        span = max(time - self.time, 1e-3)
        foot = np.array([box[0] + 0.5 * box[2], box[1] + box[3]])
        predicted_foot = np.array([expected[0] + 0.5 * expected[2], expected[1] + expected[3]])
        weight = 0.5 if self.hits < 3 else 0.25
        limit = 3.0 * box[3]  # limit of the speed: three heights per second
        self.velocity = np.clip(
            self.velocity + weight * gain * (foot - predicted_foot) / max(span, 0.08), -limit, limit
        )
        self.box = tuple(float(a + gain * (b - a)) for a, b in zip(expected, box, strict=True))  # type: ignore[assignment]
        self.time = time
        self.hits += 1
        if colour is not None:
            self.colour = colour if self.colour is None else 0.9 * self.colour + 0.1 * colour
        self.path_length += float(
            np.hypot(self.box[0] + 0.5 * self.box[2] - before[0], self.box[1] + 0.5 * self.box[3] - before[1])
        )
        middle = self.box[0] + 0.5 * self.box[2], self.box[1] + 0.5 * self.box[3]
        displacement = float(np.hypot(middle[0] - self.birthplace[0], middle[1] - self.birthplace[1]))
        # A swaying branch has a long path and a small displacement.
        if (
            displacement > self.min_displacement * min(self.box[2:]) + 1.0
            and displacement > _MIN_DIRECTNESS * self.path_length
        ):
            self.moved = True


class ShortTermTracker:
    """All tracklets of one camera. prefix: of their names, p0, p1, …; min_displacement: see ``ImageTracklet``."""

    def __init__(self, prefix: str, min_displacement: float) -> None:
        self._prefix = prefix
        self._min_displacement = min_displacement
        self._next = 0
        self.tracklets: list[ImageTracklet] = []

    def clear(self) -> None:
        """Delete all tracklets; names are not used again."""
        self.tracklets = []

    def assign(
        self, boxes: list[Box], colours: list[Floats | None], time: float, preassigned: list[ImageTracklet | None]
    ) -> list[ImageTracklet]:
        """The tracklet of each box; new ones are initiated. preassigned: tracklet that a box belongs to, if known."""
        assigned: list[ImageTracklet | None] = list(preassigned)
        taken = {id(one) for one in assigned if one is not None}
        free = [one for one in self.tracklets if id(one) not in taken]
        open_boxes = [index for index, assigned_tracklet in enumerate(assigned) if assigned_tracklet is None]
        if free and open_boxes:
            cost = np.array(
                [[_association_cost(one, boxes[index], colours[index], time) for one in free] for index in open_boxes]
            )
            for row, column in zip(*linear_sum_assignment(cost), strict=True):
                if cost[row, column] < 1.0:
                    assigned[open_boxes[row]] = free[column]
        result = []
        for index, (box, assigned_tracklet) in enumerate(zip(boxes, assigned, strict=True)):
            if assigned_tracklet is None:
                middle = box[0] + 0.5 * box[2], box[1] + 0.5 * box[3]
                assigned_tracklet = ImageTracklet(
                    f"{self._prefix}{self._next}",
                    box,
                    time,
                    born=time,
                    birthplace=middle,
                    min_displacement=self._min_displacement,
                )
                assigned_tracklet.colour = colours[index]
                self._next += 1
                self.tracklets.append(assigned_tracklet)
            result.append(assigned_tracklet)
        return result

    def prune(self, time: float, size: tuple[int, int]) -> None:
        """Delete tracklets without detections for a while, or outside the image (width, height)."""
        kept = []
        for one in self.tracklets:
            x, y, w, h = one.predicted_box(time)
            gone = x + w < 0 or y + h < 0 or x > size[0] or y > size[1]
            silent = time - one.time
            if not gone and silent <= (_COAST_S if one.confirmed else _TENTATIVE_COAST_S):
                kept.append(one)
        self.tracklets = kept


def _association_cost(one: ImageTracklet, box: Box, colour: Floats | None, time: float) -> float:
    """Cost of assigning a box to a tracklet: below 1 it is admissible."""
    x, y, w, h = one.predicted_box(time)
    scale = max(h, box[3], 8.0)
    displacement = np.hypot(x + 0.5 * w - box[0] - 0.5 * box[2], y + 0.5 * h - box[1] - 0.5 * box[3]) / scale
    # The gate grows with the time since the last detection.
    reach = 0.35 + 0.6 * min(time - one.time, 1.0)
    taller = abs(np.log(max(h, 1.0) / max(box[3], 1.0)))
    colour_distance = 0.0
    if colour is not None and one.colour is not None:
        colour_distance = float(np.linalg.norm(colour - one.colour)) / 150.0
    return float(displacement / reach + 0.5 * taller + 0.5 * colour_distance)


def match_predictions(detections: Sequence[Detection], predictions: Sequence[Prediction]) -> list[Detection]:
    """The detections, with ``target`` set where one is assigned to a prediction; each prediction at most once."""
    if not detections or not predictions:
        return list(detections)
    cost = np.array([[_gate_distance(one, prediction) for prediction in predictions] for one in detections])
    result = list(detections)
    for row, column in zip(*linear_sum_assignment(np.minimum(cost, 10.0 * _GATE)), strict=True):
        if cost[row, column] < _GATE:
            result[row] = replace(detections[int(row)], target=predictions[int(column)].target)
    return result


def _gate_distance(one: Detection, prediction: Prediction) -> float:
    a, b, c = prediction.covariance
    if one.covariance is not None:
        a, b, c = a + one.covariance[0], b + one.covariance[1], c + one.covariance[2]
    spread = np.array([[a, b], [b, c]])
    error = np.array([one.u - prediction.u, one.v - prediction.v])
    if not np.isfinite(spread).all() or np.linalg.det(spread) <= 0:
        return float("inf")
    total = float(error @ np.linalg.solve(spread, error))
    if not total < _GATE:  # also where it is NaN
        return float("inf")
    if prediction.size > 0 and one.size > 0:
        total += (np.log(one.size / prediction.size) / _LOG_SIZE_STD) ** 2 * 0.25
    if prediction.colour is not None and one.colour is not None:
        total += float(np.sum((np.array(one.colour) - np.array(prediction.colour)) ** 2.0)) / _COLOUR_STD**2 * 0.25
    return total
