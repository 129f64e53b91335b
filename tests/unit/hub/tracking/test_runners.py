"""People who run when they are first seen, in frames that all cameras take at once."""

from __future__ import annotations

import numpy as np
import pytest

from deploy.evaluation.tracking_scores import score_tracks
from hub.tracking.offline import follow
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats
from tests.bench import hall


def race(speed: float) -> hall.Hall:
    """Six runners [m/s] in lanes of 1.22 m, before six cameras at 10 frames a second."""

    def run(rng: np.random.Generator, people: int, seconds: float, half: float) -> Floats:
        time = np.arange(round((seconds + 1.0) * hall.STEPS_HZ)) / hall.STEPS_HZ
        along = time[:, None] * rng.normal(speed, 0.3, people) - half
        return np.stack([along, np.broadcast_to(1.22 * (np.arange(people) - 2.5), along.shape)], axis=2)

    return hall.simulated(3, cameras=6, people=6, seconds=2.0 * 9.0 / speed, half=9.0, move=run)


@pytest.mark.parametrize(("speed", "most"), [(2.0, 6), (8.0, 12)])
def test_runners_are_followed_from_their_first_frames_on(speed: float, most: int) -> None:
    known = race(speed)
    wanted = [round(moment * NANOSECONDS) for moment in known.times]
    tracks = follow([message for _, message in known.messages], known.calibration, wanted, up=hall.UP).tracks
    scores = score_tracks(known.truth, tracks, known.times, 1.0)
    assert 6 <= float(scores["tracks"] or 0) <= most
    assert float(scores["mota"] or 0.0) > 0.9
