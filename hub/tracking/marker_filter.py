"""Asynchronous iterated extended Kalman filter of one labelled marker over single-camera rows. Pure functions.

Each row is linearised again at its result (Bell and Cathey 1993). A bank of filters differs in the density of the
jerk, because neither the motion nor the scale of the world is known. The bank is weighted by the likelihood of the
innovations with forgetting (Raftery, Kárný, Ettler 2010), and moves to larger or smaller densities when its outermost
filter is the likeliest. Each camera's noise is estimated from the residuals (Mehra 1972; Mohamed and Schwarz 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import exp, log, sqrt

import numpy as np

from hub.tracking.association.triangulation import ROWS_PER_CAMERA, initial_motion
from hub.tracking.filter.jerk_model import POSITION, STATE_DIM, VELOCITY, jerk_model, rts_smooth
from hub.tracking.filter.marker_rows import MarkerRow
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import kernels
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats

_PSD_STEP = 10.0
"""Between the densities of neighbouring filters: the bandwidth goes with the sixth root, so 1.5 times."""
_BANK = (1.0 / _PSD_STEP, 1.0, _PSD_STEP)
_MOVE_WEIGHT = 0.7  # of an outermost filter: less moves by chance from equal ones' thirds, more follows manoeuvres late
_MEMORY_S = 1.0
"""Time constant of the forgetting of past innovations."""
_GATE = 18.4
"""The 99.99 % quantile of chi-square with two degrees of freedom."""
_ITERATIONS, _LINEAR = 4, 0.003
"""Linearisations of a row, at most; the last one is near enough if it moves the state by less, as a fraction of the
depth. They matter when a second camera sees a marker whose depth had been lost."""
_NOISE_GAIN, _NOISE_START = 0.02, 10.0
"""Smallest gain of a camera's noise factor, and the rows that its prior counts for."""
RECENT_NS = 500_000_000
"""A camera that saw the marker no longer ago counts as seeing it."""
_CONFIRM_HITS = 10
"""Accepted rows, with the six of the first state."""
_TRY_EVERY_NS = 40_000_000
"""Between two attempts to begin a track, each as costly as several rows."""
_USUAL_GAIN = 0.05  # of a row: a mean over 20
_COASTING_STD = 3.0
"""Times the usual std: then one std is as large as errors ever are while two cameras see the marker."""


Bank = tuple[float, float, float]
"""One number for each filter of the bank, by increasing density."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerState:
    """The bank of three filters of one marker after a row; without filters (m = 0) there is no track.

    mean: (m, 9), covariance: (m, 9, 9) at time_ns on the reference clock, the time of the last accepted row.
    log_weight: logarithms of the weights. psd: density of the jerk [unit²/s⁵]. hits: accepted rows. accepted,
    rejected: by camera, the time of the last row that was accepted or rejected. noise: by camera, factor of its noise
    and number of rows behind it. usual_std: std of the position while at least two cameras see the marker. pending:
    the newest rejected rows. tried_ns: when they were last tried as the beginning of a track. serial: counts tracks.
    """

    time_ns: int = 0
    mean: Floats = field(default_factory=lambda: np.zeros((0, STATE_DIM)))
    covariance: Floats = field(default_factory=lambda: np.zeros((0, STATE_DIM, STATE_DIM)))
    log_weight: Bank = (0.0, 0.0, 0.0)
    psd: Bank = (0.0, 0.0, 0.0)
    hits: int = 0
    accepted: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    noise: dict[str, tuple[float, int]] = field(default_factory=dict)
    usual_std: float = 0.0
    pending: tuple[MarkerRow, ...] = ()
    tried_ns: int | None = None
    serial: int = 0

    @property
    def confirmed(self) -> bool:
        """Whether enough rows agree."""
        return self.hits >= _CONFIRM_HITS

    @property
    def weight(self) -> Floats:
        """(3,) posterior weights of the bank."""
        weight = np.exp(self.log_weight)
        return np.asarray(weight / weight.sum())

    @property
    def best(self) -> int:
        """The likeliest filter of the bank."""
        return self.log_weight.index(max(self.log_weight))

    def cameras(self, time_ns: int) -> int:
        """How many cameras saw the marker recently."""
        return sum(seen > time_ns - RECENT_NS for seen in self.accepted.values())

    def predicted(self, time_ns: int) -> tuple[Floats, Floats]:
        """Mean (9,) and covariance (9, 9) of the bank's mixture, predicted to a time not before the state's."""
        means, covariances = self.mean, self.covariance
        if time_ns != self.time_ns:
            step, noise = jerk_model((time_ns - self.time_ns) / NANOSECONDS)
            means, covariances = means @ step.T, step @ covariances @ step.T
            covariances += np.array(self.psd)[:, None, None] * noise
        weight = self.weight
        mean = weight @ means
        off = means - mean
        within = (weight @ covariances.reshape(len(weight), -1)).reshape(STATE_DIM, STATE_DIM)
        return mean, within + (off.T * weight) @ off

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
            psd=scaled(self.psd, change.scale**2),
            usual_std=self.usual_std * change.scale,
            pending=(),
        )


def scaled(bank: Bank, factor: float) -> Bank:
    """The bank's numbers times a factor."""
    return bank[0] * factor, bank[1] * factor, bank[2] * factor


def position_std(covariance: Floats) -> float:
    """Root mean square std of a position's three coordinates, from the state's covariance (9, 9)."""
    return sqrt(max(float(covariance[0, 0] + covariance[1, 1] + covariance[2, 2]), 0.0) / 3.0)


def process_row(state: MarkerState, row: MarkerRow, coast_ns: int) -> MarkerState:
    """The state after one row; rows must be processed in the order of their keys.

    coast_ns: after that time without accepted rows the track has ended.
    """
    if len(state.mean) and row.reference_ns - state.time_ns <= coast_ns:
        updated = _update(state, row)
        if updated is not None:
            return updated
    elif len(state.mean):
        state = MarkerState(
            rejected=state.rejected,
            noise=state.noise,
            pending=state.pending,
            tried_ns=state.tried_ns,
            serial=state.serial,
        )
    return _reject(state, row)


def _update(state: MarkerState, row: MarkerRow) -> MarkerState | None:
    """The state after an accepted row; None if it is outside the gate."""
    name, elapsed = row.camera.name, (row.reference_ns - state.time_ns) / NANOSECONDS
    factor, rows = state.noise.get(name, (1.0, 0))
    accepted = {**state.accepted, name: row.reference_ns}
    cameras = sum(seen_ns > row.reference_ns - RECENT_NS for seen_ns in accepted.values())
    filtered = _filtered_compiled if kernels.AVAILABLE else _filtered
    found = filtered(state, row, elapsed, factor, _ITERATIONS if cameras > 1 else 1)
    if found is None:
        return None
    mean, covariance, fits, excesses = found
    kept = exp(-elapsed / _MEMORY_S)
    log_weight = [kept * old + fit for old, fit in zip(state.log_weight, fits, strict=True)]
    most = max(log_weight)
    best = log_weight.index(most)
    gain = max(1.0 / (rows + _NOISE_START), _NOISE_GAIN)
    usual, last_ns = state.usual_std, state.accepted.get(name)
    if cameras > 1 and (last_ns is None or state.time_ns > last_ns):  # another camera saw it since this one did
        usual += _USUAL_GAIN * (position_std(covariance[best]) - usual)
    psd = state.psd
    if best != 1 and _MOVE_WEIGHT * sum(exp(one - most) for one in log_weight) < 1.0:
        # The bank moves by one density: the outermost filter is doubled, and the opposite one is dropped.
        keep, times = ([1, 2, 2], _PSD_STEP) if best else ([0, 0, 1], 1.0 / _PSD_STEP)
        mean, covariance, log_weight = mean[keep], covariance[keep], [log_weight[k] for k in keep]
        psd = scaled(psd, times)
    return MarkerState(
        time_ns=row.reference_ns,
        mean=mean,
        covariance=covariance,
        log_weight=(log_weight[0] - most, log_weight[1] - most, log_weight[2] - most),
        psd=psd,
        hits=state.hits + 1,
        accepted=accepted,
        rejected=state.rejected,
        noise={**state.noise, name: (max(factor * (1.0 + gain * excesses[best]), 1.0), rows + 1)},
        usual_std=usual,
        pending=state.pending,
        serial=state.serial,
    )


Filtered = tuple[Floats, Floats, list[float], list[float]]
"""Means (3, 9) and covariances (3, 9, 9) of the bank after a row; by filter, its log likelihood, and by how much the
squared residual exceeds what the noise explains, relative to it."""


def _filtered_compiled(
    state: MarkerState, row: MarkerRow, elapsed: float, factor: float, iterations: int
) -> Filtered | None:
    """As `_filtered`."""
    mean, covariance, out = np.empty_like(state.mean), np.empty_like(state.covariance), np.empty(2 * len(_BANK))
    camera, given = row.camera, np.array([*state.psd, *row.point, *row.noise])
    inside = kernels.call(
        "filter_row", elapsed, given, state.mean, state.covariance, state.best, camera.extrinsics, camera.time_std,
        given[3:], factor, iterations, _LINEAR, _GATE, mean, covariance, out,
    )  # fmt: skip
    scores = out.tolist()
    return (mean, covariance, scores[:3], scores[3:]) if inside else None


def _filtered(state: MarkerState, row: MarkerRow, elapsed: float, factor: float, iterations: int) -> Filtered | None:
    """The bank after a row ``elapsed`` seconds later, linearised up to ``iterations`` times; None outside the gate.

    factor: of the row's noise. What is small is computed in scalars: for a handful of numbers, each array operation
    costs more than they do.
    """
    camera = row.camera
    step, drift = jerk_model(elapsed)
    mean = state.mean @ step.T
    covariance = step @ state.covariance @ step.T
    covariance += np.array(state.psd)[:, None, None] * drift
    rotation, centre = camera.pose.rotation, camera.pose.position
    moved = (rotation @ (camera.time_std * mean[:, VELOCITY, None])).tolist()
    prior = ((mean[:, POSITION] - centre) @ rotation.T).tolist()
    behind = [number for number, (_, _, z) in enumerate(prior) if not z > 0.0]
    if behind:
        if state.best in behind:
            return None
        # An unlikely filter whose depth is lost, as with one camera alone, begins again from the likeliest.
        for number in behind:
            mean[number], covariance[number], prior[number] = (
                mean[state.best],
                covariance[state.best],
                prior[state.best],
            )
    local = prior
    for _ in range(iterations):
        slopes = [((1.0 / z, 0.0, -x / z**2), (0.0, 1.0 / z, -y / z**2)) for x, y, z in local]
        jacobian = np.array(slopes) @ rotation
        cross = covariance[:, :, POSITION] @ jacobian.transpose(0, 2, 1)
        spreads = (jacobian @ cross[:, POSITION]).tolist()
        solved, inverses, fits, excesses = [], [], [], []
        for (x, y, z), (px, py, pz), ((a, _, b), (_, c, d)), ((uu, uv), (_, vv)), ((mx,), (my,), (mz,)) in zip(
            local, prior, slopes, spreads, moved, strict=True
        ):
            # The innovation of the linearised measurement at the prior mean.
            u = row.point[0] - x / z - a * (px - x) - b * (pz - z)
            v = row.point[1] - y / z - c * (py - y) - d * (pz - z)
            # The error of the time map moves the point along its image velocity.
            mu, mv = a * mx + b * mz, c * my + d * mz
            nuu, nuv, nvv = (factor * one for one in row.noise)
            nuu, nuv, nvv = nuu + mu * mu, nuv + mu * mv, nvv + mv * mv
            suu, suv, svv = uu + nuu, uv + nuv, vv + nvv
            determinant = suu * svv - suv * suv
            if not determinant > 0.0:
                return None
            iuu, iuv, ivv = svv / determinant, -suv / determinant, suu / determinant
            su, sv = iuu * u + iuv * v, iuv * u + ivv * v
            distance = u * su + v * sv
            inverses.append(((iuu, iuv), (iuv, ivv)))
            solved.append(((su,), (sv,)))
            fits.append(-0.5 * (distance + log(determinant)))
            # E[residual residualᵀ] = R - H P⁺ Hᵀ, here relative to R.
            residual = nuu * su * su + 2.0 * nuv * su * sv + nvv * sv * sv
            excesses.append(0.5 * (residual - nuu * iuu - 2.0 * nuv * iuv - nvv * ivv))
        step_to = (cross @ np.array(solved))[:, :, 0]
        before, local = local, ((mean[:, POSITION] + step_to[:, POSITION] - centre) @ rotation.T).tolist()
        far = max(abs(new[k] - old[k]) / old[2] for new, old in zip(local, before, strict=True) for k in range(3))
        if far < _LINEAR or not min(z for _, _, z in local) > 0.0:
            break
    # The gate of the filter with the largest density: a manoeuvre must not look like an outlier.
    if not distance < _GATE:
        return None
    before, mean = mean, mean + step_to
    if iterations == 1:
        covariance = _with_scale_at(covariance, before, mean, centre)
    covariance -= cross @ np.array(inverses) @ cross.transpose(0, 2, 1)
    return mean, 0.5 * (covariance + covariance.transpose(0, 2, 1)), fits, excesses


def _with_scale_at(covariance: Floats, before: Floats, after: Floats, centre: Floats) -> Floats:
    """Covariances (3, 9, 9) whose uncertain scale about one camera's centre is that of the states ``after`` a row.

    One camera alone cannot tell the scale of the motion about its centre. Where the linearisation moves, the filter
    would learn it nevertheless (Huang, Mourikis, Roumeliotis 2010): so the largest part of the covariance that can be
    that scale's, s² n nᵀ with n = (position - centre, velocity, acceleration), is turned to the new n. A row of the
    camera leaves that part as it is. before, after: (3, 9).
    """
    offset = np.concatenate([centre, np.zeros(STATE_DIM - 3)])
    old, new = before - offset, after - offset
    scale = 1.0 / (old[:, None] @ np.linalg.solve(covariance, old[:, :, None]))
    return np.asarray(covariance + scale * (new[:, :, None] * new[:, None] - old[:, :, None] * old[:, None]))


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
    if state.tried_ns is not None and now < state.tried_ns + _TRY_EVERY_NS:
        return state
    state = replace(state, tried_ns=now)
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
        psd=scaled(_BANK, psd),
        hits=2 * ROWS_PER_CAMERA,
        accepted=dict.fromkeys((other, row.camera.name), row.reference_ns),
        noise={**state.noise, **noise},
        usual_std=position_std(covariance),
        serial=state.serial + 1,
    )


def smooth_states(states: Sequence[MarkerState], wanted: int) -> tuple[Floats, Floats]:
    """The first ``wanted`` smoothed means (n, 9) and covariances (n, 9, 9) of the states of one track, in order.

    Each with the filter whose density is nearest to the likeliest one now.
    """
    psd = np.array([state.psd for state in states])
    member = np.abs(np.log(psd / states[-1].psd[states[-1].best])).argmin(axis=1)
    mean = np.array([state.mean[m] for state, m in zip(states, member, strict=True)])
    covariance = np.array([state.covariance[m] for state, m in zip(states, member, strict=True)])
    time = np.array([state.time_ns - states[-1].time_ns for state in states]) / NANOSECONDS
    return rts_smooth(time, mean, covariance, psd[np.arange(len(states)), member], wanted)


def misfit(pairs: Sequence[tuple[MarkerRow, MarkerState]], change: Similarity | None) -> float:
    """Median squared distance of rows, under a new calibration, from the states after them in a new world frame.

    In variances of the rows. change: from the states' world frame to the calibration's, None = the same frame.
    """
    mean = np.array([state.mean[state.best, POSITION] for _, state in pairs])
    off = []
    for (row, _), place in zip(pairs, mean if change is None else change.points(mean), strict=True):
        x, y, depth = row.camera.pose.rotation @ (place - row.camera.pose.position)
        away = np.hypot(row.point[0] - x / depth, row.point[1] - y / depth) if depth > 0.0 else np.inf
        off.append(float(away**2 / (row.noise[0] + row.noise[2])))
    return float(np.median(off))
