"""One flight over the simulated town: its pictures, the truth about every frame, and the autopilot's telemetry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from edge.uav.tracker import Box, Telemetry
from edge.uav.world import cars
from edge.uav.world.flight import LEAD_S, Flight
from edge.uav.world.noise import wander
from edge.uav.world.rendering import Light, Renderer
from edge.uav.world.town import Town
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_NOISE_STREAM, _TELEMETRY_STREAM = 101, 102
_AHEAD = 0.5  # metres before the centre, to see which way the car points
_NEARLY = 0.05  # share of a car that says "seen" for the other cars


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The truth about one frame.

    x, y: the target's centre (0.7 m above the ground) in image pixels, also outside the image. width, height: of the
    upright box around its body [px]. length: of the car along its heading [px].
    heading: atan2(dy, dx) in the image [rad], y down.
    inside: share of it that lies in the picture; visible: share that is seen: in the picture and not hidden, 0 … 1.
    north, east [m], speed [m/s], course = atan2(east, north) [rad]: of the target on the ground.
    camera: the true pose, camera from NED; ned_from_body: (3, 3). others: (n, 2) centres of the other cars that are
    seen at least in part, image pixels.
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
class World:
    """A pure function of scenario name, seed, size and frames; get it from ``scenarios.get``.

    flight: the drone's. target, traffic: the moving cars. out: the longest run of frames, from … to, end not
    included, in which no part of the target is in the picture; (0, 0) where there is none.
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
    light: Light
    noise_std: float = 3.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [px]."""
        return self.lens.width, self.lens.height

    @cached_property
    def out(self) -> tuple[int, int]:
        return longest_run(self.inside_share == 0.0)

    @cached_property
    def inside_share(self) -> Floats:
        """Share of the target that lies in the picture (n,), frame by frame."""
        rotation, position = self._poses
        return inside_share(self.lens, rotation, position, self.target)

    def time(self, frame: int) -> float:
        """Of a frame on the video's clock [s]; frame 0 is at 0."""
        return frame / self.fps

    def target_at(self, time: float) -> tuple[Floats, Floats]:
        """Place and velocity (2,) of the target at any moment [s]: north, east [m, m/s]."""
        i = int(np.clip(np.floor(time * self.fps), 0, self.length - 2))
        velocity = (self.target.ground[i + 1] - self.target.ground[i]) * self.fps
        return self.target.ground[i] + (time - self.time(i)) * velocity, velocity

    def frame(self, i: int) -> npt.NDArray[np.uint8]:
        """The picture (h, w, 3) BGR of frame ``i``."""
        return self.draw(i)

    def draw(self, i: int, *, target: bool = True, noise: bool = True) -> npt.NDArray[np.uint8]:
        """The picture of frame ``i``, if wanted without the target or the sensor's noise."""
        self._check(i)
        matrix, position = self._matrix(i), self._poses[1][i]
        moving = (self.target, *self.traffic) if target else self.traffic
        return self._renderer.draw(i, matrix, position, moving, noise=noise)

    def draw_from(self, i: int, rotation: Floats, position: Floats) -> npt.NDArray[np.uint8]:
        """The picture of frame ``i`` from another place: rotation (3, 3) camera from NED, centre (3,) NED [m]."""
        self._check(i)
        matrix = self._projection(rotation, position)
        return self._renderer.draw(i, matrix, position, (self.target, *self.traffic))

    def truth(self, i: int) -> Truth:
        """The truth about frame ``i``."""
        self._check(i)
        rotation, position = (part[i] for part in self._poses)
        return self.truth_from(i, rotation, position)

    def truth_from(self, i: int, rotation: Floats, position: Floats) -> Truth:
        """The truth about frame ``i`` as seen from another place; ned_from_body is that of a camera so mounted."""
        matrix = self._projection(rotation, position)
        ground, course = self.target.ground[i], float(self.target.course[i])
        centre = np.array([ground[0], ground[1], -cars.MIDDLE_HEIGHT])
        ahead = centre + _AHEAD * np.array([np.cos(course), np.sin(course), 0.0])
        (x, y), (x2, y2) = _project(matrix, np.array([centre, ahead]))
        corner = _project(matrix, cars.corners(ground, course))
        width, height = corner.max(axis=0) - corner.min(axis=0)
        points = cars.grid(ground, course)
        inside = _in_picture(self.lens, _project(matrix, points))
        seen = inside & ~self.town.occluders.hide(position, points) if inside.any() else inside
        before, after = max(i - 1, 0), min(i + 1, self.length - 1)
        step = self.target.ground[after] - self.target.ground[before]
        return Truth(
            frame=i,
            time=self.time(i),
            x=float(x),
            y=float(y),
            width=float(width),
            height=float(height),
            length=float(np.hypot(x2 - x, y2 - y)) * cars.LENGTH / _AHEAD,
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
        late_s: float | None = None,
        attitude_noise_deg: float = 0.2,
        attitude_bias_deg: float = 0.4,
        position_std: float = 0.3,
        with_position: bool = True,
    ) -> list[Telemetry]:
        """The autopilot's samples from 1.5 s before the first frame to the last one, in the order of time.

        A sample that is stamped t + time_offset arrives at the video's time t and tells attitude and position of
        t − late_s (default: one frame). time_offset: None draws one within ±0.5 s, see ``time_offset``.
        attitude_noise_deg: std a rotation axis, white; attitude_bias_deg: length of a constant rotation, in body
        axes. position_std: std a coordinate of an error that wanders within about 4 s [m].
        """
        rng = np.random.default_rng([self.seed, _TELEMETRY_STREAM])
        offset = self.time_offset if time_offset is None else time_offset
        late = 1.0 / self.fps if late_s is None else late_s
        times = np.arange(-LEAD_S + 0.5 + rng.uniform(0.0, 1.0) / rate_hz, self.time(self.length - 1), 1.0 / rate_hz)
        axis = rng.standard_normal(3)
        bias = np.deg2rad(attitude_bias_deg) * axis / np.linalg.norm(axis)
        error = bias + np.deg2rad(attitude_noise_deg) * rng.standard_normal((len(times), 3))
        shift = np.column_stack([wander(rng, len(times), 1.0 / rate_hz, position_std, 2.5) for _ in range(3)])
        attitude, position = self.flight.at(times - late)
        attitude = attitude @ so3.exp(error)
        return [
            Telemetry(float(t) + offset, attitude[k], position[k] + shift[k] if with_position else None)
            for k, t in enumerate(times)
        ]

    @cached_property
    def time_offset(self) -> float:
        """A constant offset of the telemetry's clock for this seed, within ±0.5 s."""
        return float(np.random.default_rng([self.seed, _TELEMETRY_STREAM, 1]).uniform(-0.5, 0.5))

    def _check(self, i: int) -> None:
        if not 0 <= i < self.length:
            raise IndexError(f"frame {i} of {self.length}")

    @cached_property
    def _renderer(self) -> Renderer:
        rng = np.random.default_rng([self.seed, _NOISE_STREAM])
        return Renderer(self.town, self.lens, self.light, rng, fps=self.fps, noise_std=self.noise_std)

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
        ways = [(car.ground[i], float(car.course[i])) for car in self.traffic]
        ways += [(car.ground[0], float(car.course[0])) for car in self.town.parked]
        out = []
        for ground, course in ways:
            pixel = _project(matrix, np.array([[ground[0], ground[1], -cars.MIDDLE_HEIGHT]]))[0]
            if not (-50 < pixel[0] < self.lens.width + 50 and -50 < pixel[1] < self.lens.height + 50):
                continue
            points = cars.grid(ground, course)
            seen = _in_picture(self.lens, _project(matrix, points))
            seen &= ~self.town.occluders.hide(position, points)
            if seen.mean() > _NEARLY:
                out.append(pixel)
        return np.array(out).reshape(-1, 2)


def camera_poses(flight: Flight, body_from_camera: Floats, times: Floats) -> tuple[Floats, Floats]:
    """camera_from_ned (n, 3, 3) and position (n, 3) NED [m] at ``times`` (n,)."""
    ned_from_body, position = flight.at(times)
    return np.asarray(np.swapaxes(ned_from_body @ body_from_camera, 1, 2)), position


def inside_share(lens: Intrinsics, rotation: Floats, position: Floats, car: cars.Car) -> Floats:
    """Share (n,) of a car that lies in the picture. rotation: (n, 3, 3) camera from NED; position: (n, 3)."""
    points = cars.grids(car.ground, car.course)
    seen = np.einsum("nij,nkj->nki", lens.matrix @ rotation, points - position[:, None])
    pixels = (seen[..., :2] / seen[..., 2:]).reshape(-1, 2)
    inside = _in_picture(lens, pixels) & (seen[..., 2].ravel() > 0)
    return np.asarray(inside.reshape(seen.shape[:2]).mean(axis=1))


def longest_run(mask: npt.NDArray[np.bool_]) -> tuple[int, int]:
    """Begin and end (not included) of the longest run of True; (0, 0) where there is none."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    begins, ends = edges[::2], edges[1::2]
    if not len(begins):
        return 0, 0
    k = int(np.argmax(ends - begins))
    return int(begins[k]), int(ends[k])


def _project(matrix: Floats, points: Floats) -> Floats:
    seen = points @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(seen[:, :2] / seen[:, 2:])


def _in_picture(lens: Intrinsics, pixels: Floats) -> npt.NDArray[np.bool_]:
    x, y = pixels[:, 0], pixels[:, 1]
    return np.asarray((x > -0.5) & (x < lens.width - 0.5) & (y > -0.5) & (y < lens.height - 0.5))
