"""Where a car would be detected: inside the image, and on open road rather than behind what hides it."""

from __future__ import annotations

import numpy as np

from edge.uav.ground import colour_table
from edge.uav.ground.localisation import CameraLocaliser
from edge.uav.ground.road_map import RoadMap
from edge.uav.prediction.particle_set import ParticleSet
from protocols.geometry import kernels
from protocols.geometry.types import Floats, Image, Ints

_DETECTION_PROBABILITIES = (0.03, 0.03, 0.1, 0.3)  # per frame, with 0 to 3 of the car's test points on open road
_OPEN_ROAD = -0.3  # log-likelihood ratio of its colour above which a point is open road
_END_OFFSET = 0.35  # of the outer test points from the centre, over the length


def detection_probability(
    working: Image, localiser: CameraLocaliser, road: RoadMap, pixels: Floats, particles: ParticleSet, length: float
) -> Floats:
    """(n,) probability of detecting the target at the particles: 0 outside the image, small where occluded.

    pixels: (n, 2) image points of the particles; length: of the target. It is detectable where all is on open road.
    """
    inside = localiser.plane.inside(pixels, 2.0)
    out = np.zeros(len(pixels))
    if not inside.any() or localiser.frames_without_pose or not road.has_colour_model:
        return np.where(inside & (localiser.frames_without_pose == 0), _DETECTION_PROBABILITIES[0], 0.0)
    counts = open_road(working, localiser, road, particles.position[inside], particles.heading[inside], length)
    out[inside] = np.array(_DETECTION_PROBABILITIES)[counts]
    return out


def open_road(
    working: Image, localiser: CameraLocaliser, road: RoadMap, positions: Floats, headings: Floats, length: float
) -> Ints:
    """How many (n,) of a car's middle and ends are on open road, of cars at positions (n, 2) with headings (n,)."""
    reach = _END_OFFSET * length
    if localiser.plane.compiled:
        counts, camera = np.empty(len(positions), np.int64), localiser.plane.kernel_arguments(localiser.matrix)
        image = localiser.downscale, *working.shape[:2], np.ascontiguousarray(working), localiser.photometric.table
        colours = *road.colour_table, _OPEN_ROAD
        kernels.call("open_road", *camera, len(counts), positions, headings, reach, *image, *colours, counts)
        return counts
    half_length = reach * np.column_stack([np.cos(headings), np.sin(headings)])
    points = np.concatenate([positions, positions - half_length, positions + half_length])
    last_pixel = np.array([working.shape[1] - 1, working.shape[0] - 1])
    ground = np.fmax(localiser.pixels(points), -1.0)  # not a number behind the camera
    at = np.clip((ground / localiser.downscale).astype(int), 0, last_pixel)
    corrected = localiser.photometric.corrected(working[at[:, 1], at[:, 0]][None])[0]
    bits, table = road.colour_table
    on_road = colour_table.values(table, corrected, bits) > _OPEN_ROAD
    return np.asarray(on_road.reshape(3, -1).sum(axis=0), dtype=np.int64)
