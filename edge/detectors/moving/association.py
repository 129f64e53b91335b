"""Association of detections with the predictions of tracked targets: gating and assignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge.detectors.base import Detection, Prediction

_GATE = 13.8  # chi2 of 2 degrees of freedom, 0.999
_COLOUR_STD = 60.0  # std of colours [8-bit steps]
_LOG_SIZE_STD = 0.2  # std of the logarithm of the size


def match_predictions(detections: Sequence[Detection], predictions: Sequence[Prediction]) -> list[Detection]:
    """The detections, with ``target`` set where one is assigned to a prediction; each prediction at most once."""
    if not detections or not predictions:
        return list(detections)
    from scipy.optimize import linear_sum_assignment

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
