"""Steps of a camera's clock that its images show: rows before them at the times of the clock as it is now.

Live, the map of the newest side is the one in use. A step is (time, size, std) [s]: the camera time from which on the
clock is set forward by ``size``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from protocols.core.clocks import TimeMap
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations, Track

Step = tuple[float, float, float]
SAME_STEP_S = 2.0
"""Steps of one clock closer than this are one step [s]."""


def steps_inside(calibration: Calibration, observations: Observations) -> dict[str, tuple[Step, ...]]:
    """The steps of a calibration's cameras that still have rows on both sides: of another clock there are none."""
    out: dict[str, tuple[Step, ...]] = {}
    for name, camera in calibration.cameras.items():
        tracks = observations.of_camera(name) if camera.clock_steps else []
        inside = tuple(
            step
            for step in camera.clock_steps
            if any(track.time[0] < step[0] for track in tracks) and any(track.time[-1] > step[0] for track in tracks)
        )
        out |= {name: inside} if inside else {}
    return out


def on_newest_clock(observations: Observations, steps: Mapping[str, tuple[Step, ...]]) -> Observations:
    """The observations with the rows before each step at the times that the clock shows since."""
    tracks = {key: _corrected(track, steps.get(key[0], ())) for key, track in observations.tracks.items()}
    return replace(observations, tracks=tracks) if steps else observations


def _corrected(track: Track, steps: tuple[Step, ...]) -> Track:
    if not steps:
        return track
    time = track.time + sum(size * (track.time < at) for at, size, _ in steps)
    order = np.argsort(time, kind="stable")
    order = order[np.diff(time[order], prepend=-np.inf) > 0.0]  # clocks set back show some times twice
    std = None if track.std is None else track.std[order]
    return replace(
        track,
        frame=track.frame[order],
        time=time[order],
        pixels=track.pixels[order],
        size=track.size[order],
        std=std,
    )


def shown_since(steps: Mapping[str, tuple[Step, ...]], camera: str, step: Step) -> float:
    """Time of a step on the corrected clock [s]."""
    return step[0] + sum(size for at, size, _ in steps[camera] if at > step[0])


def with_step_stds(calibration: Calibration) -> Calibration:
    """The calibration with the variance of the corrected steps in that of the maps.

    A map of the newest side rests on rows from before a step as far as its size is known.
    """
    variance = {name: sum(std**2 for *_, std in one.clock_steps) for name, one in calibration.cameras.items()}
    if not any(variance.values()):
        return calibration
    common = variance.get(calibration.reference, 0.0)
    cameras = {
        name: replace(
            one,
            time_offset_std=math.sqrt(one.time_offset_std**2 + variance[name] + common),
            lag_std=math.sqrt(one.lag_std**2 + variance[name] + common),
        )
        if name != calibration.reference
        else one
        for name, one in calibration.cameras.items()
    }
    return replace(calibration, cameras=cameras)


def with_step(steps: Mapping[str, tuple[Step, ...]], camera: str, found: Step) -> dict[str, tuple[Step, ...]]:
    """The steps and one found on the corrected clock; what is left of a known one is added to its size."""
    known = steps.get(camera, ())
    near = [step for step in known if abs(shown_since(steps, camera, step) - found[0]) < SAME_STEP_S]
    if near:
        merged = (near[0][0], near[0][1] + found[1], found[2])
        return {**steps, camera: tuple(merged if step is near[0] else step for step in known)}
    shown = found[0] - sum(size for at, size, _ in known if at > found[0])
    return {**steps, camera: (*known, (shown, *found[1:]))}


def with_clock_set(calibration: Calibration, camera: str, size: float) -> Calibration:
    """The calibration after a camera's clock was set forward by ``size`` [s]."""
    one = calibration.cameras[camera]
    rate, offset = one.time_map.clock_rate, one.time_map.time_offset
    moved = replace(one, time_map=TimeMap(rate, offset - rate * size), lag_time=one.lag_time + size)
    return replace(calibration, cameras={**calibration.cameras, camera: moved})


def on_newest_side(found: Calibration) -> Calibration:
    """The calibration with every map on the newest side of its clock's steps, on the reference clock as it is now.

    found: maps hold on the side of ``lag_time``.
    """
    out = found
    for name, camera in found.cameras.items():
        for at, size, _ in camera.clock_steps:
            if at > camera.lag_time:
                out = with_clock_set(out, name, size)
    base = out.cameras[out.reference].time_map.time_offset if out.reference in out.cameras else 0.0
    if base == 0.0 or out is found:
        return out
    cameras = {
        name: replace(one, time_map=replace(one.time_map, time_offset=one.time_map.time_offset - base))
        for name, one in out.cameras.items()
    }
    trajectories = tuple(replace(table, time=table.time - base) for table in out.trajectories)
    return replace(out, cameras=cameras, trajectories=trajectories)
