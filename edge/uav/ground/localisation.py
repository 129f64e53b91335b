"""The camera over the ground: ego-motion and telemetry put together, and when the ground frame begins anew."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.ground.ego_motion import EgoMotion
from edge.uav.ground.frame_init import Root, root_from_picture, root_from_telemetry
from edge.uav.ground.image_plane import ImagePlane, inverse, transfer
from edge.uav.ground.photometric import Light
from edge.uav.ground.plane_motion import PosePlane
from edge.uav.timing.telemetry_track import TelemetryClock
from edge.uav.tracker import Box
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]

_SETTLED_S = 0.04  # std of the clocks' offset that is good enough to go by
_ATTITUDE_STD = np.deg2rad(1.0)  # how hard the absolute attitude and position pull, a frame
_POSITION_STD = np.array([4.0, 4.0, 2.0])  # [m]; harder, and the receiver's wandering becomes the target's speed
_TURNED = np.deg2rad(1.5)  # error of the first attitude that is worth a new ground frame


class Placing:
    """Where the camera is over the ground. ``plane`` is the camera, ``matrix`` normalised image from ground."""

    def __init__(self, size: tuple[int, int], lens: Intrinsics | None, body_from_camera: Floats | None) -> None:
        self.plane = ImagePlane(size, lens)
        self.light = Light()
        self._ego = EgoMotion(self.plane)
        usable = lens is not None and body_from_camera is not None
        self.clock = TelemetryClock(np.asarray(body_from_camera)) if usable else None
        self._kind = "picture"
        self.body_height = 0.0
        """Of the middle of the target's body above the ground [ground units]."""
        self._corrected = False
        self._frame = 0

    @property
    def matrix(self) -> Floats:
        return self._ego.motion.matrix

    @property
    def body_matrix(self) -> Floats:
        """As ``matrix``, for points at the height of the middle of the target's body.

        A roof seen from aside stands farther out than the ground below it: unheeded, that is a speed of its own.
        """
        motion = self._ego.motion
        if isinstance(motion, PosePlane) and self.body_height > 0.0:
            motion = PosePlane(motion.rotation, motion.centre + np.array([0.0, 0.0, self.body_height]))
        return motion.matrix

    @property
    def metric(self) -> bool:
        """Whether ground units are metres and its axes north and east."""
        return self._kind == "metric"

    @property
    def blind(self) -> int:
        """Frames in a row in which the camera could not be placed."""
        return self._ego.blind

    @property
    def factor(self) -> int:
        """Pixels of the picture for one of the working picture."""
        return self._ego.factor

    @property
    def tracks(self) -> Floats:
        """(n, 2) image pixels of the corners that are followed."""
        return self._ego.tracks

    def shrink(self, image: Picture) -> Picture:
        """The working picture."""
        return self._ego.shrink(image)

    def begin(self, small: Picture, time: float, target: Box) -> None:
        """Root the ground frame in the first working picture."""
        root = root_from_telemetry(self.plane, self.clock, time, target) or root_from_picture(self.plane, target)
        self._kind = root.kind
        x0, y0, x1, y1 = target.x, target.y, target.x + target.width, target.y + target.height
        self._ego.begin(_grey(small), root.motion, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
        self.light.update(small, np.zeros((0, 2)), np.zeros((0, 2)))

    def pixels(self, ground: Floats) -> Floats:
        """Image pixels (n, 2) of ground points (n, 2); NaN behind the camera."""
        return self.plane.pixels(transfer(self.matrix, ground))

    def body_pixels(self, ground: Floats) -> Floats:
        """As ``pixels``, of targets that stand on these ground points (n, 2)."""
        return self.plane.pixels(transfer(self.body_matrix, ground))

    def body_ground(self, pixels: Floats) -> Floats:
        """Ground points (n, 2) on which targets seen at image pixels (n, 2) stand; NaN above the horizon."""
        return transfer(inverse(self.body_matrix), self.plane.normalise(pixels))

    def skip(self, dt: float) -> None:
        """A frame that could not be decoded."""
        self._ego.skip(dt)

    def update(self, small: Picture, time: float, dt: float, keep_out: Floats | None) -> None:
        """Place the camera in the next working picture. keep_out: (4, 2) pixels, the outline of what moves."""
        self._frame += 1
        clock, motion = self.clock, self._ego.motion
        predicted: PosePlane | None = None
        attitude: tuple[Floats, Floats] | None = None
        position: tuple[Floats, Floats] | None = None
        if clock is not None and isinstance(motion, PosePlane) and clock.offset_std < 0.1:
            measured = clock.rotation_at(time)
            if measured is not None:
                attitude = measured, np.full(3, _ATTITUDE_STD + clock.offset_std)
                place = clock.position_at(time) if self.metric else None
                if place is not None:
                    position = place, _POSITION_STD
                earlier = clock.rotation_at(time - dt)
                if earlier is not None and clock.rate_hz > 8.0 and clock.offset_std < _SETTLED_S:
                    turn = measured @ earlier.T
                    predicted = PosePlane(turn @ motion.rotation, self._ego.next_centre(dt))
        self._ego.update(
            _grey(small),
            dt,
            keep_out=keep_out,
            predicted=predicted,
            tight=1.0 if predicted is None else 0.6,
            attitude=attitude,
            position=position,
        )
        self.light.update(small, *self._ego.pairs)
        if clock is not None and isinstance(self._ego.motion, PosePlane) and self._ego.blind == 0:
            clock.saw(time, self._ego.motion.rotation)

    def better_root(self, time: float, target: Box) -> Root | None:
        """Another start of the ground frame, if telemetry now gives a better one. target: its box now."""
        clock, motion = self.clock, self._ego.motion
        if clock is None:
            return None
        if isinstance(motion, PosePlane):
            if self._corrected or clock.offset_std > _SETTLED_S:
                return None
            measured = clock.rotation_at(time)
            if measured is None:
                return None
            self._corrected = True
            if so3.angle_between(measured, motion.rotation) < _TURNED:
                return None
        elif self._frame % 5:
            return None
        root = root_from_telemetry(self.plane, clock, time, target)
        return root if root is not None and root.rank >= ("picture", "attitude", "metric").index(self._kind) else None

    def take(self, root: Root) -> Floats:
        """Go over to another ground frame; (3, 3) homography, new from old ground."""
        change = inverse(root.motion.matrix) @ self.matrix
        self._ego.restart(root.motion, change)
        self._kind = root.kind
        if self.clock is not None:
            self.clock.forget_seen()
        return np.asarray(change)


def _grey(small: Picture) -> Picture:
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
