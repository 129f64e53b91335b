"""One flight over the simulated town: images, ground truth of every frame, and simulated autopilot telemetry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from edge.uav.base import Box, Telemetry
from edge.uav.world import cars
from edge.uav.world.flight import LEAD_S, Flight
from edge.uav.world.noise import smoothed_noise
from edge.uav.world.rendering import FlightRenderer, Illumination
from edge.uav.world.town import Town
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_NOISE_STREAM, _TELEMETRY_STREAM = 101, 102  # of random numbers, apart from the others
_HEADING_BASELINE = 0.5  # m ahead of the centre: second point from which the heading in the image is computed
_MIN_VISIBLE_SHARE = 0.05  # smallest visible share of another car that is listed in ``others``


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """Ground truth of one frame.

    x, y: the target's centre (0.7 m above the ground) in image pixels, also outside the image. width, height: of the
    upright box around its body [px]. length: of the car along its heading [px].
    heading: atan2(dy, dx) in the image [rad], y down.
    inside: share of its area within the image bounds; visible: share within the image and not occluded, 0 … 1.
    north, east [m], speed [m/s], course = atan2(east, north) [rad]: of the target on the ground.
    camera: the true pose, camera from NED; ned_from_body: (3, 3). others: (n, 2) centres of the other cars that are
    visible at least in part, image pixels.
    """

    frame: int
    time: float
    x: float
    y: float
    width: float
    height: float
    length: float
    heading: float
    inside: float
    visible: float
    north: float
    east: float
    speed: float
    course: float
    camera: Pose
    ned_from_body: Floats
    others: Floats

    @property
    def box(self) -> Box:
        """The upright box about the centre."""
        return Box(self.x - 0.5 * self.width, self.y - 0.5 * self.height, self.width, self.height)


@dataclass(frozen=True, eq=False)
class FlightWorld:
    """A pure function of scenario name, seed, size and frames; get it from ``scenarios.get``.

    flight: the drone's trajectory. target, traffic: the moving cars.
    """

    name: str
    seed: int
    length: int
    fps: float
    lens: Intrinsics
    body_from_camera: Floats
    flight: Flight
    town: Town
    target: cars.Car
    traffic: tuple[cars.Car, ...]
    illumination: Illumination
    noise_std: float = 3.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images [px]."""
        return self.lens.width, self.lens.height

    @cached_property
    def out_of_view(self) -> tuple[int, int]:
        """The longest run of frames without the target in the image: begin, end (exclusive); (0, 0) without one."""
        return longest_run(self.share_in_image == 0.0)

    @cached_property
    def share_in_image(self) -> Floats:
        """Share (n,) of the target's area within the image bounds, frame by frame."""
        rotation, position = self._poses
        return share_in_image(self.lens, rotation, position, self.target)

    def time(self, frame: int) -> float:
        """Time of a frame on the video's clock [s]; frame 0 is at 0."""
        return frame / self.fps

    def target_at(self, time: float) -> tuple[Floats, Floats]:
        """Position and velocity (2,) of the target at any time [s]: north, east [m, m/s]."""
        i = int(np.clip(np.floor(time * self.fps), 0, self.length - 2))
        velocity = (self.target.ground[i + 1] - self.target.ground[i]) * self.fps
        return self.target.ground[i] + (time - self.time(i)) * velocity, velocity

    def frame(self, i: int) -> npt.NDArray[np.uint8]:
        """The image (h, w, 3) BGR of frame ``i``."""
        return self.render(i)

    def render(self, i: int, *, target: bool = True, noise: bool = True) -> npt.NDArray[np.uint8]:
        """The image of frame ``i``, optionally without the target or without sensor noise."""
        self._check(i)
        matrix, position = self._matrix(i), self._poses[1][i]
        moving = (self.target, *self.traffic) if target else self.traffic
        return self._renderer.render(i, matrix, position, moving, noise=noise)

    def render_from(self, i: int, rotation: Floats, position: Floats) -> npt.NDArray[np.uint8]:
        """The image of frame ``i`` from another camera pose: rotation (3, 3) camera from NED, centre (3,) NED [m]."""
        self._check(i)
        matrix = self._projection(rotation, position)
        return self._renderer.render(i, matrix, position, (self.target, *self.traffic))

    def truth(self, i: int) -> GroundTruth:
        """Ground truth of frame ``i``."""
        self._check(i)
        rotation, position = (part[i] for part in self._poses)
        return self.truth_from(i, rotation, position)

    def truth_from(self, i: int, rotation: Floats, position: Floats) -> GroundTruth:
        """Ground truth of frame ``i`` from another camera pose; ned_from_body follows from it and the mounting."""
        matrix = self._projection(rotation, position)
        ground, course = self.target.ground[i], float(self.target.course[i])
        centre = np.array([ground[0], ground[1], -cars.CENTRE_HEIGHT])
        ahead = centre + _HEADING_BASELINE * np.array([np.cos(course), np.sin(course), 0.0])
        (x, y), (x2, y2) = cars.project(matrix, np.array([centre, ahead]))
        corner = cars.project(matrix, cars.hull_points(ground, course))
        width, height = corner.max(axis=0) - corner.min(axis=0)
        points = cars.body_points(ground, course)
        inside = _in_image(self.lens, cars.project(matrix, points))
        seen = inside & ~self.town.occluders.occluded(position, points) if inside.any() else inside
        before, after = max(i - 1, 0), min(i + 1, self.length - 1)
        step = self.target.ground[after] - self.target.ground[before]
        return GroundTruth(
            frame=i,
            time=self.time(i),
            x=float(x),
            y=float(y),
            width=float(width),
            height=float(height),
            length=float(np.hypot(x2 - x, y2 - y)) * cars.LENGTH / _HEADING_BASELINE,
            heading=float(np.arctan2(y2 - y, x2 - x)),
            inside=float(inside.mean()),
            visible=float(seen.mean()),
            north=float(ground[0]),
            east=float(ground[1]),
            speed=float(np.linalg.norm(step)) * self.fps / (after - before),
            course=float(np.arctan2(np.sin(course), np.cos(course))),
            camera=Pose(rotation, position),
            ned_from_body=rotation.T @ self.body_from_camera.T,
            others=self._others(i, matrix, position),
        )

    def telemetry(
        self,
        rate_hz: float = 30.0,
        *,
        time_offset: float | None = 0.0,
        latency_s: float | None = None,
        attitude_noise_deg: float = 0.2,
        attitude_bias_deg: float = 0.4,
        position_std: float = 0.3,
        with_position: bool = True,
    ) -> list[Telemetry]:
        """Simulated autopilot samples from 1.5 s before the first frame to the last one, in the order of time.

        A sample that is stamped t + time_offset arrives at the video's time t and reports attitude and position of
        t − latency_s (default: one frame). time_offset: None draws one within ±0.5 s, see ``time_offset``.
        attitude_noise_deg: std per rotation axis, white; attitude_bias_deg: angle of a constant rotation, in body
        axes. position_std: std per coordinate of a correlated error, correlation time about 4 s [m].
        """
        rng = np.random.default_rng([self.seed, _TELEMETRY_STREAM])
        offset = self.time_offset if time_offset is None else time_offset
        late = 1.0 / self.fps if latency_s is None else latency_s
        times = np.arange(-LEAD_S + 0.5 + rng.uniform(0.0, 1.0) / rate_hz, self.time(self.length - 1), 1.0 / rate_hz)
        axis = rng.standard_normal(3)
        bias = np.deg2rad(attitude_bias_deg) * axis / np.linalg.norm(axis)
        error = bias + np.deg2rad(attitude_noise_deg) * rng.standard_normal((len(times), 3))
        shift = np.column_stack([smoothed_noise(rng, len(times), 1.0 / rate_hz, position_std, 2.5) for _ in range(3)])
        attitude, position = self.flight.at(times - late)
        attitude = attitude @ so3.exp(error)
        return [
            Telemetry(float(t) + offset, attitude[k], position[k] + shift[k] if with_position else None)
            for k, t in enumerate(times)
        ]

    @cached_property
    def time_offset(self) -> float:
        """Constant offset of the telemetry clock [s], drawn for this seed within ±0.5 s."""
        return float(np.random.default_rng([self.seed, _TELEMETRY_STREAM, 1]).uniform(-0.5, 0.5))

    def _check(self, i: int) -> None:
        if not 0 <= i < self.length:
            raise IndexError(f"frame {i} of {self.length}")

    @cached_property
    def _renderer(self) -> FlightRenderer:
        rng = np.random.default_rng([self.seed, _NOISE_STREAM])
        return FlightRenderer(self.town, self.lens, self.illumination, rng, fps=self.fps, noise_std=self.noise_std)

    @cached_property
    def _poses(self) -> tuple[Floats, Floats]:
        """camera_from_ned (n, 3, 3) and position (n, 3) of all frames."""
        return camera_poses(self.flight, self.body_from_camera, np.arange(self.length) / self.fps)

    def _matrix(self, i: int) -> Floats:
        """Projection (3, 4), pixels from NED."""
        return self._projection(*(part[i] for part in self._poses))

    def _projection(self, rotation: Floats, position: Floats) -> Floats:
        return np.asarray(self.lens.matrix @ np.column_stack([rotation, -rotation @ position]))

    def _others(self, i: int, matrix: Floats, position: Floats) -> Floats:
        placements = [(car.ground[i], float(car.course[i])) for car in self.traffic]
        placements += [(car.ground[0], float(car.course[0])) for car in self.town.parked]
        out = []
        for ground, course in placements:
            pixel = cars.project(matrix, np.array([[ground[0], ground[1], -cars.CENTRE_HEIGHT]]))[0]
            if not (-50 < pixel[0] < self.lens.width + 50 and -50 < pixel[1] < self.lens.height + 50):
                continue
            points = cars.body_points(ground, course)
            seen = _in_image(self.lens, cars.project(matrix, points))
            seen &= ~self.town.occluders.occluded(position, points)
            if seen.mean() > _MIN_VISIBLE_SHARE:
                out.append(pixel)
        return np.array(out).reshape(-1, 2)


def camera_poses(flight: Flight, body_from_camera: Floats, times: Floats) -> tuple[Floats, Floats]:
    """camera_from_ned (n, 3, 3) and position (n, 3) NED [m] at ``times`` (n,)."""
    ned_from_body, position = flight.at(times)
    return np.asarray(np.swapaxes(ned_from_body @ body_from_camera, 1, 2)), position


def share_in_image(lens: Intrinsics, rotation: Floats, position: Floats, car: cars.Car) -> Floats:
    """Share (n,) of a car's area within the image bounds. rotation: (n, 3, 3) camera from NED; position: (n, 3)."""
    points = cars.body_points_batch(car.ground, car.course)
    seen = np.einsum("nij,nkj->nki", lens.matrix @ rotation, points - position[:, None])
    pixels = (seen[..., :2] / seen[..., 2:]).reshape(-1, 2)
    inside = _in_image(lens, pixels) & (seen[..., 2].ravel() > 0)
    return np.asarray(inside.reshape(seen.shape[:2]).mean(axis=1))


def longest_run(mask: npt.NDArray[np.bool_]) -> tuple[int, int]:
    """Begin and end (not included) of the longest run of True; (0, 0) where there is none."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    begins, ends = edges[::2], edges[1::2]
    if not len(begins):
        return 0, 0
    k = int(np.argmax(ends - begins))
    return int(begins[k]), int(ends[k])


def _in_image(lens: Intrinsics, pixels: Floats) -> npt.NDArray[np.bool_]:
    x, y = pixels[:, 0], pixels[:, 1]
    return np.asarray((x > -0.5) & (x < lens.width - 0.5) & (y > -0.5) & (y < lens.height - 0.5))
