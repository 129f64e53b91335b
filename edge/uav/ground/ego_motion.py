"""Ego-motion of the camera over the ground plane, from corner tracks anchored to ground points.

Every track keeps the ground point at which it was initialised, so errors do not accumulate from frame to frame while
it lives. The pose minimises sum rho(q_i - pi(H(p) g_i)) + |p - p_predicted|² by robust Gauss-Newton. It takes the
place of the image shift and rotation of the background-aware tracking paper (eqs. 4.17 to 4.19), which drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.ground.image_plane import ImagePlane, apply_homography, inverse
from edge.uav.ground.plane_pose import PlaneCamera, PlaneHomography, PlanePose
from protocols.geometry import kernels, so3
from protocols.geometry.order_statistics import median, quantile
from protocols.geometry.types import Bools, Floats, Image

Gray = npt.NDArray[np.uint8]

_WORKING_WIDTH = 430  # approximate width of the image on which Lucas-Kanade runs [px]
_MAX_TRACKS = 110  # for six unknowns: more cost CPU, fewer leave too few where buildings hide the ground
LK_WINDOW = 13  # px of the working image: smaller ones fail on little texture, larger ones mix roofs and ground
_MAX_ITERATIONS = 6  # Gauss-Newton steps, a bound: three narrow the kernel, and it stops where it has converged
_MAX_LEVELS = 2  # halvings of the image for Lucas-Kanade
_PYRAMID_MARGIN = 4.0  # how much farther from where they are expected corners may be than in the frame before
_CORNER_STD = 0.35  # of a tracked corner [px of the working image]
_MIN_NEW_TRACKS = 16  # a search takes as long as following all tracks three times
_MAX_RESIDUAL = 1.5  # of a corner on the plane [px of the working image]
_MAX_BAD_FRAMES = 3  # after which a track is dropped

Measurement: TypeAlias = tuple[Floats, Floats] | None
PoseT = TypeVar("PoseT", PlanePose, PlaneHomography)


@dataclass(frozen=True, slots=True, eq=False)
class EgoMotionReport:
    """Quality of one pose. inlier_share: of the tracks; tracks: number of inliers.

    residual: their median [px of the working image]; trusted: whether the pose is used.
    """

    inlier_share: float
    tracks: int
    residual: float
    trusted: bool


class EgoMotion:
    """Tracks the camera from image to image. ``pose`` is the current one.

    correspondences: pixels (n, 2) of the same ground points in the last working image and in this one.
    """

    def __init__(self, plane: ImagePlane) -> None:
        self._plane = plane
        self.downscale = max(1, -(-plane.width // _WORKING_WIDTH))
        self.pose: PlanePose | PlaneHomography = PlaneHomography(np.eye(3))
        self._previous: PlanePose | PlaneHomography | None = None
        self._last_dt = 1.0 / 30.0
        self._levels = _MAX_LEVELS
        self._gray: Gray | None = None
        self._pixels: npt.NDArray[np.float32] = np.zeros((0, 2), np.float32)
        self._ground: Floats = np.zeros((0, 2))
        self._bad_frames: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._frames_since_detection = 0
        self.correspondences: tuple[Floats, Floats] = (np.zeros((0, 2)), np.zeros((0, 2)))
        self.frames_without_pose = 0
        """Consecutive frames without a trusted pose."""

    def working_image(self, image: Image) -> Image:
        """The image reduced by ``downscale``."""
        return reduced(image, self.downscale)

    def begin(self, gray: Gray, pose: PlanePose | PlaneHomography, excluded: Floats | None) -> None:
        """Start with the first working image. excluded: (4, 2) pixels of the target's outline."""
        self.pose, self._previous = pose, None
        self._gray = gray
        self._drop_tracks()
        self._detect_corners(excluded)

    def change_frame(self, pose: PlanePose | PlaneHomography, new_from_old: Floats) -> None:
        """Continue in another ground frame; new_from_old: (3, 3) homography of ground points."""
        self._ground = apply_homography(new_from_old, self._ground)
        self.pose, self._previous = pose, None

    def skip(self, dt: float) -> None:
        """A frame that could not be decoded: extrapolate."""
        previous = self.pose
        self.pose = self._predicted(dt)
        self._previous, self._last_dt = previous, dt
        self.frames_without_pose += 1

    def update(
        self,
        gray: Gray,
        dt: float,
        *,
        excluded: Floats | None,
        predicted: PlanePose | None = None,
        std_factor: float = 1.0,
        attitude: tuple[Floats, Floats] | None = None,
        position: tuple[Floats, Floats] | None = None,
    ) -> EgoMotionReport:
        """Estimate the pose of the next working image.

        excluded: (4, 2) pixels of a region without corners. predicted: from telemetry, instead of constant velocity;
        std_factor: on the prediction's std. attitude: absolute measurement of the rotation (3, 3) camera from ground
        and its std (3,) [rad]; position: of the centre (3,) and its std (3,) [ground units].
        """
        assert self._gray is not None
        guess = self._predicted(dt) if predicted is None else predicted
        std = guess.prediction_std(dt, self._distance()) * std_factor
        start = self._project(guess)
        flow = self._lucas_kanade(gray, start, self._levels)
        found, good, report = self._track_and_solve(guess, std, (attitude, position), flow)
        if report.inlier_share < 0.6 or report.tracks < 8:
            shift = self._coarse_shift(gray, guess)
            wide = std * 8.0
            second = self._track_and_solve(
                guess, wide, (None, None), self._lucas_kanade(gray, start + shift, _MAX_LEVELS + 1)
            )
            if second[2].inlier_share * min(second[2].tracks, 30) > report.inlier_share * min(report.tracks, 30):
                found, good, report = second
        previous = self.pose
        self._gray = gray
        if report.trusted:
            self.pose = found
            self.frames_without_pose = 0
            self.correspondences = self._pixels[good[2]].astype(np.float64), good[0][good[2]].astype(np.float64)
            off = np.hypot(*(good[0][good[2]] - start[good[2]]).T)
            # Lucas-Kanade reaches half a window, and twice that with each halving.
            reach = max(_PYRAMID_MARGIN * quantile(off, 0.9) / (0.5 * LK_WINDOW), 1.0)
            self._levels = min(math.ceil(math.log2(reach)), _MAX_LEVELS)
            self._update_tracks(good)
        else:
            self._levels = _MAX_LEVELS
            self.pose = guess
            self.frames_without_pose += 1
            self.correspondences = np.zeros((0, 2)), np.zeros((0, 2))
            self._drop_tracks()
        self._previous, self._last_dt = previous, dt
        self._frames_since_detection += 1
        if len(self._pixels) < 0.6 * _MAX_TRACKS or self._frames_since_detection >= 4:
            self._detect_corners(excluded)
        return report

    @property
    def tracks(self) -> Floats:
        """(n, 2) pixels of the live tracks in the full image, for overlays."""
        return self._to_full(self._pixels.astype(np.float64))

    def predicted_centre(self, dt: float) -> Floats:
        """The camera centre (3,) extrapolated at constant velocity."""
        guess = self._predicted(dt)
        assert isinstance(guess, PlanePose)
        return guess.centre

    def _predicted(self, dt: float) -> PlanePose | PlaneHomography:
        ratio = min(dt / max(self._last_dt, 1e-3), 3.0)
        pose, previous = self.pose, self._previous
        if isinstance(pose, PlanePose):
            return pose.extrapolated(previous, ratio) if isinstance(previous, PlanePose) else pose
        return pose.extrapolated(previous, ratio) if isinstance(previous, PlaneHomography) else pose

    def _distance(self) -> float:
        return abs(float(self.pose.centre[2])) if isinstance(self.pose, PlanePose) else 1.0

    def _to_full(self, small: Floats) -> Floats:
        return np.asarray((small + 0.5) * self.downscale - 0.5)

    def _to_working(self, full: Floats) -> Floats:
        return np.asarray((full + 0.5) / self.downscale - 0.5)

    def _project(self, pose: PlanePose | PlaneHomography) -> Floats:
        """Projections of the tracks' ground points into the working image."""
        return self._to_working(self._plane.project(pose.matrix, self._ground))

    def _lucas_kanade(self, gray: Gray, start: Floats, levels: int) -> tuple[npt.NDArray[np.float32], Bools]:
        """Pyramidal Lucas-Kanade from ``start`` (n, 2); pixels (n, 2) and which were found."""
        assert self._gray is not None
        if not len(self._pixels):
            return self._pixels, np.zeros(0, bool)
        height, width = gray.shape[:2]
        usable: Bools = np.asarray(np.isfinite(start).all(axis=1))
        begin = np.where(usable[:, None], start, self._pixels).astype(np.float32)
        begin = np.clip(begin, -50.0, [width + 50.0, height + 50.0]).astype(np.float32)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.02)
        window, flags = (LK_WINDOW, LK_WINDOW), cv2.OPTFLOW_USE_INITIAL_FLOW
        old, new = self._pixels[:, None], begin[:, None].copy()
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._gray, gray, old, new, None, None, window, levels, criteria, flags, minEigThreshold=2e-4
        )
        at = np.asarray(found, dtype=np.float32).reshape(-1, 2)
        inside = (at > 3.0).all(axis=1) & (at[:, 0] < width - 4) & (at[:, 1] < height - 4)
        return at, np.asarray((status.ravel() > 0) & inside & usable)

    def _track_and_solve(
        self,
        guess: PlanePose | PlaneHomography,
        std: Floats,
        absolute: tuple[Measurement, Measurement],
        flow: tuple[npt.NDArray[np.float32], Bools],
    ) -> tuple[PlanePose | PlaneHomography, tuple[npt.NDArray[np.float32], Bools, Bools], EgoMotionReport]:
        at, followed = flow
        if int(followed.sum()) < 6:
            return guess, (at, followed, followed), EgoMotionReport(0.0, int(followed.sum()), float("inf"), False)
        normalised = self._plane.normalise(self._to_full(at[followed].astype(np.float64)))
        imaged = np.isfinite(normalised).all(axis=1)  # with strong distortion some pixels have no ray
        if not imaged.all():
            followed = followed.copy()
            followed[np.flatnonzero(followed)[~imaged]] = False
            normalised = normalised[imaged]
        if len(normalised) < 6:
            return guess, (at, followed, followed), EgoMotionReport(0.0, len(normalised), float("inf"), False)
        ground = self._ground[followed]
        unit = self.downscale / self._plane.focal  # one pixel of the working image in normalised units
        if isinstance(guess, PlanePose):
            pose: PlanePose | PlaneHomography = _solve_pose(guess, ground, normalised, unit, std, absolute)
        else:
            pose = _solve_pose(guess, ground, normalised, unit, std, (None, None))
        error = np.hypot(*(apply_homography(pose.matrix, ground) - normalised).T) / unit
        good, inliers = np.zeros(len(at), bool), np.zeros(len(at), bool)
        good[followed] = error < _MAX_RESIDUAL
        inliers[followed] = error < min(max(4.0 * median(error), 0.5), _MAX_RESIDUAL)
        # Tracks outside the image are not counted; those expected inside but not found are.
        number = int(good.sum())
        inlier_share = number / max(int(followed.sum()), 1)
        residual = median(error[error < _MAX_RESIDUAL]) if number else float("inf")
        trusted = number >= 6 and (inlier_share >= 0.35 or number >= 25)
        return pose, (at, followed, inliers), EgoMotionReport(inlier_share, number, residual, trusted)

    def _update_tracks(self, result: tuple[npt.NDArray[np.float32], Bools, Bools]) -> None:
        at, followed, inliers = result
        self._bad_frames = np.where(inliers, 0, self._bad_frames + 1)
        live = followed & (self._bad_frames < _MAX_BAD_FRAMES)
        self._pixels, self._ground, self._bad_frames = at[live], self._ground[live], self._bad_frames[live]

    def _drop_tracks(self) -> None:
        self._pixels = np.zeros((0, 2), np.float32)
        self._ground = np.zeros((0, 2))
        self._bad_frames = np.zeros(0, np.int64)

    def _detect_corners(self, excluded: Floats | None) -> None:
        """Detect new corners where there are no tracks; each is anchored to its ground point."""
        assert self._gray is not None
        self._frames_since_detection = 0
        wanted = _MAX_TRACKS - len(self._pixels)
        if wanted < _MIN_NEW_TRACKS:
            return
        height, width = self._gray.shape[:2]
        spacing = max(5, width // 26)
        mask = np.full((height, width), 255, np.uint8)
        mask[:6], mask[-6:], mask[:, :6], mask[:, -6:] = 0, 0, 0, 0
        for centre in self._pixels.astype(int).tolist():
            cv2.circle(mask, centre, spacing, 0, -1)
        if excluded is not None and np.isfinite(excluded).all():
            corners = np.clip(self._to_working(excluded), -1e4, 1e4).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(corners[:, None]), 0)
        found = cv2.goodFeaturesToTrack(self._gray, wanted, 0.015, spacing, mask=mask, blockSize=5)
        if found is None:
            return
        new = np.asarray(found, dtype=np.float32).reshape(-1, 2)
        normalised = self._plane.normalise(self._to_full(new.astype(np.float64)))
        try:
            back = inverse(self.pose.matrix)
        except np.linalg.LinAlgError:
            return
        ground = apply_homography(back, normalised)
        # Near the horizon a pixel covers a large area, which does not constrain the pose.
        near = np.isfinite(ground).all(axis=1)
        if isinstance(self.pose, PlanePose):
            near &= np.linalg.norm(ground - self.pose.centre[:2], axis=1) < 8.0 * self._distance()
        self._pixels = np.concatenate([self._pixels, new[near]])
        self._ground = np.concatenate([self._ground, ground[near]])
        self._bad_frames = np.concatenate([self._bad_frames, np.zeros(int(near.sum()), np.int64)])

    def _coarse_shift(self, gray: Gray, guess: PlanePose | PlaneHomography) -> Floats:
        """(2,) shift of the working image beyond what ``guess`` explains, by phase correlation."""
        assert self._gray is not None
        height, width = gray.shape[:2]
        small = (min(width, 256), min(height, 192))
        scale = np.array([width / small[0], height / small[1]])
        old = cv2.resize(self._gray, small, interpolation=cv2.INTER_AREA).astype(np.float32)
        new = cv2.resize(gray, small, interpolation=cv2.INTER_AREA).astype(np.float32)
        window = cv2.createHanningWindow(small, cv2.CV_32F)
        (dx, dy), _ = cv2.phaseCorrelate(old, new, window)
        expected = np.zeros(2)
        if len(self._pixels):
            moved = self._project(guess) - self._pixels
            moved = moved[np.isfinite(moved).all(axis=1)]
            if len(moved):
                expected = np.median(moved, axis=0)
        return np.asarray(np.array([dx, dy]) * scale - expected, dtype=np.float64)


def _solve_pose(
    guess: PoseT,
    ground: Floats,
    normalised: Floats,
    unit: float,
    std: Floats,
    absolute: tuple[Measurement, Measurement],
) -> PoseT:
    """Robust Gauss-Newton from ``guess``: residuals in normalised coordinates, Geman-McClure with decreasing width."""
    information = 1.0 / np.square(std)
    prior = np.zeros(len(std))
    if isinstance(guess, PlanePose):
        attitude, position = absolute
        if attitude is not None:
            _fuse(information, prior, slice(0, 3), so3.log(attitude[0] @ guess.rotation.T), attitude[1])
        if position is not None:
            _fuse(information, prior, slice(3, 6), position[0] - guess.centre, position[1])
    pose, total = guess, np.zeros(len(std))
    noise = _CORNER_STD * unit
    if kernels.AVAILABLE:
        whole = (guess.rotation, guess.centre) if isinstance(guess, PlanePose) else (guess.matrix,)
        state, given = np.concatenate([part.ravel() for part in whole]), (len(ground), ground, normalised, len(std))
        limits = unit, noise, _MAX_ITERATIONS
        kernels.call("fit_plane_camera", *given, state, information, prior, *limits, np.empty(2 * len(ground)))
        parts = state[:9].reshape(3, 3), state[9:]
        return PlanePose(*parts) if isinstance(guess, PlanePose) else PlaneHomography(parts[0])
    for step in range(_MAX_ITERATIONS):
        h = pose.matrix
        p = ground @ h[:, :2].T + h[:, 2]
        front = p[:, 2] > 1e-9
        depth = np.where(front, p[:, 2], 1.0)
        at = p[:, :2] / depth[:, None]
        residual = normalised - at
        squared = residual[:, 0] ** 2 + residual[:, 1] ** 2
        if step == 0:
            width = max(median(np.sqrt(squared)) * 1.5, 2.0 * unit)
        else:
            # Raised objects move slightly more than the ground: a narrow kernel keeps roofs from biasing the pose.
            width = max(width * 0.4, 2.5 * median(np.sqrt(squared)), 0.3 * unit)
        weight = np.where(front, 1.0 / np.square(1.0 + squared / (width * width)), 0.0) / (noise * noise)
        j = pose.jacobian(ground, at, depth).reshape(2 * len(ground), -1)
        jw = j * np.repeat(weight, 2)[:, None]
        normal = jw.T @ j + np.diag(information)
        right = residual.reshape(-1) @ jw + information * (prior - total)
        delta: Floats = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        total = total + delta
        pose = pose.retract(delta)
        if step >= 2 and float(np.abs(delta[:2]).max()) < 0.01 * unit:
            break
    return pose


def _fuse(information: Floats, prior: Floats, part: slice, error: Floats, std: Floats) -> None:
    """Fuse a measurement, which differs from the prediction by ``error``, with the prior of some parameters."""
    weight = 1.0 / np.square(std)
    information[part] += weight
    prior[part] = weight * error / information[part]


def reduced(image: Image, factor: int) -> Image:
    """The means of squares of ``factor`` px of an image (h, w, 3); what is left over right and below is cut off."""
    height, width = (side // factor for side in image.shape[:2])
    if factor == 1:
        return image
    if kernels.AVAILABLE and factor > 2:  # half the size is fast in OpenCV
        out, sums = np.empty((height, width, 3), np.uint8), np.empty(3 * image.shape[1], np.uint16)
        kernels.call("reduce_image", *image.shape[:2], factor, np.ascontiguousarray(image), sums, out)
        return out
    whole = image[: height * factor, : width * factor]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


__all__ = ["EgoMotion", "EgoMotionReport", "PlaneCamera", "reduced"]
