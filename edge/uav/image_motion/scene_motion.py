"""Frame-to-frame image motion of the static scene: robust similarity of corner tracks, and parallax about a place.

A camera that turns and zooms moves the whole image by one map; one that travels moves near ground more than distant
background. The map is therefore a similarity fitted to the largest consistent set of tracks, plus a correction at
the place of interest: a robust linear fit to what the tracks near it move beyond the similarity. Outside the image,
where the target is while it is away, the map is the homography of a camera that turns and zooms, K' R K^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.ground.ego_motion import LK_WINDOW
from edge.uav.ground.photometric import PhotometricGain
from edge.uav.image_motion.burnt_in import BurntIn, shift, stood
from protocols.geometry.types import Bools, Floats, Image

Gray = npt.NDArray[np.uint8]

_WORKING_WIDTH = 400  # approximate width of the image on which the flow is computed [px]
_HALVED = 4  # times the working width: wider images are halved first, which changes their means by rounding only
_MAX_TRACKS = 120  # for four unknowns: more cost CPU, fewer leave parts of the image to what moves in them
_LK_LEVELS = 3  # halvings of the image: half a window of the smallest one is 48 px
_BACKWARD_PX = 0.7  # forward-backward distance of a good track [px of the working image]
_RANSAC_PX = 1.5  # residual of a track of the static scene [px of the working image]
_BENT = 0.04  # of the shift by a turn: mean of (x/f)^2 over half an image as wide as its focal length
_MIN_TRACKS, _MIN_SHARE = 12, 0.35  # of a trusted motion: static tracks, and their share
_MIN_PLACES, _PLACE = 4, 0.125
"""Places of them, so far apart over the image's width: a similarity fits what moves at two. Of real videos seven or
more, of three cars on snow three."""
_MOST_STAND = 0.5  # share of the tracks off what seems burnt in, that move alike where it is
_PARTS, _VOTE_PX = (4, 2), 2  # parts that are searched after a fast pan; agreement of their shifts [px, reduced]
_FEATURES, _FEATURE_STEP = 800, 7  # that are matched: number, and grey levels by which they stand out of dull ground
_MOST_ZOOM = 2.5  # in one step: a stage of a drone's zoom is 2
_PARALLAX_PX = 6.0  # largest correction [px of the working image]
_PARALLAX_PRIOR = (1.0, 2.0, 2.0)  # tracks that say there is none, and that it does not grow
_MOST_BEND = 6.0  # (width / f)^2 of the widest view: 101 degrees
_NO_BEND = np.diag([0.0, 0.0, 0.0, 0.0, 1e-9])  # keeps the fit regular where nothing moves
_MOST_WIDTHS = 2.5  # from the centre, in image widths: about 70 degrees off the axis of a usual lens
_LEAST_DEPTH = 0.3  # in one step; a place behind the camera would come back from the other side
_REACH = 0.3  # of the parallax correction, over the image's width
_BRIGHTER = 0.05  # log change of the exposure from which the flow is computed again without it


@dataclass(frozen=True, eq=False)
class Motion:
    """Image motion between two frames.

    matrix: (2, 3) similarity, new from old pixels. points, residuals: (n, 2) old pixels of the static tracks and what
    they moved beyond the similarity [px]. trusted: whether enough of the image moves alike. share: of the tracks.
    centre: (2,) of the image [px]. bend: (2,) by which a turn of the camera makes it a homography [1/px], 0 in a
    similarity.
    """

    matrix: Floats
    points: Floats
    residuals: Floats
    trusted: bool
    share: float
    centre: Floats = field(default_factory=lambda: np.zeros(2))
    bend: Floats = field(default_factory=lambda: np.zeros(2))

    @property
    def zoom(self) -> float:
        """Change of scale."""
        return float(np.hypot(self.matrix[0, 0], self.matrix[1, 0]))

    def moved(self, box: OrientedBox) -> OrientedBox:
        """A box turned and sized with the scene, about the same centre."""
        return box.sized(box.sides * self.zoom).turned(float(np.arctan2(self.matrix[1, 0], self.matrix[0, 0])))

    def followed(self, place: OrientedBox, reach: float) -> OrientedBox | None:
        """A box about a place of the static scene, moved with it; see ``at``. None where the motion is not trusted."""
        return self.moved(place.at(self.at(place.centre, reach))) if self.trusted else None

    def at(self, point: Floats, reach: float) -> Floats:
        """Where the static scene at ``point`` (2,) [px] has moved, with the parallax of the tracks within ``reach``."""
        if not self.trusted or len(self.points) < _MIN_TRACKS:
            return np.asarray(self._base(point[None])[0])
        inside = (np.abs(point - self.centre) <= self.centre).all()
        return self._with_parallax(point, reach) if inside else self.turned._with_parallax(point, reach)

    def _with_parallax(self, point: Floats, reach: float) -> Floats:
        near = (self.points - point) / reach
        weight = kept = np.exp(-0.5 * np.square(near).sum(axis=1))
        model = np.column_stack([np.ones(len(near)), near])  # on a plane seen obliquely, parallax grows linearly
        for _ in range(3):
            normal = model.T @ (weight[:, None] * model) + np.diag(_PARALLAX_PRIOR)
            correction = np.linalg.solve(normal, model.T @ (weight[:, None] * self.residuals))
            misfit = np.square(self.residuals - model @ correction).sum(axis=1)
            weight = kept / (1.0 + misfit / (4.0 * max(middle(misfit), 0.04)))
        return np.asarray(self._base(point[None])[0] + correction[0])

    def _base(self, points: Floats) -> Floats:
        """Points (n, 2) moved by the similarity and its bend, without parallax."""
        linear = self.matrix[:, :2]
        similar = points @ linear.T + self.matrix[:, 2]
        moved: Floats = similar
        origin = linear @ self.centre + self.matrix[:, 2] - self.centre
        for _ in range(2 if self.bend.any() else 0):
            # Beyond the limit, the bend is that at the limit: half way, so that it is undone on the way back.
            radius = np.maximum(np.hypot(*(0.5 * (points + moved) - self.centre).T), 1.0)[:, None]
            offset = (points - self.centre) * np.minimum(1.0, _MOST_WIDTHS * 2.0 * self.centre[0] / radius)
            depth = np.maximum(1.0 - offset @ self.bend, _LEAST_DEPTH)[:, None]
            moved = similar + (offset @ linear.T + origin) * (1.0 / depth - 1.0)
        return np.asarray(moved)

    @cached_property
    def turned(self) -> Motion:
        """As the homography of a camera that turns and zooms, fitted to the same tracks.

        With pixels p, q from the centre it is q = (A p + t) / (1 - k p A^-1 t) for a similarity A, t and k = 1/f^2 of
        the focal length f, as K' R K^-1 is to the second order in the turn. A turn shifts an image by t and bends it
        by k t alone, so that far outside the image one unknown is enough, which any step of a pan measures.
        """
        p, moved = self.points - self.centre, self.points @ self.matrix[:, :2].T + self.matrix[:, 2] + self.residuals
        q, linear = moved - self.centre, self.matrix[:, :2]
        shift = self.matrix[:, 2] + linear @ self.centre - self.centre
        x, y = np.eye(2)
        similar = [np.outer(p[:, 0], x) + np.outer(p[:, 1], y), np.outer(p[:, 0], y) - np.outer(p[:, 1], x)]
        model = np.stack([*similar, *(np.broadcast_to(axis, p.shape) for axis in (x, y)), q], axis=2)
        weight: Floats = np.ones(len(p))
        for _ in range(3):
            slope = np.linalg.solve(linear, shift)
            model[:, :, 4] = (p @ slope)[:, None] * q
            weighted = (weight[:, None, None] * model).reshape(-1, 5)
            rows = model.reshape(-1, 5)
            normal, right = weighted.T @ rows + _NO_BEND, weighted.T @ q.ravel()
            found: Floats = np.asarray(np.linalg.solve(normal, right), np.float64)
            bent = float(np.clip(found[4], 0.0, _MOST_BEND / (2.0 * self.centre[0]) ** 2))
            if bent != found[4]:
                found = np.append(np.linalg.solve(normal[:4, :4], right[:4] - normal[:4, 4] * bent), bent)
            misfit = np.square(q - model @ found).sum(axis=1)
            weight = 1.0 / (1.0 + misfit / (4.0 * max(middle(misfit), 0.04)))
            linear, shift = np.array([[found[0], -found[1]], [found[1], found[0]]]), found[2:4]
        matrix = np.column_stack([linear, shift + self.centre - linear @ self.centre])
        motion = replace(self, matrix=matrix, bend=found[4] * np.linalg.solve(linear, shift))
        return replace(motion, residuals=moved - motion._base(self.points))


STILL = Motion(np.eye(2, 3), np.zeros((0, 2)), np.zeros((0, 2)), False, 0.0)


def middle(values: Floats) -> float:
    """The upper median: numpy's own takes ten times as long for a hundred values."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def _times(gray: Gray, factor: float) -> Gray:
    return np.asarray(cv2.convertScaleAbs(gray, alpha=factor), np.uint8)


class SceneMotion:
    """Estimates the motion from image to image. size: (width, height) [px]."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._scale = max(1.0, size[0] / _WORKING_WIDTH)
        self._size = (round(size[0] / self._scale), round(size[1] / self._scale))
        self._gray: Gray | None = None
        self._burnt_in = BurntIn(self._size)
        self.photometric = PhotometricGain(1)
        self._last, self._followed = np.eye(2, 3), True
        self.reach = _REACH * size[0]
        """Distance over which parallax is taken to be alike [px]."""

    def update(self, image: Image, excluded: Floats | None) -> Motion:
        """The motion since the last image. excluded: x0, y0, x1, y1 of the moving target in the last image [px]."""
        small = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        while small.shape[1] >= _HALVED * self._size[0]:  # of ultra-HD, in a third of the time
            small = cv2.resize(small, (small.shape[1] // 2, small.shape[0] // 2), interpolation=cv2.INTER_AREA)
        gray = np.asarray(cv2.resize(small, self._size, interpolation=cv2.INTER_AREA), np.uint8)
        previous, self._gray = self._gray, gray
        if previous is None:
            self.photometric.update(gray, np.zeros((0, 2)), np.zeros((0, 2)))
            return STILL
        plain, previous, gray = (previous, gray), self._filled(previous), self._filled(gray)
        corners = self._corners(previous, excluded)
        motion, gain = STILL, self.photometric.gain
        if len(corners) >= _MIN_TRACKS:
            motion = self._fit(*self._flow(previous, gray, corners, self._last))
            if not motion.trusted:
                like = _times(gray, cv2.mean(previous)[0] / max(cv2.mean(gray)[0], 1.0))
                coarse = self._coarse_shift(previous, gray)
                motion = max(motion, self._fit(*self._flow(previous, like, corners, coarse)), key=lambda one: one.share)
                if self._followed and not motion.trusted:  # else, as over plain water, it would cost as much again
                    motion = max(motion, self._fit(*self._matched(previous, like)), key=lambda one: one.share)
        if not motion.trusted:
            self._burnt_in.restart()
        elif self._burnt_in.contradicts(gray, self._to_working(motion.matrix)):
            motion = self._without_burnt_in(*plain, excluded, motion)
        self.photometric.update(gray, *self._working_tracks(motion))
        change = float((gain / self.photometric.gain)[0])
        if motion.trusted and abs(np.log(change)) > _BRIGHTER:
            tracks = self._flow(previous, _times(gray, change), corners, self._to_working(motion.matrix))
            motion = max(motion, self._fit(*tracks), key=lambda one: one.share)
        self._last = self._to_working(motion.matrix) if motion.trusted else np.eye(2, 3)
        self._followed = motion.trusted
        return motion

    def _filled(self, gray: Gray) -> Gray:
        return self._burnt_in.filled(gray, self._burnt_in.mask)

    def _without_burnt_in(self, previous: Gray, gray: Gray, excluded: Floats | None, still: Motion) -> Motion:
        """The motion that corners agree on which do not stand still; ``still`` where there is none."""
        before = self._burnt_in.mask
        self._burnt_in.mask = self._burnt_in.without(stood(*self._working_tracks(still)))
        previous, gray = self._filled(previous), self._filled(gray)
        corners = self._corners(previous, excluded)
        for start in (self._last, self._coarse_shift(previous, gray)):
            motion = self._fit(*self._flow(previous, gray, corners, start)) if len(corners) else STILL
            moves = np.abs(shift(gray, self._to_working(motion.matrix))).max() > 1.0
            if motion.trusted and motion.share > _MOST_STAND and moves:
                return motion
        self._burnt_in.mask = before
        return still

    def _working_tracks(self, motion: Motion) -> tuple[Floats, Floats]:
        """Old and new positions (n, 2) of the static tracks in the working images; none where they are not trusted."""
        if not motion.trusted:
            return np.zeros((0, 2)), np.zeros((0, 2))
        moved = motion.points @ motion.matrix[:, :2].T + motion.matrix[:, 2] + motion.residuals
        return (motion.points + 0.5) / self._scale - 0.5, (moved + 0.5) / self._scale - 0.5

    def _corners(self, gray: Gray, excluded: Floats | None) -> npt.NDArray[np.float32]:
        mask = self._burnt_in.mask.copy()
        if excluded is not None and np.isfinite(excluded).all():
            x0, y0, x1, y1 = (int(v) for v in np.clip(excluded / self._scale, -10, 1e4))
            mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 0
        found = cv2.goodFeaturesToTrack(gray, _MAX_TRACKS, 0.005, max(gray.shape[1] // 36, 5), mask=mask, blockSize=3)
        return np.zeros((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)

    def _flow(self, old: Gray, new: Gray, corners: npt.NDArray[np.float32], start: Floats) -> tuple[Floats, Floats]:
        """Old and new positions (n, 2) of the corners that are tracked forward and back."""
        guess = (corners @ start[:, :2].T + start[:, 2]).astype(np.float32)
        window, flags = (LK_WINDOW, LK_WINDOW), cv2.OPTFLOW_USE_INITIAL_FLOW
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03)
        moved, ok, _ = cv2.calcOpticalFlowPyrLK(
            old, new, corners, guess.copy(), winSize=window, maxLevel=_LK_LEVELS, criteria=criteria, flags=flags
        )
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
            new, old, moved, corners.copy(), winSize=window, maxLevel=1, criteria=criteria, flags=flags
        )
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1)
        good &= np.square(back - corners).sum(axis=1) < _BACKWARD_PX**2
        return corners[good].astype(np.float64), moved[good].astype(np.float64)

    def _matched(self, old: Gray, new: Gray) -> tuple[Floats, Floats]:
        """As ``_flow``, of a picture that zooms or turns in one step: as matched features have it, then by the flow."""
        orb = cv2.ORB.create(_FEATURES, fastThreshold=_FEATURE_STEP)
        (at, bits), (at_new, bits_new) = (orb.detectAndCompute(image, self._burnt_in.mask) for image in (old, new))
        none = np.zeros((0, 2)), np.zeros((0, 2))
        if bits is None or bits_new is None:
            return none
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(bits, bits_new)
        if len(pairs) < _MIN_TRACKS:
            return none
        ends = np.array([at[p.queryIdx].pt for p in pairs]), np.array([at_new[p.trainIdx].pt for p in pairs])
        start, _ = cv2.estimateAffinePartial2D(ends[0], ends[1], ransacReprojThreshold=2.0 * _RANSAC_PX)
        if start is None or abs(np.linalg.det(start[:, :2])) < 1.0 / _MOST_ZOOM**2:
            return none
        # The flow compares windows, which must show the same at the same size.
        seen = np.asarray(cv2.warpAffine(old, start, self._size, borderMode=cv2.BORDER_REPLICATE), np.uint8)
        tracks, moved = self._flow(seen, new, self._corners(seen, None), np.eye(2, 3))
        return (tracks - start[:, 2]) @ np.linalg.inv(start[:, :2]).T, moved

    def _fit(self, old: Floats, new: Floats) -> Motion:
        if len(old) < _MIN_TRACKS:
            return STILL
        # A turn of the camera moves the image by a homography: what it bends is a share of the shift.
        tolerance = 1.0 + _BENT * float(np.median(np.hypot(*(new - old).T))) / _RANSAC_PX
        limit = tolerance * _RANSAC_PX
        matrix, inlier = cv2.estimateAffinePartial2D(
            old, new, method=cv2.RANSAC, ransacReprojThreshold=limit, maxIters=300, confidence=0.995
        )
        if matrix is None:
            return STILL
        mask: Bools = inlier.ravel() > 0
        share = float(mask.mean())
        residual = new - (old @ matrix[:, :2].T + matrix[:, 2])
        near = np.square(residual).sum(axis=1) < (tolerance * _PARALLAX_PX) ** 2
        zoom = float(np.hypot(matrix[0, 0], matrix[1, 0]))
        enough = int(mask.sum()) >= _MIN_TRACKS and share > _MIN_SHARE and self._are_spread(old[mask])
        trusted = bool(enough and 1.0 / _MOST_ZOOM < zoom < _MOST_ZOOM)
        full = self._to_full(np.asarray(matrix, np.float64))
        points = self._scale * (old[near] + 0.5) - 0.5
        centre = 0.5 * (self._scale * np.array(self._size, dtype=np.float64) - 1.0)
        return Motion(full, points, self._scale * residual[near], trusted, share, centre)

    def _are_spread(self, points: Floats) -> bool:
        """Whether points (n, 2) [px of the working image] lie at several places, not on what moves alone."""
        for _ in range(_MIN_PLACES):
            if not len(points):
                return False
            points = points[np.square(points - points[0]).sum(axis=1) > (_PLACE * self._size[0]) ** 2]
        return True

    def _to_full(self, matrix: Floats) -> Floats:
        out = matrix.copy()
        out[:, 2] = self._scale * out[:, 2] + 0.5 * (self._scale - 1.0) * (1.0 - out[:, :2].sum(axis=1))
        return out

    def _to_working(self, matrix: Floats) -> Floats:
        out = matrix.copy()
        out[:, 2] /= self._scale
        return out

    def _coarse_shift(self, old: Gray, new: Gray) -> Floats:
        """(2, 3) translation of a fast pan: parts of the reduced old image are searched in the new one, and vote."""
        small = [cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA) for image in (old, new)]
        rows, columns = small[0].shape[0] // _PARTS[1], small[0].shape[1] // _PARTS[0]
        shifts, scores = [], []
        for k in range(_PARTS[0] * _PARTS[1]):
            x, y = columns * (k % _PARTS[0]), rows * (k // _PARTS[0])
            part = small[0][y : y + rows, x : x + columns]
            _, score, _, at = cv2.minMaxLoc(cv2.matchTemplate(small[1], part, cv2.TM_CCOEFF_NORMED))
            shifts.append((at[0] - x, at[1] - y))
            scores.append(max(score, 0.0) if part.std() > 1.0 else 0.0)
        shift = np.array(shifts, dtype=np.float64)
        agree = np.abs(shift[:, None] - shift[None]).max(axis=2) <= _VOTE_PX
        votes = agree @ np.array(scores)
        chosen = agree[int(votes.argmax())]
        dx, dy = 4.0 * shift[chosen].mean(axis=0)
        return np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
