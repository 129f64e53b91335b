"""Town layout: buildings, trees and parked cars along given roads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.world import occluders
from edge.uav.world.cars import COLOURS_BGR, Car
from edge.uav.world.ground_texture import Area, GroundTexture, paint_ground
from edge.uav.world.occluders import Occluder, Occluders
from edge.uav.world.roads import Curve, Road
from protocols.geometry.types import Floats

_CELL = 1.0  # m: cell size of the distance map
_PARKED_SHARE = 0.22  # of the parking places
_PARKING_OFFSET = 4.7  # m from the centre line of the road


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """All static objects. parked: cars that never move (one frame each)."""

    ground: GroundTexture
    occluders: Occluders
    parked: tuple[Car, ...]


class _DistanceMap:
    """Distance of points from the nearest of several curves, by a distance transform with 1 m cells."""

    def __init__(self, area: Area, curves: Sequence[Curve]) -> None:
        self._origin = np.array([area.north[0], area.east[0]])
        shape = np.ceil(np.array([np.diff(area.north)[0], np.diff(area.east)[0]]) / _CELL).astype(int) + 1
        free = np.full(tuple(shape), 255, np.uint8)
        for curve in curves:
            cells = np.rint((curve.points - self._origin) / _CELL).astype(np.int32)
            cv2.polylines(free, [cells[:, ::-1].reshape(-1, 1, 2)], False, 0, 1)
        self._map = np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5)) * _CELL
        if not curves:
            self._map[:] = np.inf

    def at(self, points: Floats) -> Floats:
        cells = np.rint((points - self._origin) / _CELL).astype(int)
        limit = np.array(self._map.shape) - 1
        return np.asarray(self._map[tuple(np.clip(cells, 0, limit).T)], np.float64)


def build_town(
    rng: np.random.Generator,
    area: Area,
    roads: Sequence[Road],
    *,
    scenario_occluders: Sequence[Occluder] = (),
    keep_clear: Sequence[Curve] = (),
    not_colour: str = "",
    sight_lines: Sequence[tuple[Floats, Floats]] = (),
) -> Town:
    """Place buildings, trees and parked cars at random, and paint the ground.

    scenario_occluders: given by the scenario. keep_clear: off-road paths that nothing may block.
    not_colour: a colour that no parked car has.
    sight_lines: pairs of a camera (3,) and points of a car (n, 3) NED that no building or tree may occlude.
    """
    place = _Placement(
        rng, area, roads, _DistanceMap(area, [road.centre for road in roads]), _DistanceMap(area, keep_clear)
    )
    houses = place.buildings(scenario_occluders)
    trees = place.trees(houses)
    houses = [house for house in houses if not _blocks_view(house, sight_lines)]
    trees = [tree for tree in trees if not _blocks_view(tree, sight_lines)]
    parked = place.parked(not_colour)
    yards = [_yard(house) for house in houses if rng.random() < 0.7]
    everything: list[Occluder] = [*houses, *scenario_occluders, *trees]
    ground = paint_ground(rng, area, roads, yards, [occluder.shadow() for occluder in everything])
    return Town(ground, Occluders.of(everything), tuple(parked))


@dataclass(frozen=True, slots=True, eq=False)
class _Placement:
    """Places objects at random, none too near to a road or to what has to stay clear."""

    rng: np.random.Generator
    area: Area
    roads: Sequence[Road]
    road_distance: _DistanceMap
    clearance: _DistanceMap

    def buildings(self, others: Sequence[Occluder]) -> list[occluders.Building]:
        rng, out = self.rng, list[occluders.Building]()
        for _ in range(int(self.area.size / 110.0)):
            if len(out) >= self.area.size / 620.0:
                break
            centre = np.array([rng.uniform(*self.area.north), rng.uniform(*self.area.east)])
            length, width = rng.uniform(8.0, 17.0), rng.uniform(7.0, 11.0)
            radius = 0.5 * float(np.hypot(length, width))
            free = float(self.road_distance.at(centre[None])[0])
            if not radius + 5.5 < free < 40.0 or self.clearance.at(centre[None])[0] < radius + 7.0:
                continue
            if any(np.linalg.norm(centre - o.centre) < radius + o.bounding_radius + 2.0 for o in (*out, *others)):
                continue
            course = _along(self.roads, centre)
            out.append(occluders.random_building(rng, centre, course, length, width, rng.uniform(3.0, 8.0)))
        return out

    def trees(self, houses: Sequence[occluders.Building]) -> list[occluders.FlatOccluder]:
        rng, out = self.rng, list[occluders.FlatOccluder]()
        for _ in range(int(self.area.size / 170.0)):
            centre = np.array([rng.uniform(*self.area.north), rng.uniform(*self.area.east)])
            radius = rng.uniform(1.4, 3.3)
            at = centre[None]
            if self.road_distance.at(at)[0] < radius + 6.3 or self.clearance.at(at)[0] < radius + 4.0:
                continue
            if any(np.linalg.norm(centre - house.centre) < 0.7 * house.bounding_radius + radius for house in houses):
                continue
            out.append(occluders.random_canopy(rng, centre, radius, rng.uniform(3.0, 5.5)))
        return sorted(out, key=lambda tree: tree.height)

    def parked(self, not_colour: str) -> list[Car]:
        names = [name for name in COLOURS_BGR if name != not_colour]
        rng, out = self.rng, list[Car]()
        for number, road in enumerate(self.roads):
            crossing = [other.centre for k, other in enumerate(self.roads) if k != number]
            for s in np.arange(road.centre.begin + 5.0, road.centre.end - 5.0, 7.5):
                for side in (-1.0, 1.0):
                    if rng.random() > _PARKED_SHARE:
                        continue
                    place, course = road.centre.at(np.array([s + rng.uniform(-0.8, 0.8)]), side * _PARKING_OFFSET)
                    near = any(other.distance(place)[0] < 11.0 for other in crossing)
                    if near or not self.area.contains(place)[0] or self.clearance.at(place)[0] < 5.0:
                        continue
                    turned = course + rng.normal(0.0, 0.03) + (np.pi if side < 0 else 0.0)
                    out.append(Car(place, turned, COLOURS_BGR[names[int(rng.integers(len(names)))]]))
        return out


def _blocks_view(occluder: Occluder, sight_lines: Sequence[tuple[Floats, Floats]]) -> bool:
    return any(bool(occluder.occludes(camera, points).any()) for camera, points in sight_lines)


def _along(roads: Sequence[Road], point: Floats) -> float:
    """Course [rad] of the nearest road."""
    best, course = np.inf, 0.0
    for road in roads:
        gap = np.linalg.norm(road.centre.points - point, axis=1)
        if gap.min() < best:
            best, course = float(gap.min()), float(road.centre.course[int(gap.argmin())])
    return course


def _yard(house: occluders.Building) -> Floats:
    unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    c, s = np.cos(house.roof.course), np.sin(house.roof.course)
    return np.asarray((unit * (house.half + 2.2)) @ np.array([[c, s], [-s, c]]) + house.centre)
