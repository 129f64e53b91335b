"""Compiled inner loops (kernels.c), where the installation had a C compiler; numpy does the same elsewhere.

For arrays of a few hundred rows numpy's time is that of its calls. Callers ask ``AVAILABLE`` and have the numpy code
beside it, which is also what the tests compare with. ``SYNCLINE_PURE=1`` leaves them out, of wheels too.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from ctypes import CDLL, addressof, c_char, c_double, c_int64, c_void_p
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Bools, Floats, Ints, Singles

_KINDS = {"n": c_int64, "d": c_double, "p": c_void_p}
_SIGNATURES = {
    "spline_weights": "npnpdpppp",
    "label_weights": "npnppdpppp",
    "spline_values": "npnpnnppp",
    "weighted_sums": "nnpppp",
    "spline_normal": "npppnpnpdnpp",
    "add_rows": "nppppnpp",
    "brown_distortion": "npppp",
    "project_points": "npppppdppppp",
    "pose_jacobians": "nppppppppnpp",
    "refine_alignment": "nppppnndddnddndp",
    "smallest_eigenvalues": "npddndp",
    "neighbour_scores": "nppnpndp",
    "homography_residual": "nppnp",
    "match_layouts": "nppnpp",
    "orientation_cells": "nnnppp",
    "fit_plane_camera": "nppnpppddnp",
    "ground_pixels": "pppddnpp",
    "open_road": "pppddnppddnnppnpdp",
    "colour_values": "npnpp",
    "colour_histogram": "nppnddp",
    "reduce_image": "nnnppp",
    "blurred_colours": "npnnnpp",
    "fit_motion": "nppppppppp",
    "filter_row": "dpppnpdpdnddppp",
    "smooth_jerk": "nnpppppp",
    "road_evidence": "nnpnnnnpnppp",
    "grid_values": "dddnnpnpp",
    "road_edges": "dddnnpnppndddnp",
    "arc_values": "dddnnpnnnpppddddpnp",
    "densest_cluster": "nppdppp",
}
"""Of each function: counts n, doubles d and pointers p."""


def load(file: Path) -> CDLL | None:
    """The library in a file; None if there is none for this machine."""
    try:
        library = CDLL(str(file))
        for name, kinds in _SIGNATURES.items():
            function = getattr(library, name)
            function.argtypes, function.restype = [_KINDS[kind] for kind in kinds], None
        for name in ("homography_residual", "refine_alignment", "filter_row", "smooth_jerk"):
            getattr(library, name).restype = c_double
    except (OSError, AttributeError):
        return None
    return library


_found = None if os.environ.get("SYNCLINE_PURE") else load(Path(__file__).with_name("libkernels.so"))
AVAILABLE, _library = _found is not None, cast(CDLL, _found)


_BYTE = c_char.from_buffer


def _at(array: npt.NDArray[Any]) -> int:
    """The address of an array, which is contiguous and outlives the call."""
    try:
        return addressof(_BYTE(array))  # type: ignore[arg-type]  # a third of the time of numpy's own
    except (TypeError, ValueError):  # read-only or empty
        assert array.flags.c_contiguous, "a kernel would read beside the array"
        return array.ctypes.data


def call(name: str, *given: npt.NDArray[Any] | float | None) -> float:
    """Call a function of kernels.c with numbers and arrays, which are contiguous and of its types; None is null."""
    try:  # in place of _at: half of a call's time
        arguments = [addressof(_BYTE(one)) if type(one) is np.ndarray else one for one in given]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        arguments = [_at(one) if isinstance(one, np.ndarray) else one for one in given]
    return cast(float, getattr(_library, name)(*arguments))


def _rows_last(points: Floats) -> Floats:
    """(d, n) contiguous, of (n, d)."""
    return np.ascontiguousarray(points.T, dtype=np.float64)


def spline_weights(
    basis: Floats, time: Floats, extrapolation: float, slopes: bool
) -> tuple[Ints, Floats, Floats, Bools]:
    """First control points (n,), weights (4, n), those of the slopes (4, n) or (4, 0), inside (n,).

    basis: (4, stretches) starts, widths, numbers of intervals, first control points. time: (n,).
    """
    time, count = np.ascontiguousarray(time, dtype=np.float64), len(time)
    index, inside = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.bool_)
    weights, derivatives = np.empty((4, count)), np.empty((4, count if slopes else 0))
    to = index, weights, derivatives if slopes else None, inside
    call("spline_weights", count, time, basis.shape[1], basis, extrapolation, *to)
    return index, weights, derivatives, inside


def label_weights(
    bases: Sequence[tuple[Floats, int]], ends: Ints, time: Floats, extrapolation: float
) -> tuple[Ints, Floats, Floats, Bools]:
    """What `spline_weights` gives for the rows (n,) of several labels, with all control points in one vector.

    bases: of each label the basis (4, stretches) and its first control point. ends: (labels,) where their rows end.
    """
    time, count = np.ascontiguousarray(time, dtype=np.float64), len(time)
    index, inside = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.bool_)
    weights, slopes = np.empty((2, 4, count))
    tables = np.array([(_at(one), one.shape[1], first) for one, first in bases], dtype=np.int64)
    to = index, weights, slopes, inside
    call("label_weights", count, time, len(ends), ends, tables, extrapolation, *to)
    return index, weights, slopes, inside


def spline_values(basis: Floats, time: Floats, polynomials: Floats) -> tuple[Floats, Floats]:
    """Values and slopes (d, n) at time (n,); NaN outside. polynomials: (4, d, m)."""
    time, (_, width, size) = np.ascontiguousarray(time, dtype=np.float64), polynomials.shape
    values, slopes = np.empty((2, width, len(time)))
    call("spline_values", len(time), time, basis.shape[1], basis, width, size, polynomials, values, slopes)
    return values, slopes


def weighted_sums(control: Floats, index: Ints, weights: Floats) -> Floats:
    """(d, n) sums of four control points from ``index`` (n,) on. control: (size, d). weights: (4, n)."""
    control, weights = np.ascontiguousarray(control, dtype=np.float64), np.ascontiguousarray(weights)
    index = np.ascontiguousarray(index, dtype=np.int64)
    out = np.empty((control.shape[1], len(index)))
    call("weighted_sums", len(index), control.shape[1], control, index, weights, out)
    return out


def spline_normal(
    rows: tuple[Ints, Floats], row_weight: Floats, values: Floats, basis: Floats, stiffness: float, size: int
) -> tuple[Floats, Floats]:
    """Bands (4, size) of the normal matrix and right-hand side (d, size) of a fit to values (n, d).

    rows: first control points (n,) and weights (4, n).
    """
    index, row_weight = np.ascontiguousarray(rows[0], dtype=np.int64), np.ascontiguousarray(row_weight)
    weights, values = np.ascontiguousarray(rows[1]), np.ascontiguousarray(values, dtype=np.float64)
    width = values.shape[1]
    bands, target = np.zeros((4, size)), np.zeros((width, size))
    given = index, weights, row_weight, width, values, basis.shape[1], basis
    call("spline_normal", len(index), *given, stiffness, size, bands, target)
    return bands, target


MOST_TERMS = 21
"""Columns beside the point's that `add_rows` takes: the parameters of a camera and the residual."""


def add_rows(
    ends: Ints,
    index: Ints,
    weights: Floats,
    terms: Floats,
    to: Sequence[tuple[int, Floats, int, Floats]],
    gram: Floats,
) -> None:
    """Add rows (n,) of several labels to the sums of `hub.bundle.bordered_system.add_rows`.

    ends: (labels,) where their rows end. weights: (4, n). terms: (2, 3 + p, n). to: of each label its
    first control point and the sums over pairs, the first one observed and the sums with the other columns from there.
    """
    index, weights = np.ascontiguousarray(index, dtype=np.int64), np.ascontiguousarray(weights)
    terms, width = np.ascontiguousarray(terms), terms.shape[1] - 3
    tables = np.array([(first, _at(sums), low, _at(crossed)) for first, sums, low, crossed in to], dtype=np.int64)
    call("add_rows", len(ends), tables, ends, index, weights, width, terms, gram)


def brown_distortion(normalised: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Distorted coordinates (2, n) of normalised ones (n, 2), and their Jacobian (2, 2, n)."""
    normalised, coefficients = _rows_last(normalised), np.ascontiguousarray(coefficients, dtype=np.float64)
    out, jacobian = np.empty(normalised.shape), np.empty((2, *normalised.shape))
    call("brown_distortion", normalised.shape[1], normalised, coefficients, out, jacobian)
    return out, jacobian


def project_points(
    points: Floats, pose: tuple[Floats, Floats], lens: tuple[Floats, Floats, float], looked_at: Bools
) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """Of world points (n, 3): in camera axes (3, n), normalised (2, n), pixels (2, n), the Jacobian (2, 2, n) of
    Brown's distortion, and which of those ``looked_at`` (n,) are in front of the camera and within the fold.

    pose: rotation, position. lens: camera matrix, distortion, fold. Elsewhere the pixel is the principal point.
    """
    points, count = _rows_last(points), len(looked_at)
    rotation, position, matrix, coefficients = (
        np.ascontiguousarray(one, dtype=np.float64) for one in (*pose, *lens[:2])
    )
    seen, out, flat, pixels = looked_at.copy(), np.empty((3, count)), np.empty((2, count)), np.empty((2, count))
    jacobian, given = np.empty((2, 2, count)), (rotation, position, matrix, coefficients, lens[2])
    call("project_points", count, points, *given, out, flat, pixels, jacobian, seen)
    return out, flat, pixels, jacobian, seen


def pose_jacobians(
    rotation: Floats,
    matrix: Floats,
    rows: tuple[Floats, Floats, Floats, Bools],
    velocity: Floats | None,
    place: Ints,
    out: Floats,
) -> Floats:
    """Into ``out`` (2, columns, n) the derivatives of pixels by the point and by pose parameter k in column place[k].

    rows: camera_points, normalised, Jacobian and valid of `project_points`. velocity: (3, n) of the points. place:
    (6,), -1 = not wanted. Returns the derivatives (2, n) by time, empty ones without velocity.
    """
    count, by_time = out.shape[2], np.empty((2, out.shape[2] if velocity is not None else 0))
    rotation, matrix = (np.ascontiguousarray(one, dtype=np.float64) for one in (rotation, matrix))
    kept = [None if one is None else np.ascontiguousarray(one) for one in (*rows, velocity)]
    call("pose_jacobians", count, rotation, matrix, *kept, place, out.shape[1], by_time, out)
    return by_time


class SampledTracks:
    """Points of one camera's tracks at their own times, and the splines of another camera's, for `refine_alignment`.

    points: (n, 2), label by label. centred_time: (n,). rows: number of each label's rows. splines: of each label, the
    basis (4, stretches) and the polynomials (4, 2, m).
    """

    def __init__(
        self, points: Floats, centred_time: Floats, rows: Sequence[int], splines: Sequence[tuple[Floats, Floats]]
    ) -> None:
        self.count = len(points)
        bases, polynomials = zip(*splines, strict=True)
        self._kept: list[Floats | Ints] = [_rows_last(points), np.ascontiguousarray(centred_time), *bases, *polynomials]
        sizes = [[basis.shape[1] for basis in bases], [one.shape[2] for one in polynomials]]
        tables = [np.cumsum(rows, dtype=np.int64), *np.array(sizes, dtype=np.int64)]
        tables += [np.array([_at(one) for one in part], dtype=np.int64) for part in (bases, polynomials)]
        tracks = np.array([len(bases), *(_at(table) for table in tables)], dtype=np.int64)
        self._kept += [*tables, tracks]
        self.at = _at(self._kept[0]), _at(self._kept[1]), _at(tracks)


def refine_alignment(
    samples: SampledTracks,
    state: Floats,
    kind: tuple[bool, int],
    noise: tuple[float, float, float],
    widths: tuple[float, float],
    limits: tuple[int, int, float],
) -> tuple[float, Floats]:
    """Cost, infinite where there is none, and normal matrix of `hub.two_view.refinement.refine`.

    state: (23,) of a pose rotation, nine unused, direction; or left, right, angle, two unused; then inverse rate and
    intercept; in place. kind: whether a pose, and free parameters of the geometry. noise: sigma of a and of b, prior of
    the rate. widths: first and last of the Cauchy weight. limits: least rows, most iterations, tolerance.
    """
    normal, (least, iterations, tolerance) = np.empty((kind[1] + 2,) * 2), limits
    given = *kind, noise[0] ** 2, noise[1] ** 2, noise[2] ** -2, least, *widths, iterations, tolerance
    cost: float = _library.refine_alignment(samples.count, *samples.at, _at(state), *given, _at(normal))
    return cost, normal


def smallest_eigenvalues(
    moments: Floats, sigma_a: float, sigma_b: float, iterations: int, min_orthogonal: float
) -> Floats:
    """Smallest generalised eigenvalues (m,) of moments (6, 6, m) under Taubin's normalisation."""
    moments, count = np.ascontiguousarray(moments), moments.shape[2]
    out = np.empty(count)
    call("smallest_eigenvalues", count, moments, sigma_a**2, sigma_b**2, iterations, min_orthogonal, out)
    return out


def neighbour_scores(time: Floats, points: Floats, rows: Ints, one_sided: bool, share: float) -> Floats:
    """Quantile ``share`` (n,) of each point's distances from lines through two of the good ones ``rows``."""
    time, points = np.ascontiguousarray(time), np.ascontiguousarray(points)
    out = np.empty(len(time))
    call("neighbour_scores", len(time), time, points, len(rows), rows, int(one_sided), share, out)
    return out


def homography_residual(a: Floats, b: Floats, iterations: int) -> float:
    """Median distance of points b (n, 2) from a mapped by the best homography, in b's unit."""
    count, scratch = len(a), np.empty(6 * len(a))
    a, b = _rows_last(a), _rows_last(b)
    return call("homography_residual", count, a, b, iterations, scratch)


def match_layouts(payloads: Sequence[bytes], tables: Ints) -> bytearray:
    """1 of each payload that matches a layout, as `protocols.validation.layouts.Layouts` has them, else 0."""
    sizes, found = np.array([len(one) for one in payloads], dtype=np.int64), bytearray(len(payloads))
    to = addressof(c_char.from_buffer(found))
    _library.match_layouts(len(sizes), _at(sizes), b"".join(payloads), len(tables) - 1, _at(tables), to)
    return found


def orientation_cells(magnitude: Singles, angle: Singles, cell: int, out: Singles) -> None:
    """Into ``out`` (9, h / cell, w / cell) the means over cells of gradients (h, w) by orientation. angle: [rad]."""
    height, width = magnitude.shape
    call("orientation_cells", height, width, cell, magnitude, angle, out)
