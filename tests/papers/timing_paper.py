"""The simulation of the paper on timing, section 3.1: two cameras, a marker, a lag.

Eq. (23) fixes the convention: it reproduces only with phi and theta swapped against the text,
``X_cam = Rz(phi) Ry(theta) X + d e_x``, optical axis = camera x, u = 700 y/x, v = 700 z/x.
``python -m tests.papers.timing_paper`` prints the sweep over lags.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hub.timing.fundamental import epipolar_lines, line_distances, maximum_likelihood
from hub.timing.paper import alternate
from protocols.errors import Refused
from protocols.geometry import so3
from protocols.geometry.types import Floats

FOCAL, PERIOD, DURATION = 700.0, 1.0 / 30.0, 11.0
CAMERA_1, CAMERA_2 = (30.0, 40.0, 600.0), (60.0, 20.0, 700.0)
PRINTED_F = np.array(
    [[0.000166, 0.000069, 0.205062], [-0.000439, -0.000299, -0.617640], [-0.414374, 0.636211, 0.000007]]
)
"""Eq. (23)."""


def project(camera: tuple[float, float, float], points: Floats) -> Floats:
    """Pixels (n, 2), origin at the image's centre, of world points (n, 3) [cm]."""
    phi, theta, distance = camera
    turn = so3.exp(np.array([0.0, 0.0, np.radians(phi)])) @ so3.exp(np.array([0.0, np.radians(theta), 0.0]))
    local = points @ turn.T + np.array([distance, 0.0, 0.0])
    return FOCAL * local[:, 1:] / local[:, :1]


def trajectory_24(time: Floats) -> Floats:
    """Eq. (24) [cm]."""
    return np.column_stack(
        [
            10.0 * (time - 5.5),
            120.0 * np.sin(np.pi * time) * np.sin(np.pi / 11.0 * time),
            100.0 * np.cos(1.5 * np.pi * time) * np.sin(np.pi / 11.0 * time),
        ]
    )


def evaluation_points(seed: int = 0) -> Floats:
    """281 points (n, 3) uniform in the cube of ±120 cm."""
    return np.random.default_rng(seed).uniform(-120.0, 120.0, (281, 3))


@dataclass(frozen=True, slots=True)
class LagResult:
    """One lag of the sweep. tau_error [s]; f_error: mean distance of the evaluation points [px]; nan = refused."""

    tau: float
    tau_error: float
    f_error: float
    turns: int


def run_lag(tau: float, trajectory: Callable[[Floats], Floats] = trajectory_24, seed: int = 0) -> LagResult:
    """The paper's method on tracks of which camera 2 samples X(t + tau)."""
    time = np.arange(0.0, DURATION, PERIOD)
    points = evaluation_points(seed)
    try:
        found = alternate(project(CAMERA_1, trajectory(time)), project(CAMERA_2, trajectory(time + tau)))
    except Refused:
        return LagResult(tau, float("nan"), float("nan"), 0)
    lines = epipolar_lines(found.fundamental, project(CAMERA_1, points))
    f_error = float(np.abs(line_distances(lines, project(CAMERA_2, points))).mean())
    # b's index runs tau / period behind: f = -tau / period.
    return LagResult(tau, -found.lag * PERIOD - tau, f_error, len(found.turns))


def sweep() -> list[LagResult]:
    """Lags of 0.01 to 0.39 s."""
    return [run_lag(tau) for tau in np.arange(0.01, 0.395, 0.01)]


def first_failure(results: list[LagResult]) -> float:
    """The smallest lag [s] that was not found to a tenth of a frame."""
    bad = [result.tau for result in results if not abs(result.tau_error) < 0.1 * PERIOD]
    return min(bad, default=float("inf"))


def printed_fundamental() -> Floats:
    """F from the evaluation points, with eq. (23)'s sign."""
    points = evaluation_points()
    matrix = maximum_likelihood(project(CAMERA_1, points), project(CAMERA_2, points))
    return matrix * np.sign(float((matrix * PRINTED_F).sum()))


def main() -> None:
    """Print the paper's figures beside ours."""
    print(f"eq. (23): largest difference of an entry {np.abs(printed_fundamental() - PRINTED_F).max():.1e}")
    results = sweep()
    print("  lag s   error ms    F px  turns")
    for r in results:
        print(f"{r.tau:7.2f} {1e3 * r.tau_error:10.4f} {r.f_error:7.3f} {r.turns:6d}")
    limit = first_failure(results)
    below = [r for r in results if r.tau < limit]
    tau, f = np.mean([abs(r.tau_error) for r in below]), np.mean([r.f_error for r in below])
    print(
        f"first failure at {limit:.2f} s (paper: 0.32); below it tau {1e3 * tau:.3f} ms (paper: under 0.1), "
        f"F {f:.3f} px (paper: under 0.2)"
    )


if __name__ == "__main__":
    main()
