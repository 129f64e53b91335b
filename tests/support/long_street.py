"""A street of any number of cameras, each of which overlaps some ten others; labelled targets shuttle along it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.scenes.common.base import look_at_pose
from hub.clocks.external_prior import ExternalClockPrior
from protocols.core.clocks import TimeMap
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera
from tests.support.rigs import SIZE, random_lens

_SPACING_M, _REACH_M, _STRETCH_M = 2.0, 12.0, 20.0
"""Between two masts, alternately on both sides; how far along the street one sees; what one target is at home in."""


def street(
    seed: int,
    cameras: int,
    seconds: float,
    fps: float = 30.0,
    delay: float = 0.05,
    reach: float = _REACH_M,
    stretch: float = _STRETCH_M,
) -> tuple[Rig, Observations, dict[str, ExternalClockPrior], dict[str, Pose], dict[str, TimeMap]]:
    """Rig, rows, priors by times of arrival (up to ``delay`` off), true poses and clocks, a function of the arguments.

    reach: how far along the street a camera sees; stretch: what a target is at home in [m]: where both are short, a
    camera always sees some targets move, and a film of a few seconds is enough.
    """
    rng = np.random.default_rng(seed)
    length = _SPACING_M * cameras
    homes = np.arange(0.5 * stretch, length + 0.5 * stretch, 0.5 * stretch)
    phases = rng.uniform(0, 2 * np.pi, (len(homes), 6))
    table, poses, clocks, arrivals = {}, {}, {}, {}
    rows: tuple[list[str], list[str], list[Floats], list[Floats], list[Floats]] = [], [], [], [], []

    def position(target: int, time: Floats) -> Floats:
        a, b, c, d, e, f = phases[target]
        along = homes[target] + 0.5 * stretch * np.sin(0.25 * time + a) + 1.5 * np.sin(1.3 * time + b)
        across = 2.0 * np.sin(0.9 * time + c) + 0.7 * np.sin(2.1 * time + d)
        return np.column_stack([along, across, 1.5 + 0.8 * np.sin(1.1 * time + e) + 0.4 * np.sin(2.7 * time + f)])

    for number in range(cameras):
        name, place = f"cam{number}", _SPACING_M * number
        at = np.array([place, (-1) ** number * rng.uniform(9.0, 12.0), rng.uniform(3.0, 5.0)])
        poses[name] = look_at_pose(at, np.array([place + rng.uniform(-3, 3), 0.0, 1.5]))
        table[name] = RigCamera(name, SIZE, fps, replace(random_lens(rng), distortions=np.zeros(5)))
        rate, epoch = 1.0 + 1e-6 * rng.uniform(-50, 50), float(rng.uniform(0, 1e5))
        true = rng.uniform(0, 1 / fps) + np.arange(int(seconds * fps)) / fps
        own = epoch + rate * true
        clocks[name] = TimeMap(1.0 / rate, -epoch / rate)
        arrivals[name] = ExternalClockPrior("", -epoch + float(rng.uniform(0, delay)), 0.15)
        for target in np.flatnonzero(np.abs(homes - place) < reach + 0.5 * stretch):
            points = position(int(target), true)
            lens = table[name].intrinsics
            assert lens is not None
            pixels = lens.project(poses[name].camera_from_world(points)) + rng.normal(0, 0.4, (len(true), 2))
            with np.errstate(invalid="ignore"):
                inside = ((pixels >= 0) & (pixels < SIZE)).all(axis=1) & (np.abs(points[:, 0] - place) < reach)
            count = int(inside.sum())
            rows[0].extend([name] * count)
            rows[1].extend([f"target{target}"] * count)
            for values, kept in zip(rows[2:], (np.flatnonzero(inside), own[inside], pixels[inside]), strict=True):
                values.append(kept)
    frame, time, seen = (np.concatenate(values) for values in rows[2:])
    found = gather_tracks(rows[0], rows[1], frame, time, seen, np.full(len(time), np.nan))
    return Rig(table), found, arrivals, poses, clocks
