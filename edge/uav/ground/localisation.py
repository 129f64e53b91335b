"""Camera localisation over the ground: fusion of ego-motion and telemetry, and changes of the ground frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.base import Box
from edge.uav.ground.ego_motion import EgoMotion
from edge.uav.ground.image_plane import ImagePlane, apply_homography, inverse
from edge.uav.ground.photometric import PhotometricGain
from edge.uav.ground.plane_pose import PlaneHomography, PlanePose
from edge.uav.timing.telemetry_track import TelemetryTrack
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

CAR_LENGTH = 4.5
"""Assumed length of the target where the scale is not observable [ground units]."""
_MIN_LENGTH, _MAX_LENGTH = 0.3, 30.0  # of a plausible target [m]: a person from above is 0.5 m
_MIN_HEIGHT = 2.0  # of the camera for a plausible position [m]
_MAX_RANGE_RATIO = 12.0  # horizontal distance over height: beyond, the target is near the horizon
_GAP_S = 0.25  # between images, from which the way of before is no prediction: at 1 g it is 0.3 m wrong
_CONVERGED_STD_S = 0.04  # of the clock offset, for which telemetry is used
_ATTITUDE_STD = np.deg2rad(1.0)  # of the absolute attitude as a measurement, per frame
_POSITION_STD = np.array([4.0, 4.0, 2.0])  # [m]; with less, drift of the receiver would appear as speed of the target
_MIN_ATTITUDE_ERROR = np.deg2rad(1.5)  # of the initial attitude for which the ground frame is changed


@dataclass(frozen=True, slots=True, eq=False)
class GroundFrame:
    """An initial camera pose that defines the ground frame. kind: "metric", "attitude" (scale unknown) or "image"."""

    pose: PlanePose | PlaneHomography
    kind: str

    @property
    def rank(self) -> int:
        """Higher if more degrees of freedom of the frame are known."""
        return ("image", "attitude", "metric").index(self.kind)


def frame_from_telemetry(
    plane: ImagePlane, telemetry: TelemetryTrack | None, time: float, target: Box
) -> GroundFrame | None:
    """A pose over the plane from the attitude nearest to ``time``; None if there is none or it is implausible."""
    if telemetry is None or plane.lens is None:
        return None
    found = telemetry.nearest(time, within=0.6)
    if found is None:
        return None
    rotation, position = found
    normalised = plane.normalise(_corners(target))
    if position is not None and -position[2] > _MIN_HEIGHT:
        pose = PlanePose(rotation, np.asarray(position, dtype=np.float64))
        if not _is_within_range(pose, normalised):
            return None
        longer_side = _longer_side(pose, normalised)
        # A height that makes the target as small as a toy or as long as a ship is wrong; the attitude may be right.
        if _MIN_LENGTH < longer_side < _MAX_LENGTH:
            return GroundFrame(pose, "metric")
    at_unit_height = PlanePose(rotation, np.array([0.0, 0.0, -1.0]))
    if not _is_within_range(at_unit_height, normalised):
        return None
    height = CAR_LENGTH / max(_longer_side(at_unit_height, normalised), 1e-9)
    return GroundFrame(PlanePose(rotation, np.array([0.0, 0.0, -height])), "attitude")


def _longer_side(pose: PlanePose, normalised: Floats) -> float:
    """Longer side on the ground of the box with normalised corners (4, 2)."""
    corners = apply_homography(inverse(pose.matrix), normalised)
    return float(max(np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(corners[3] - corners[0])))


def frame_from_image(plane: ImagePlane, target: Box) -> GroundFrame:
    """A frame in which the first image is the ground seen from straight above and the target has a car's length."""
    size = max(target.width, target.height) / plane.focal / CAR_LENGTH
    matrix = np.diag([size, size, 1.0])
    return GroundFrame(PlaneHomography(matrix / np.cbrt(np.linalg.det(matrix))), "image")


def _corners(target: Box) -> Floats:
    x0, y0, x1, y1 = target.x, target.y, target.x + target.width - 1.0, target.y + target.height - 1.0
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def _is_within_range(pose: PlanePose, normalised: Floats) -> bool:
    """Whether all of these normalised image points lie on the ground and not near the horizon."""
    try:
        ground = apply_homography(inverse(pose.matrix), normalised)
    except np.linalg.LinAlgError:
        return False
    if not np.isfinite(ground).all():
        return False
    distance = np.linalg.norm(ground - pose.centre[:2], axis=1).max()
    return bool(distance < _MAX_RANGE_RATIO * abs(float(pose.centre[2])))


class CameraLocaliser:
    """Camera pose over the ground. ``plane`` is the camera model, ``matrix`` normalised image from ground."""

    def __init__(self, size: tuple[int, int], lens: Intrinsics | None, body_from_camera: Floats | None) -> None:
        self.plane = ImagePlane(size, lens)
        self.photometric = PhotometricGain()
        self._ego = EgoMotion(self.plane)
        usable = lens is not None and body_from_camera is not None
        self.telemetry = TelemetryTrack(np.asarray(body_from_camera)) if usable else None
        self._kind = "image"
        self.switches = 0
        """How often the ground frame was changed."""
        self.target_height = 0.0
        """Height of the target's centre above the ground [ground units]."""
        self._raised: tuple[PlanePose | PlaneHomography, float, Floats] | None = None  # pose, height, target_matrix
        self._attitude_checked = False
        self._frame = 0

    @property
    def matrix(self) -> Floats:
        return self._ego.pose.matrix

    @property
    def target_matrix(self) -> Floats:
        """As ``matrix``, for points at the height of the target's centre.

        Seen obliquely, a roof appears farther away than the ground below it, which would bias the target's speed.
        """
        pose, height = self._ego.pose, self.target_height
        if self._raised is None or self._raised[0] is not pose or self._raised[1] != height:
            matrix = pose.matrix.copy()
            if isinstance(pose, PlanePose):
                matrix[:, 2] -= height * pose.rotation[:, 2]
            self._raised = pose, height, matrix
        return self._raised[2]

    @property
    def metric(self) -> bool:
        """Whether ground units are metres and the axes north and east."""
        return self._kind == "metric"

    @property
    def view_cosine(self) -> float:
        """Cosine of the angle between optical axis and vertical; nan where no attitude is known."""
        pose = self._ego.pose
        return float(pose.rotation[2, 2]) if isinstance(pose, PlanePose) else float("nan")

    @property
    def frames_without_pose(self) -> int:
        """Consecutive frames without a trusted camera pose."""
        return self._ego.frames_without_pose

    @property
    def downscale(self) -> int:
        """Image pixels per pixel of the working image."""
        return self._ego.downscale

    @property
    def tracks(self) -> Floats:
        """(n, 2) image pixels of the tracked corners."""
        return self._ego.tracks

    def working_image(self, image: Image) -> Image:
        """The image at reduced resolution."""
        return self._ego.working_image(image)

    def begin(self, working: Image, time: float, target: Box) -> None:
        """Initialise the ground frame from the first working image."""
        frame = frame_from_telemetry(self.plane, self.telemetry, time, target) or frame_from_image(self.plane, target)
        self._kind = frame.kind
        x0, y0, x1, y1 = target.x, target.y, target.x + target.width, target.y + target.height
        self._ego.begin(_to_grey(working), frame.pose, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
        self.photometric.update(working, np.zeros((0, 2)), np.zeros((0, 2)))

    def pixels(self, ground: Floats) -> Floats:
        """Image pixels (n, 2) of ground points (n, 2); NaN behind the camera."""
        return self.plane.project(self.matrix, ground)

    def target_pixels(self, ground: Floats) -> Floats:
        """As ``pixels``, for targets that stand on these ground points (n, 2)."""
        return self.plane.project(self.target_matrix, ground)

    def target_ground(self, pixels: Floats) -> Floats:
        """Ground points (n, 2) below targets seen at image pixels (n, 2); NaN above the horizon."""
        return apply_homography(inverse(self.target_matrix), self.plane.normalise(pixels))

    def skip(self, dt: float) -> None:
        """A frame that could not be decoded."""
        self._ego.skip(dt)

    def update(self, working: Image, time: float, dt: float, excluded: Floats | None) -> None:
        """Localise the camera in the next working image. excluded: (4, 2) pixels, the outline of the moving target."""
        self._frame += 1
        telemetry, pose = self.telemetry, self._ego.pose
        predicted: PlanePose | None = None
        attitude: tuple[Floats, Floats] | None = None
        position: tuple[Floats, Floats] | None = None
        gap = dt > _GAP_S  # whatever the offset, what changed meanwhile is better known by telemetry
        if telemetry is not None and isinstance(pose, PlanePose) and (telemetry.offset_std < 0.1 or gap):
            measured = telemetry.rotation_at(time)
            if measured is not None:
                attitude = measured, np.full(3, _ATTITUDE_STD + telemetry.offset_std)
                centre = telemetry.position_at(time) if self.metric else None
                if centre is not None:
                    position = centre, _POSITION_STD
                earlier = telemetry.rotation_at(time - dt)
                known = telemetry.offset_std < _CONVERGED_STD_S or gap
                if earlier is not None and telemetry.rate_hz > 8.0 and known:
                    way = self._reported_way(telemetry, time, dt) if gap else None
                    moved = self._ego.predicted_centre(dt) if way is None else pose.centre + way
                    predicted = PlanePose(measured @ earlier.T @ pose.rotation, moved)
        grey, factor = _to_grey(working), 1.0 if predicted is None else 0.6
        self._ego.update(
            grey, dt, excluded=excluded, predicted=predicted, std_factor=factor, attitude=attitude, position=position
        )
        self.photometric.update(working, *self._ego.correspondences)
        if telemetry is not None and isinstance(self._ego.pose, PlanePose) and self._ego.frames_without_pose == 0:
            telemetry.add_visual_attitude(time, self._ego.pose.rotation)

    def _reported_way(self, telemetry: TelemetryTrack, time: float, dt: float) -> Floats | None:
        """Way (3,) of the camera [m] in the last ``dt`` seconds by telemetry; None where that does not say."""
        now, before = telemetry.position_at(time), telemetry.position_at(time - dt)
        return None if not self.metric or now is None or before is None else now - before

    def better_frame(self, time: float, target: Box) -> GroundFrame | None:
        """Another initial ground frame, if telemetry now gives a better one. target: its present box."""
        telemetry, pose = self.telemetry, self._ego.pose
        if telemetry is None:
            return None
        if isinstance(pose, PlanePose):
            if self._attitude_checked or telemetry.offset_std > _CONVERGED_STD_S:
                return None
            measured = telemetry.rotation_at(time)
            if measured is None:
                return None
            self._attitude_checked = True
            if so3.angle_between(measured, pose.rotation) < _MIN_ATTITUDE_ERROR:
                return None
        elif self._frame % 5:
            return None
        frame = frame_from_telemetry(self.plane, telemetry, time, target)
        return frame if frame is not None and frame.rank >= ("image", "attitude", "metric").index(self._kind) else None

    def switch_frame(self, frame: GroundFrame) -> Floats:
        """Change to another ground frame; (3, 3) homography, new from old ground."""
        change = inverse(frame.pose.matrix) @ self.matrix
        self._ego.change_frame(frame.pose, change)
        self._kind = frame.kind
        self.switches += 1
        if self.telemetry is not None:
            self.telemetry.reset_visual_attitudes()
        return np.asarray(change)


def _to_grey(working: Image) -> Image:
    return np.asarray(cv2.cvtColor(working, cv2.COLOR_BGR2GRAY), np.uint8)
