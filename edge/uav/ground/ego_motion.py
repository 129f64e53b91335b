"""The camera's own motion over the ground plane, from corners that carry their ground points.

Every track keeps the ground point that it was born with, so that errors don't add up from frame to frame while it
lives. The pose minimises sum rho(q_i - pi(H(p) g_i)) + |p - p_predicted|² by robust Gauss-Newton (METHODS B, 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.ground.image_plane import ImagePlane, inverse, transfer
from edge.uav.ground.plane_motion import ChainPlane, PlaneMotion, PosePlane
from protocols.geometry import so3
from protocols.geometry.types import Bools, Floats

Gray = npt.NDArray[np.uint8]

_WORKING_WIDTH = 430  # LK runs on a picture about that wide
_TRACKS = 110
_WINDOW = 13
_STEPS = 6
_NOISE = 0.35  # of a tracked corner in the working picture [px]
_GOOD = 1.5  # residual of a corner that belongs to the plane [px of the working picture]
_FORGET = 3  # bad frames after which a track is given up

Measured: TypeAlias = tuple[Floats, Floats] | None
Motion = TypeVar("Motion", PosePlane, ChainPlane)


@dataclass(frozen=True, slots=True, eq=False)
class EgoReport:
    """How well one frame was placed. share: of tracks that agree; tracks: their number; shift_px: 95 % residual."""

    share: float
    tracks: int
    residual: float
    trusted: bool


class EgoMotion:
    """Follows the camera from picture to picture. ``motion`` is where it is now."""

    def __init__(self, plane: ImagePlane) -> None:
        self._plane = plane
        self.factor = max(1, -(-plane.width // _WORKING_WIDTH))
        self.motion: PosePlane | ChainPlane = ChainPlane(np.eye(3))
        self._before: PosePlane | ChainPlane | None = None
        self._last_dt = 1.0 / 30.0
        self._gray: Gray | None = None
        self._pixels: npt.NDArray[np.float32] = np.zeros((0, 2), np.float32)
        self._ground: Floats = np.zeros((0, 2))
        self._bad: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._since_search = 0
        self._pairs: tuple[Floats, Floats] = (np.zeros((0, 2)), np.zeros((0, 2)))
        self.blind = 0
        """Frames in a row without a trusted placing."""

    def shrink(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """The working picture: smaller by ``factor``."""
        if self.factor == 1:
            return image
        height, width = image.shape[:2]
        size = (width // self.factor, height // self.factor)
        whole = image[: size[1] * self.factor, : size[0] * self.factor]
        return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def begin(self, gray: Gray, motion: PosePlane | ChainPlane, keep_out: Floats | None) -> None:
        """Start with the first working picture. keep_out: (4, 2) pixels of the target's outline."""
        self.motion, self._before = motion, None
        self._gray = gray
        self._drop_all()
        self._replenish(keep_out)

    def restart(self, motion: PosePlane | ChainPlane, new_from_old: Floats) -> None:
        """Go on in another ground frame: (3, 3) homography that maps the old one's points."""
        self._ground = transfer(new_from_old, self._ground)
        self.motion, self._before = motion, None

    def skip(self, dt: float) -> None:
        """A frame that could not be decoded: go on as before."""
        before = self.motion
        self.motion = self._predicted(dt)
        self._before, self._last_dt = before, dt
        self.blind += 1

    def update(
        self,
        gray: Gray,
        dt: float,
        *,
        keep_out: Floats | None,
        predicted: PosePlane | None = None,
        tight: float = 1.0,
        attitude: tuple[Floats, Floats] | None = None,
        position: tuple[Floats, Floats] | None = None,
    ) -> EgoReport:
        """Place the camera in the next working picture.

        predicted: from telemetry, instead of constant velocity; tight: factor on the prediction's std.
        attitude: rotation (3, 3) camera from ground measured absolutely, and its std (3,) [rad]; position: the centre
        (3,) and its std (3,) [ground units].
        """
        assert self._gray is not None
        guess = self._predicted(dt) if predicted is None else predicted
        std = guess.prior_std(dt, self._distance()) * tight
        found, good, report = self._attempt(guess, std, (attitude, position), self._lk(gray, self._project(guess), 2))
        if report.share < 0.6 or report.tracks < 8:
            shift = self._coarse_shift(gray, guess)
            wide = std * 8.0
            start = self._project(guess)
            second = self._attempt(guess, wide, (None, None), self._lk(gray, start + shift, 3))
            if second[2].share * min(second[2].tracks, 30) > report.share * min(report.tracks, 30):
                found, good, report = second
        before = self.motion
        self._gray = gray
        if report.trusted:
            self.motion = found
            self.blind = 0
            self._pairs = self._pixels[good[2]].astype(np.float64), good[0][good[2]].astype(np.float64)
            self._keep(good)
        else:
            self.motion = guess
            self.blind += 1
            self._pairs = np.zeros((0, 2)), np.zeros((0, 2))
            self._drop_all()
        self._before, self._last_dt = before, dt
        self._since_search += 1
        if len(self._pixels) < 0.6 * _TRACKS or self._since_search >= 4:
            self._replenish(keep_out)
        return report

    @property
    def tracks(self) -> Floats:
        """(n, 2) pixels of the live tracks in the full picture, for overlays."""
        return self._full(self._pixels.astype(np.float64))

    @property
    def pairs(self) -> tuple[Floats, Floats]:
        """The same ground points (n, 2) in the last working picture and in this one."""
        return self._pairs

    def next_centre(self, dt: float) -> Floats:
        """Where the camera's centre (3,) would be if it went on at its velocity."""
        guess = self._predicted(dt)
        assert isinstance(guess, PosePlane)
        return guess.centre

    def _predicted(self, dt: float) -> PosePlane | ChainPlane:
        ratio = min(dt / max(self._last_dt, 1e-3), 3.0)
        motion, before = self.motion, self._before
        if isinstance(motion, PosePlane):
            return motion.continued(before, ratio) if isinstance(before, PosePlane) else motion
        return motion.continued(before, ratio) if isinstance(before, ChainPlane) else motion

    def _distance(self) -> float:
        return abs(float(self.motion.centre[2])) if isinstance(self.motion, PosePlane) else 1.0

    def _full(self, small: Floats) -> Floats:
        return np.asarray((small + 0.5) * self.factor - 0.5)

    def _small(self, full: Floats) -> Floats:
        return np.asarray((full + 0.5) / self.factor - 0.5)

    def _project(self, motion: PosePlane | ChainPlane) -> Floats:
        """Where the tracks would be in the working picture."""
        return self._small(self._plane.pixels(transfer(motion.matrix, self._ground)))

    def _lk(self, gray: Gray, start: Floats, levels: int) -> tuple[npt.NDArray[np.float32], Bools]:
        """Pyramidal Lucas-Kanade from ``start`` (n, 2); pixels (n, 2) and which were found."""
        assert self._gray is not None
        if not len(self._pixels):
            return self._pixels, np.zeros(0, bool)
        height, width = gray.shape[:2]
        usable: Bools = np.asarray(np.isfinite(start).all(axis=1))
        begin = np.where(usable[:, None], start, self._pixels).astype(np.float32)
        begin = np.clip(begin, -50.0, [width + 50.0, height + 50.0]).astype(np.float32)
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._gray,
            gray,
            self._pixels[:, None],
            begin[:, None].copy(),
            winSize=(_WINDOW, _WINDOW),
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.02),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=2e-4,
        )
        at = np.asarray(found, dtype=np.float32).reshape(-1, 2)
        inside = (at > 3.0).all(axis=1) & (at[:, 0] < width - 4) & (at[:, 1] < height - 4)
        return at, np.asarray((status.ravel() > 0) & inside & usable)

    def _attempt(
        self,
        guess: PosePlane | ChainPlane,
        std: Floats,
        absolute: tuple[Measured, Measured],
        flow: tuple[npt.NDArray[np.float32], Bools],
    ) -> tuple[PosePlane | ChainPlane, tuple[npt.NDArray[np.float32], Bools, Bools], EgoReport]:
        at, followed = flow
        if int(followed.sum()) < 6:
            return guess, (at, followed, followed), EgoReport(0.0, int(followed.sum()), float("inf"), False)
        seen = self._plane.normalise(self._full(at[followed].astype(np.float64)))
        imaged = np.isfinite(seen).all(axis=1)  # a strongly bent lens has corners without an image
        if not imaged.all():
            followed = followed.copy()
            followed[np.flatnonzero(followed)[~imaged]] = False
            seen = seen[imaged]
        if len(seen) < 6:
            return guess, (at, followed, followed), EgoReport(0.0, len(seen), float("inf"), False)
        ground = self._ground[followed]
        unit = self.factor / self._plane.focal  # one pixel of the working picture in normalised units
        if isinstance(guess, PosePlane):
            motion: PosePlane | ChainPlane = _place(guess, ground, seen, unit, std, absolute)
        else:
            motion = _place(guess, ground, seen, unit, std, (None, None))
        error = np.linalg.norm(transfer(motion.matrix, ground) - seen, axis=1) / unit
        good, firm = np.zeros(len(at), bool), np.zeros(len(at), bool)
        good[followed] = error < _GOOD
        firm[followed] = error < np.clip(4.0 * float(np.median(error)), 0.5, _GOOD)
        # Tracks that left the picture count neither way; those that were to be inside and weren't found do.
        number = int(good.sum())
        share = number / max(int(followed.sum()), 1)
        residual = float(np.median(error[error < _GOOD])) if number else float("inf")
        trusted = number >= 6 and (share >= 0.35 or number >= 25)
        return motion, (at, followed, firm), EgoReport(share, number, residual, trusted)

    def _keep(self, result: tuple[npt.NDArray[np.float32], Bools, Bools]) -> None:
        at, followed, good = result
        self._bad = np.where(good, 0, self._bad + 1)
        live = followed & (self._bad < _FORGET)
        self._pixels, self._ground, self._bad = at[live], self._ground[live], self._bad[live]

    def _drop_all(self) -> None:
        self._pixels = np.zeros((0, 2), np.float32)
        self._ground = np.zeros((0, 2))
        self._bad = np.zeros(0, np.int64)

    def _replenish(self, keep_out: Floats | None) -> None:
        """New corners where there are none; each takes the ground point it stands on."""
        assert self._gray is not None
        self._since_search = 0
        wanted = _TRACKS - len(self._pixels)
        if wanted < 8:
            return
        height, width = self._gray.shape[:2]
        spacing = max(5, width // 26)
        mask = np.full((height, width), 255, np.uint8)
        mask[:6], mask[-6:], mask[:, :6], mask[:, -6:] = 0, 0, 0, 0
        for x, y in self._pixels:
            cv2.circle(mask, (int(x), int(y)), spacing, 0, -1)
        if keep_out is not None and np.isfinite(keep_out).all():
            corners = np.clip(self._small(keep_out), -1e4, 1e4).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(corners[:, None]), 0)
        found = cv2.goodFeaturesToTrack(self._gray, wanted, 0.015, spacing, mask=mask, blockSize=5)
        if found is None:
            return
        new = np.asarray(found, dtype=np.float32).reshape(-1, 2)
        seen = self._plane.normalise(self._full(new.astype(np.float64)))
        try:
            back = inverse(self.motion.matrix)
        except np.linalg.LinAlgError:
            return
        ground = transfer(back, seen)
        # Near the horizon a pixel covers a field: nothing there fixes a pose.
        near = np.isfinite(ground).all(axis=1)
        if isinstance(self.motion, PosePlane):
            near &= np.linalg.norm(ground - self.motion.centre[:2], axis=1) < 8.0 * self._distance()
        self._pixels = np.concatenate([self._pixels, new[near]])
        self._ground = np.concatenate([self._ground, ground[near]])
        self._bad = np.concatenate([self._bad, np.zeros(int(near.sum()), np.int64)])

    def _coarse_shift(self, gray: Gray, guess: PosePlane | ChainPlane) -> Floats:
        """(2,) shift of the working picture beyond what ``guess`` explains, by phase correlation."""
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


def _place(
    guess: Motion,
    ground: Floats,
    seen: Floats,
    unit: float,
    std: Floats,
    absolute: tuple[Measured, Measured],
) -> Motion:
    """Robust Gauss-Newton from ``guess``: residuals in normalised coordinates, Geman-McClure with falling width."""
    information = 1.0 / np.square(std)
    pull = np.zeros(len(std))
    if isinstance(guess, PosePlane):
        attitude, position = absolute
        if attitude is not None:
            _pull(information, pull, slice(0, 3), so3.log(attitude[0] @ guess.rotation.T), attitude[1])
        if position is not None:
            _pull(information, pull, slice(3, 6), position[0] - guess.centre, position[1])
    motion, total = guess, np.zeros(len(std))
    noise = _NOISE * unit
    for step in range(_STEPS):
        h = motion.matrix
        p = ground @ h[:, :2].T + h[:, 2]
        front = p[:, 2] > 1e-9
        depth = np.where(front, p[:, 2], 1.0)
        at = p[:, :2] / depth[:, None]
        residual = seen - at
        squared = residual[:, 0] ** 2 + residual[:, 1] ** 2
        if step == 0:
            width = max(float(np.median(np.sqrt(squared))) * 1.5, 2.0 * unit)
        else:
            # What stands on the ground moves a little more than the ground: narrow, or roofs drag the pose along.
            width = max(width * 0.4, 2.5 * float(np.median(np.sqrt(squared))), 0.3 * unit)
        weight = np.where(front, 1.0 / np.square(1.0 + squared / (width * width)), 0.0) / (noise * noise)
        j = motion.jacobian(ground, at, depth).reshape(2 * len(ground), -1)
        jw = j * np.repeat(weight, 2)[:, None]
        normal = jw.T @ j + np.diag(information)
        right = residual.reshape(-1) @ jw + information * (pull - total)
        delta: Floats = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        total = total + delta
        motion = motion.moved(delta)
        if step >= 2 and float(np.abs(delta[:2]).max()) < 0.01 * unit:
            break
    return motion


def _pull(information: Floats, pull: Floats, part: slice, error: Floats, std: Floats) -> None:
    """Join a measurement, ``error`` away from the prediction, to the prior of some parameters."""
    weight = 1.0 / np.square(std)
    information[part] += weight
    pull[part] = weight * error / information[part]


__all__ = ["EgoMotion", "EgoReport", "PlaneMotion"]
