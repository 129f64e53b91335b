"""What stands where in the town: buildings, trees, parked cars along given roads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.world import occluders
from edge.uav.world.cars import COLOURS_BGR, Car
from edge.uav.world.ground import Area, Ground, paint
from edge.uav.world.occluders import Solid, Solids
from edge.uav.world.roads import Curve, Road
from protocols.geometry.types import Floats

_CELL = 1.0  # metres, of the map of distances
_PARKED_AT = 4.7  # metres from the middle of the road


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """All that stands still. parked: cars that never move (one frame each)."""

    ground: Ground
    occluders: Solids
    parked: tuple[Car, ...]


class _Distance:
    """Distance of points from the nearest of several curves, by a map of 1 m cells."""

    def __init__(self, area: Area, curves: Sequence[Curve]) -> None:
        self._origin = np.array([area.north[0], area.east[0]])
        shape = np.ceil(np.array([np.diff(area.north)[0], np.diff(area.east)[0]]) / _CELL).astype(int) + 1
        free = np.full(tuple(shape), 255, np.uint8)
        for curve in curves:
            cells = np.rint((curve.points - self._origin) / _CELL).astype(np.int32)
            cv2.polylines(free, [cells[:, ::-1].reshape(-1, 1, 2)], False, 0, 1)
        self._map = np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5)) * _CELL

    def at(self, points: Floats) -> Floats:
        cells = np.rint((points - self._origin) / _CELL).astype(int)
        limit = np.array(self._map.shape) - 1
        return np.asarray(self._map[tuple(np.clip(cells, 0, limit).T)], np.float64)


def build(
    rng: np.random.Generator,
    area: Area,
    roads: Sequence[Road],
    *,
    special: Sequence[Solid] = (),
    keep_clear: Sequence[Curve] = (),
    not_colour: str = "",
    parked_share: float = 0.22,
    in_sight: Sequence[tuple[Floats, Floats]] = (),
) -> Town:
    """Furnish the town.

    special: solids that the scenario wants. keep_clear: ways off the road that nothing may block.
    not_colour: a colour that no parked car has. parked_share: of the places for parking that are taken.
    in_sight: pairs of a camera (3,) and points of a car (n, 3) NED that no house or tree may stand between.
    """
    away = _Distance(area, [road.centre for road in roads])
    clear = _Distance(area, keep_clear) if keep_clear else None
    houses = _buildings(rng, area, roads, away, clear, special)
    trees = _trees(rng, area, houses, away, clear)
    houses = [house for house in houses if not _between(house, in_sight)]
    trees = [tree for tree in trees if not _between(tree, in_sight)]
    parked = _parked(rng, area, roads, clear, not_colour, parked_share)
    yards = [_yard(house) for house in houses if rng.random() < 0.7]
    everything: list[Solid] = [*houses, *special, *trees]
    ground = paint(rng, area, roads, yards, [solid.shadow() for solid in everything])
    return Town(ground, Solids.of(everything), tuple(parked))


def _buildings(
    rng: np.random.Generator,
    area: Area,
    roads: Sequence[Road],
    away: _Distance,
    clear: _Distance | None,
    special: Sequence[Solid],
) -> list[occluders.Building]:
    out: list[occluders.Building] = []
    for _ in range(int(area.size / 110.0)):
        if len(out) >= area.size / 620.0:
            break
        centre = np.array([rng.uniform(*area.north), rng.uniform(*area.east)])
        length, width = rng.uniform(8.0, 17.0), rng.uniform(7.0, 11.0)
        reach = 0.5 * float(np.hypot(length, width))
        free = float(away.at(centre[None])[0])
        if not reach + 5.5 < free < 40.0 or (clear is not None and clear.at(centre[None])[0] < reach + 7.0):
            continue
        if any(np.linalg.norm(centre - other.centre) < reach + other.reach + 2.0 for other in (*out, *special)):
            continue
        out.append(occluders.building(rng, centre, _along(roads, centre), length, width, rng.uniform(3.0, 8.0)))
    return out


def _trees(
    rng: np.random.Generator,
    area: Area,
    houses: Sequence[occluders.Building],
    away: _Distance,
    clear: _Distance | None,
) -> list[occluders.Slab]:
    out: list[occluders.Slab] = []
    for _ in range(int(area.size / 170.0)):
        centre = np.array([rng.uniform(*area.north), rng.uniform(*area.east)])
        radius = rng.uniform(1.4, 3.3)
        if away.at(centre[None])[0] < radius + 6.3 or (clear is not None and clear.at(centre[None])[0] < radius + 4.0):
            continue
        if any(np.linalg.norm(centre - house.centre) < 0.7 * house.reach + radius for house in houses):
            continue
        out.append(occluders.canopy(rng, centre, radius, rng.uniform(3.0, 5.5)))
    return sorted(out, key=lambda tree: tree.height)


def _parked(
    rng: np.random.Generator,
    area: Area,
    roads: Sequence[Road],
    clear: _Distance | None,
    not_colour: str,
    share: float,
) -> list[Car]:
    names = [name for name in COLOURS_BGR if name != not_colour]
    out: list[Car] = []
    for number, road in enumerate(roads):
        crossing = [other.centre for k, other in enumerate(roads) if k != number]
        for s in np.arange(road.centre.begin + 5.0, road.centre.end - 5.0, 7.5):
            for side in (-1.0, 1.0):
                if rng.random() > share:
                    continue
                place, course = road.centre.at(np.array([s + rng.uniform(-0.8, 0.8)]), side * _PARKED_AT)
                near = any(other.distance(place)[0] < 11.0 for other in crossing)
                if near or not area.contains(place)[0] or (clear is not None and clear.at(place)[0] < 5.0):
                    continue
                turned = course + rng.normal(0.0, 0.03) + (np.pi if side < 0 else 0.0)
                out.append(Car(place, turned, COLOURS_BGR[names[int(rng.integers(len(names)))]]))
    return out


def _between(solid: Solid, in_sight: Sequence[tuple[Floats, Floats]]) -> bool:
    return any(bool(solid.hides(camera, points).any()) for camera, points in in_sight)


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
