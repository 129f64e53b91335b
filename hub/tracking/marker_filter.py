"""Asynchronous extended Kalman filter of one labelled marker over single-camera rows. Pure functions.

A bank of filters differs in the density of the jerk, because neither the motion nor the scale of the world is known.
The bank is weighted by the likelihood of the innovations with forgetting (Raftery, Kárný, Ettler 2010), and moves to
larger or smaller densities when its outermost filter is the likeliest. Each camera's noise is estimated from the
residuals (Mehra 1972; Mohamed and Schwarz 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hub.tracking.association.triangulation import ROWS_PER_CAMERA, initial_motion
from hub.tracking.filter.jerk_model import POSITION, STATE_DIM, jerk_model, rts_smooth
from hub.tracking.filter.marker_rows import MarkerRow
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats

_PSD_STEP = 10.0
"""Between the densities of neighbouring filters: the bandwidth goes with the sixth root, so 1.5 times."""
_BANK = np.array([1.0 / _PSD_STEP, 1.0, _PSD_STEP])
_MOVE_WEIGHT = 0.7
_MEMORY_S = 1.0
"""Time constant of the forgetting of past innovations."""
_GATE = 18.4
"""The 99.99 % quantile of chi-square with two degrees of freedom."""
_NOISE_GAIN, _NOISE_START = 0.02, 10.0
"""Smallest gain of a camera's noise factor, and the rows that its prior counts for."""
RECENT_NS = 500_000_000
"""A camera that saw the marker no longer ago counts as seeing it."""
_CONFIRM_HITS = 10
"""Accepted rows, with the six of the first state."""
_USUAL_GAIN = 0.05
_COASTING_STD = 3.0
"""Times the usual std: then one std is as large as errors ever are while two cameras see the marker."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerState:
    """The bank of m filters of one marker after a row; m = 0: no track.

    mean: (m, 9), covariance: (m, 9, 9), log_weight: (m,), psd: (m,) density of the jerk [unit²/s⁵], at time_ns on the
    reference clock, the time of the last accepted row. hits: accepted rows. accepted, rejected: by camera, the time of
    the last row that was accepted or rejected. noise: by camera, factor of its noise and number of rows behind it.
    usual_std: std of the position while at least two cameras see the marker. pending: the newest rejected rows.
    serial: counts the tracks.
    """

    time_ns: int = 0
    mean: Floats = field(default_factory=lambda: np.zeros((0, STATE_DIM)))
    covariance: Floats = field(default_factory=lambda: np.zeros((0, STATE_DIM, STATE_DIM)))
    log_weight: Floats = field(default_factory=lambda: np.zeros(0))
    psd: Floats = field(default_factory=lambda: np.zeros(0))
    hits: int = 0
    accepted: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    noise: dict[str, tuple[float, int]] = field(default_factory=dict)
    usual_std: float = 0.0
    pending: tuple[MarkerRow, ...] = ()
    serial: int = 0

    @property
    def confirmed(self) -> bool:
        """Whether enough rows agree."""
        return self.hits >= _CONFIRM_HITS

    @property
    def weight(self) -> Floats:
        """(m,) posterior weights of the bank."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        return np.asarray(weight / weight.sum())

    def cameras(self, time_ns: int) -> int:
        """How many cameras saw the marker recently."""
        return sum(seen > time_ns - RECENT_NS for seen in self.accepted.values())

    def predicted(self, time_ns: int) -> tuple[Floats, Floats]:
        """Mean (9,) and covariance (9, 9) of the bank's mixture, predicted to a time not before the state's."""
        step, noise = jerk_model((time_ns - self.time_ns) / NANOSECONDS)
        means = self.mean @ step.T
        covariances = step @ self.covariance @ step.T + self.psd[:, None, None] * noise
        weight = self.weight
        mean = weight @ means
        off = means - mean
        return mean, np.einsum("m,mij->ij", weight, covariances + off[:, :, None] * off[:, None, :])

    def is_uncertain(self, covariance: Floats) -> bool:
        """Whether a position's covariance (9, 9) is far above the usual one: only one camera sees it, or none."""
        return position_std(covariance) > _COASTING_STD * self.usual_std

    def transformed(self, change: Similarity) -> MarkerState:
        """The state in another world frame."""
        turn = np.kron(np.eye(3), change.scale * change.rotation)
        mean = self.mean @ turn.T
        mean[:, POSITION] += change.shift
        return replace(
            self,
            mean=mean,
            covariance=turn @ self.covariance @ turn.T,
            psd=self.psd * change.scale**2,
            usual_std=self.usual_std * change.scale,
            pending=(),
        )


def position_std(covariance: Floats) -> float:
    """Root mean square std of a position's three coordinates, from the state's covariance (9, 9)."""
    return float(np.sqrt(max(covariance[0, 0] + covariance[1, 1] + covariance[2, 2], 0.0) / 3.0))


def process_row(state: MarkerState, row: MarkerRow, coast_ns: int) -> MarkerState:
    """The state after one row; rows must be processed in the order of their keys.

    coast_ns: after that time without accepted rows the track has ended.
    """
    if len(state.mean) and row.reference_ns - state.time_ns <= coast_ns:
        updated = _update(state, row)
        if updated is not None:
            return updated
    elif len(state.mean):
        state = MarkerState(rejected=state.rejected, noise=state.noise, pending=state.pending, serial=state.serial)
    return _reject(state, row)


def _update(state: MarkerState, row: MarkerRow) -> MarkerState | None:
    """The state after an accepted row; None if it is outside the gate."""
    camera, name = row.camera, row.camera.name
    elapsed = (row.reference_ns - state.time_ns) / NANOSECONDS
    step, drift = jerk_model(elapsed)
    mean = state.mean @ step.T
    covariance = step @ state.covariance @ step.T + state.psd[:, None, None] * drift
    rotation = camera.pose.rotation
    local = (mean[:, POSITION] - camera.pose.position) @ rotation.T
    depth = local[:, 2:]
    if not depth.min() > 0.0:
        return None
    seen = local[:, :2] / depth
    jacobian = (rotation[:2] - seen[:, :, None] * rotation[2]) / depth[:, :, None]
    factor, rows = state.noise.get(name, (1.0, 0))
    # The error of the time map moves the point along its image velocity.
    moved = (jacobian @ mean[:, 3:6, None]) * camera.time_std
    noise = factor * row.noise + moved * moved.transpose(0, 2, 1)
    cross = covariance[:, :, POSITION] @ jacobian.transpose(0, 2, 1)
    spread = jacobian @ cross[:, POSITION] + noise
    determinant = spread[:, 0, 0] * spread[:, 1, 1] - spread[:, 0, 1] * spread[:, 1, 0]
    inverse = np.empty_like(spread)
    inverse[:, 0, 0], inverse[:, 1, 1] = spread[:, 1, 1], spread[:, 0, 0]
    inverse[:, 0, 1], inverse[:, 1, 0] = -spread[:, 0, 1], -spread[:, 1, 0]
    inverse /= determinant[:, None, None]
    innovation = (row.point - seen)[:, :, None]
    solved = inverse @ innovation
    distance = (innovation * solved).sum(axis=(1, 2))
    # The gate of the filter with the largest density: a manoeuvre must not look like an outlier.
    if not distance[-1] < _GATE:
        return None
    mean = mean + (cross @ solved)[:, :, 0]
    covariance = covariance - cross @ inverse @ cross.transpose(0, 2, 1)
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    log_weight = np.exp(-elapsed / _MEMORY_S) * state.log_weight - 0.5 * (distance + np.log(determinant))
    log_weight -= log_weight.max()
    best = int(log_weight.argmax())
    # E[residual residualᵀ] = R - H P⁺ Hᵀ, of the likeliest filter and relative to R.
    weighted = noise[best] @ inverse[best]
    excess = 0.5 * (float((solved[best].T @ noise[best] @ solved[best])[0, 0]) - weighted[0, 0] - weighted[1, 1])
    gain = max(1.0 / (rows + _NOISE_START), _NOISE_GAIN)
    accepted = {**state.accepted, name: row.reference_ns}
    usual = state.usual_std
    if sum(seen_ns > row.reference_ns - RECENT_NS for seen_ns in accepted.values()) >= 2:
        usual += _USUAL_GAIN * (position_std(covariance[best]) - usual)
    psd = state.psd
    if np.exp(log_weight[[0, -1]]).max() > _MOVE_WEIGHT * np.exp(log_weight).sum():
        # The bank moves by one density: the outermost filter is doubled, and the opposite one is dropped.
        up = best > 0
        keep = [1, 2, 2] if up else [0, 0, 1]
        mean, covariance, log_weight = mean[keep], covariance[keep], log_weight[keep]
        psd = psd * (_PSD_STEP if up else 1.0 / _PSD_STEP)
    return replace(
        state,
        time_ns=row.reference_ns,
        mean=mean,
        covariance=covariance,
        log_weight=log_weight,
        psd=psd,
        hits=state.hits + 1,
        accepted=accepted,
        noise={**state.noise, name: (max(factor * (1.0 + gain * excess), 1.0), rows + 1)},
        usual_std=usual,
    )


def _reject(state: MarkerState, row: MarkerRow) -> MarkerState:
    """Keep a row that the track does not explain; begin a new track if most cameras disagree with the old one."""
    now, name = row.reference_ns, row.camera.name
    rejected = {**state.rejected, name: now}
    recent = [old for old in state.pending if old.reference_ns > now - RECENT_NS]
    own = [old for old in recent if old.camera.name == name][1 - ROWS_PER_CAMERA :] + [row]
    others = [old for old in recent if old.camera.name != name]
    state = replace(state, rejected=rejected, pending=(*others, *own))
    against = {
        camera for camera, time in rejected.items() if time > max(state.accepted.get(camera, time - 1), now - RECENT_NS)
    }
    agreeing = sum(time > now - RECENT_NS for camera, time in state.accepted.items() if camera not in against)
    if len(own) < ROWS_PER_CAMERA or len(against) < 2 or (len(state.mean) and len(against) <= agreeing):
        return state
    for other in sorted({old.camera.name for old in others}):
        theirs = [old for old in others if old.camera.name == other]
        if len(theirs) == ROWS_PER_CAMERA and other in against:
            found = initial_motion([*theirs, *own])
            if found is not None:
                return _begin(state, row, other, *found)
    return state


def _begin(
    state: MarkerState, row: MarkerRow, other: str, mean: Floats, covariance: Floats, factor: float
) -> MarkerState:
    """A track from a first state (9,), (9, 9) at a row's time.

    Its middle density lets the acceleration change by its own uncertainty in the time that the rows span: more would
    make the rows independent, less is left to the bank.
    """
    elapsed = (row.reference_ns - min(old.reference_ns for old in state.pending)) / NANOSECONDS
    psd = float(np.trace(covariance[6:, 6:])) / 3.0 / elapsed
    noise = {name: (max(state.noise.get(name, (1.0, 0))[0], factor), 0) for name in (row.camera.name, other)}
    return MarkerState(
        time_ns=row.reference_ns,
        mean=np.tile(mean, (len(_BANK), 1)),
        covariance=np.tile(covariance, (len(_BANK), 1, 1)),
        log_weight=np.zeros(len(_BANK)),
        psd=psd * _BANK,
        hits=2 * ROWS_PER_CAMERA,
        accepted=dict.fromkeys((other, row.camera.name), row.reference_ns),
        noise={**state.noise, **noise},
        usual_std=position_std(covariance),
        serial=state.serial + 1,
    )


def smooth_states(states: list[MarkerState]) -> tuple[Floats, Floats]:
    """Smoothed means (n, 9) and covariances (n, 9, 9) of n states of one track, in order of time.

    Each with the filter whose density is nearest to the likeliest one now.
    """
    psd = np.array([state.psd for state in states])
    likely = psd[-1, int(states[-1].log_weight.argmax())]
    member = np.abs(np.log(psd / likely)).argmin(axis=1)
    mean = np.array([state.mean[m] for state, m in zip(states, member, strict=True)])
    covariance = np.array([state.covariance[m] for state, m in zip(states, member, strict=True)])
    time = np.array([state.time_ns - states[-1].time_ns for state in states]) / NANOSECONDS
    return rts_smooth(time, mean, covariance, psd[np.arange(len(states)), member])


def misfit(pairs: Sequence[tuple[MarkerRow, MarkerState]], change: Similarity | None) -> float:
    """Median squared distance of rows, under a new calibration, from the states after them in a new world frame.

    In variances of the rows. change: from the states' world frame to the calibration's, None = the same frame.
    """
    mean = np.array([state.mean[int(state.log_weight.argmax()), POSITION] for _, state in pairs])
    off = []
    for (row, _), place in zip(pairs, mean if change is None else change.points(mean), strict=True):
        x, y, depth = row.camera.pose.rotation @ (place - row.camera.pose.position)
        away = row.point - np.array([x, y]) / depth if depth > 0.0 else np.full(2, np.inf)
        off.append(float(away @ away) / float(np.trace(row.noise)))
    return float(np.median(off))
