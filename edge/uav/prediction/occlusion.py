"""Where a target that is out of sight may drive: the ways from where it was last seen."""

from __future__ import annotations

import numpy as np

from edge.uav.ground.road_map import RoadMap
from edge.uav.prediction import particle_set as clouds
from edge.uav.prediction import particles as pf
from edge.uav.prediction.driver_model import Driving
from edge.uav.prediction.particle_set import Cloud
from edge.uav.prediction.paths import Way, edges, trace
from edge.uav.target.motion_history import MotionFit
from protocols.geometry.types import Floats

_TRACE_EVERY = 8  # frames
_NUMBER = 400
_ON_WAYS = 0.92  # of the particles, where the target drove on the road
_TURNING, _BRAKED = 0.36, 0.4  # chance of a turn where there is one, and how much more for one who brakes
_TELLING = 1.5  # std of an acceleration that tells something
_BRAKES = -0.7  # acceleration along of one who does [units/s²]
_MADE_OF_ROAD = 0.5  # share of the trail that must be road for ways to count


class Outlook:
    """Made at the first frame without the target; ``ways`` may be empty: then the particles drive freely."""

    def __init__(self, cloud: Cloud, fit: MotionFit | None, time: float, road: RoadMap, trail: Floats) -> None:
        """trail: (m, 2) ground points where the target drove lately."""
        self._since = time
        self._frames = 0
        self.ways: list[Way] = []
        self._place = cloud.weights @ cloud.place
        self._heading = pf.circular_mean(cloud.heading, cloud.weights)
        self._speed = fit.speed if fit is not None else 0.0
        bend = fit.turn_rate / max(fit.speed, 2.0) if fit is not None else 0.0
        self._bend = float(np.clip(bend, -0.12, 0.12))
        # Who brakes before a junction mostly turns there.
        braking = -fit.along if fit is not None and fit.acceleration_std < _TELLING else 0.0
        self._turning = _TURNING + _BRAKED * float(np.clip((braking - 0.5) / 1.5, 0.0, 1.0))
        self._keep = (float("nan"), float("nan"))
        self.on_road = 0.0
        if len(trail) > 3 and self._speed > 1.0 and road.ready:
            road.prepare(self._place, 40.0)
            self.on_road = float(np.mean(road.smooth_at(trail) > 0.2))
            steps = np.gradient(trail, axis=0)
            right, left = edges(road, trail, np.arctan2(steps[:, 1], steps[:, 0]))
            self._keep = _middle(right), _middle(left)

    def begin(
        self,
        cloud: Cloud,
        fit: MotionFit | None,
        time: float,
        road: RoadMap,
        driving: Driving,
        rng: np.random.Generator,
    ) -> Cloud:
        """The cloud that sets out."""
        self.ways = self._trace(road, time)
        if fit is not None:
            cloud = clouds.launched(cloud, fit, time - fit.time, _NUMBER, rng, driving, on_ways=bool(self.ways))
        if not self.ways:
            return cloud
        cloud = clouds.on_ways(cloud, self.ways, _ON_WAYS, rng)
        brakes = fit is not None and fit.along < _BRAKES
        return cloud if brakes else clouds.unhurried(cloud, self.ways[:1])

    def again(self, cloud: Cloud, time: float, road: RoadMap, rng: np.random.Generator) -> Cloud:
        """As more of the road comes into view the ways are traced again, always from the same start."""
        self._frames += 1
        if self._frames % _TRACE_EVERY or not self.ways:
            return cloud
        ways = self._trace(road, time)
        cloud = clouds.rerouted(cloud, self.ways, ways, rng)
        self.ways = ways
        return cloud

    def _trace(self, road: RoadMap, time: float) -> list[Way]:
        if self.on_road < _MADE_OF_ROAD:
            return []
        reach = float(np.clip(self._speed * (3.0 + time - self._since) + 15.0, 30.0, 160.0))
        return trace(road, self._place, self._heading, self._bend, reach, self._keep, self._turning)


def _middle(values: Floats) -> float:
    good = values[np.isfinite(values)]
    return float(np.median(good)) if len(good) >= 3 else float("nan")
