"""How the target looks, in a patch that lies on the ground and turns with the car.

Colour is a table of log-likelihood ratios, target against what is around it; shape is a grey template. Both are
measured at every place of a ground-aligned patch at once, and the places where both agree are the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.ground.image_plane import ImagePlane, transfer
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]
Singles = npt.NDArray[np.float32]

_BITS = 5  # of each colour channel in the table
_BINS = 1 << _BITS
_CLIP = 2.5  # of a pixel's log-likelihood ratio
_LONGEST = 30.0  # target's length in patch cells
_SHORTEST = 12.0
_LARGEST_PATCH = 200  # cells a side
_SHAPED = 0.75  # of the usual shape response: the same car in another light
_LEAST_SEEN = 0.3  # share of the footprint in the picture


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A piece of ground seen from above. cells: (h, w, 3) picture; valid: (h, w) 0..1, what the camera sees of it.

    centre: (2,) ground; angle: of the patch's x axis on the ground [rad]; pitch: ground units a cell.
    """

    cells: Picture
    valid: Singles
    centre: Floats
    angle: float
    pitch: float
    whole: bool

    def ground(self, cells: Floats) -> Floats:
        """Ground points (n, 2) of cell coordinates (n, 2): x right, y down, 0 = centre of the first cell."""
        height, width = self.valid.shape
        local = (cells - [(width - 1) / 2.0, (height - 1) / 2.0]) * self.pitch
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.asarray(local @ np.array([[c, s], [-s, c]]) + self.centre)

    def relit(self, cells: Picture) -> Patch:
        """The same piece of ground with other colours."""
        return replace(self, cells=cells)

    def at(self, ground: Floats) -> Floats:
        """Cell coordinates (n, 2) of ground points (n, 2)."""
        height, width = self.valid.shape
        c, s = np.cos(self.angle), np.sin(self.angle)
        local = (ground - self.centre) @ np.array([[c, -s], [s, c]])
        return np.asarray(local / self.pitch + [(width - 1) / 2.0, (height - 1) / 2.0])


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place that looks like the target. ground: (2,); score: 1 = as the target always looks, 0 = as background.

    colour, shape: its parts; seen: share of the footprint inside the picture; angle: of the patch that it was found
    in [rad].
    """

    ground: Floats
    score: float
    colour: float
    shape: float
    seen: float
    angle: float = 0.0


def cut_patch(
    image: Picture,
    plane: ImagePlane,
    matrix: Floats,
    centre: Floats,
    angle: float,
    half: tuple[float, float],
    pitch: float,
) -> Patch | None:
    """The ground patch about ``centre`` (2,), of half sizes ``half`` along and across ``angle``; None if not in view.

    matrix: (3, 3) normalised image from ground. pitch: ground units a cell; made coarser for a huge patch.
    """
    pitch = max(pitch, 2.0 * max(half) / _LARGEST_PATCH)
    width, height = (2 * int(np.ceil(h / pitch)) + 1 for h in half)
    empty = Patch(
        np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32), centre, angle, pitch, False
    )
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    pixels = plane.pixels(transfer(matrix, empty.ground(corners)))
    if not np.isfinite(pixels).all() or float(np.abs(pixels).max()) > 1e5:
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    if high[0] < 0 or high[1] < 0 or low[0] > plane.width - 1 or low[1] > plane.height - 1:
        return None
    image_from_cell = cv2.getPerspectiveTransform(corners.astype(np.float32), pixels.astype(np.float32))
    # Pixels a cell decide whether the picture must be averaged first.
    area = abs(float(cv2.contourArea(pixels.astype(np.float32)))) / max((width - 1) * (height - 1), 1)
    coarse = int(np.clip(round(np.sqrt(max(area, 1e-6))), 1, 16))
    if coarse > 1:
        x0, y0 = (max(int(v) - 2 * coarse, 0) for v in low)
        x1, y1 = min(int(high[0]) + 2 * coarse, plane.width), min(int(high[1]) + 2 * coarse, plane.height)
        size = ((x1 - x0) // coarse, (y1 - y0) // coarse)
        if min(size) < 2:
            return None
        image = np.asarray(
            cv2.resize(
                image[y0 : y0 + size[1] * coarse, x0 : x0 + size[0] * coarse], size, interpolation=cv2.INTER_AREA
            )
        )
        shrink = np.array(
            [[1 / coarse, 0, (0.5 - x0) / coarse - 0.5], [0, 1 / coarse, (0.5 - y0) / coarse - 0.5], [0, 0, 1.0]]
        )
        image_from_cell = shrink @ image_from_cell
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cells = cv2.warpPerspective(image, image_from_cell, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    whole = bool(plane.inside(pixels, 1.0).all())
    if whole:
        valid = np.ones((height, width), np.float32)
    else:
        full = np.ones(image.shape[:2], np.float32)
        seen = cv2.warpPerspective(full, image_from_cell, (width, height), flags=flags)
        valid = (seen > 0.75).astype(np.float32)
    return Patch(np.asarray(cells, dtype=np.uint8), np.asarray(valid, np.float32), centre, angle, pitch, whole)


class Appearance:
    """What the target looks like, learnt from its first box and adapted while it is surely seen."""

    def __init__(self, length: float, width: float, pitch: float) -> None:
        """length, width: footprint along and across the patch's x axis [ground units]; pitch: ground units a cell."""
        self.length, self.width = length, width
        self.pitch = float(np.clip(pitch, max(length, width) / _LONGEST, max(length, width) / _SHORTEST))
        self._make_masks()
        self._target: Floats = np.zeros(_BINS**3)
        self._first: Floats | None = None
        self._around: Floats = np.zeros(_BINS**3)
        self._table: Singles = np.zeros(_BINS**3, np.float32)
        self._template: Singles | None = None
        self._anchor: Singles | None = None
        self._colour_scale = 1.0
        self._shape_scale = 0.9

    def _make_masks(self) -> None:
        """Weights over the cells of the footprint and of the ring about it; both add up to 1."""
        half = self.template_half
        nx, ny = (round(h / self.pitch) for h in half)
        x = np.abs(np.arange(-nx, nx + 1)) * self.pitch / (self.length / 2.0)
        y = np.abs(np.arange(-ny, ny + 1)) * self.pitch / (self.width / 2.0)
        soft = 0.5 * self.pitch
        inside = np.clip((1.0 - x) * self.length / 2.0 / soft + 0.5, 0, 1)[None, :]
        inside = inside * np.clip((1.0 - y) * self.width / 2.0 / soft + 0.5, 0, 1)[:, None]
        # A car's corners are round, and a box drawn by hand is generous.
        r4 = (x[None, :] ** 4 + y[:, None] ** 4) * 0.9
        self._inside = (inside * np.clip(1.6 - r4, 0.0, 1.0)).astype(np.float32)
        ring = np.clip(1.0 - inside - 0.25, 0.0, 1.0)
        self._ring = ring.astype(np.float32)

    @property
    def template_half(self) -> tuple[float, float]:
        """Half size of the template [ground units], footprint and ring."""
        margin = 0.22 * min(self.length, self.width) + 1.5 * self.pitch
        return self.length / 2.0 + margin, self.width / 2.0 + margin

    def reshape(self, length: float, width: float) -> None:
        """Another footprint (the car's own, once its direction is known); what its colours are stays."""
        self.length, self.width = length, width
        self._make_masks()
        self._template = self._anchor = None

    def rescale(self, factor: float) -> None:
        """Ground units became smaller by ``factor``: everything is that much longer, the cells stay the same."""
        self.length, self.width, self.pitch = self.length * factor, self.width * factor, self.pitch * factor
        self._make_masks()
        self._fit_templates()

    def forget(self) -> None:
        """Begin anew with the next ``learn``."""
        self._first = self._template = self._anchor = None

    def set_pitch(self, pitch: float) -> None:
        """Another resolution, when the picture of the target grew or shrank; the template is resampled."""
        longer = max(self.length, self.width)
        wanted = float(np.clip(pitch, longer / _LONGEST, longer / _SHORTEST))
        if 0.7 < wanted / self.pitch < 1.4:
            return
        self.pitch = wanted
        self._make_masks()
        self._fit_templates()

    def _fit_templates(self) -> None:
        size = self._inside.shape[::-1]
        for name in ("_template", "_anchor"):
            old = getattr(self, name)
            if old is not None and old.shape[::-1] != size:
                setattr(self, name, cv2.resize(old, size, interpolation=cv2.INTER_AREA))

    def learn(self, patch: Patch, centre: Floats, rate: float) -> None:
        """Learn from the target at ``centre`` (2,) ground in a patch. rate: 1 = from now on only this."""
        nx, ny = self._inside.shape[1] // 2, self._inside.shape[0] // 2
        at = patch.at(centre[None])[0]
        size = (2 * nx + 1, 2 * ny + 1)
        cells = cv2.getRectSubPix(patch.cells, size, (float(at[0]), float(at[1])))
        index = self._index(patch.cells).ravel()
        valid: Floats = patch.valid.ravel().astype(np.float64)
        ix, iy = round(float(at[0])) - nx, round(float(at[1])) - ny
        height, width = patch.valid.shape
        target_weight = np.zeros((height, width))
        x0, y0, x1, y1 = max(ix, 0), max(iy, 0), min(ix + size[0], width), min(iy + size[1], height)
        if x1 <= x0 or y1 <= y0:
            return
        target_weight[y0:y1, x0:x1] = self._inside[y0 - iy : y1 - iy, x0 - ix : x1 - ix]
        outside = np.ones((height, width))
        outside[y0:y1, x0:x1] = self._ring[y0 - iy : y1 - iy, x0 - ix : x1 - ix]
        inside = np.bincount(index, target_weight.ravel() * valid, _BINS**3).astype(np.float64)
        around = np.bincount(index, outside.ravel() * valid, _BINS**3).astype(np.float64)
        if inside.sum() <= 0 or around.sum() <= 0:
            return
        inner, outer = _smooth(inside / inside.sum()), _smooth(around / around.sum())
        if self._first is None or rate > 0.5:
            self._first, self._target, self._around = inner, inner, outer
        else:
            self._target = (1 - rate) * self._target + rate * inner
            self._around = (1 - 2 * rate) * self._around + 2 * rate * outer
        target = 0.35 * self._first + 0.65 * self._target
        floor = 2e-5
        ratio = np.log((target + floor) / (self._around + floor))
        self._table = np.clip(ratio, -_CLIP, _CLIP).astype(np.float32)
        grey = cv2.cvtColor(cells, cv2.COLOR_BGR2GRAY).astype(np.float32)
        if self._template is None or self._anchor is None:
            self._template = self._anchor = grey
        else:
            # Brightness of the whole is not shape.
            shift = float(grey.mean()) - float(self._template.mean())
            self._template = ((1 - rate) * (self._template + shift) + rate * grey).astype(np.float32)

    def calibrate(self, colour: float, shape: float, rate: float) -> None:
        """What the target's own colour and shape responses are, so that a score of 1 means "as always"."""
        self._colour_scale = (1 - rate) * self._colour_scale + rate * max(colour, 0.15)
        self._shape_scale = (1 - rate) * self._shape_scale + rate * max(shape, 0.3)

    def brightness(self, patch: Patch, centre: Floats) -> float:
        """Mean logarithm of how bright the footprint is, of a target at ``centre`` (2,) ground, over all channels."""
        ky, kx = self._inside.shape
        at = patch.at(centre[None])[0]
        cells = cv2.getRectSubPix(patch.cells, (kx, ky), (float(at[0]), float(at[1])))
        levels = np.log(np.maximum(cells.astype(np.float64), 8.0)).mean(axis=2)
        return float((levels * self._inside).sum() / float(self._inside.sum()))

    @property
    def colour_scale(self) -> float:
        """The target's usual colour response."""
        return self._colour_scale

    def is_shaped(self, candidate: Candidate) -> bool:
        """Whether its shape is nearly the one that the target always has, whatever the colour."""
        return candidate.shape > _SHAPED * self._shape_scale

    def ratios(self, cells: Picture) -> Singles:
        """Log-likelihood ratio (h, w) of each cell's colour."""
        return self._table[self._index(cells)]

    def candidates(self, patch: Patch, most: int = 6, least: float = 0.3) -> list[Candidate]:
        """Places in the patch that look like the target, the best first."""
        ky, kx = self._inside.shape
        height, width = patch.valid.shape
        if height < 3 or width < 3:
            return []
        border = (ky // 2, ky // 2, kx // 2, kx // 2)
        ratio = _padded(self.ratios(patch.cells) * patch.valid, border)
        valid = _padded(patch.valid, border)
        total, ring_total = float(self._inside.sum()), float(self._ring.sum())
        seen = np.maximum(_correlate(valid, self._inside) / total, 0.0)
        seen_ring = np.maximum(_correlate(valid, self._ring) / ring_total, 0.0)
        inner = _correlate(ratio, self._inside) / (total * np.maximum(seen, 0.2))
        outer = _correlate(ratio, self._ring) / (ring_total * np.maximum(seen_ring, 0.2))
        colour = inner - 0.5 * outer
        shape = self._shape_response(patch, border)
        relative = np.clip(colour / self._colour_scale, -0.5, 1.1)
        like = np.clip(shape / self._shape_scale, -0.5, 1.1)
        score = np.where(seen > _LEAST_SEEN, 0.5 * relative + 0.5 * like, -1.0).astype(np.float32)
        around = np.ones((max(3, ky // 3 | 1), max(3, kx // 3 | 1)), np.uint8)
        peak = (score >= cv2.dilate(score, around)) & (score > least)
        rows, columns = np.nonzero(peak)
        order = np.argsort(score[rows, columns], kind="stable")[::-1]
        apart = 0.2 * (kx + ky)
        found: list[Candidate] = []
        taken: list[tuple[int, int]] = []
        for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
            if any((row - r) ** 2 + (column - c) ** 2 < apart * apart for r, c in taken):
                continue
            taken.append((row, column))
            dx, dy = _subcell(score, row, column)
            ground = patch.ground(np.array([[column + dx, row + dy]]))[0]
            like_it, by_colour, by_shape, share = (float(field[row, column]) for field in (score, colour, shape, seen))
            found.append(Candidate(ground, like_it, by_colour, by_shape, share, patch.angle))
            if len(found) == most:
                break
        return found

    def _shape_response(self, patch: Patch, border: tuple[int, int, int, int]) -> Singles:
        """Normalised correlation with the template, the better of the first and the adapted one."""
        if self._template is None or self._anchor is None:
            return np.zeros(patch.valid.shape, np.float32)
        grey = np.asarray(cv2.cvtColor(patch.cells, cv2.COLOR_BGR2GRAY), np.float32)
        templates = [self._template] if self._anchor is self._template else [self._template, self._anchor]
        if patch.whole:
            grey = np.asarray(cv2.copyMakeBorder(grey, *border, cv2.BORDER_REPLICATE), np.float32)
            found = [cv2.matchTemplate(grey, template, cv2.TM_CCOEFF_NORMED) for template in templates]
        else:
            grey = grey - float(grey.mean())
            valid = _padded(patch.valid, border)
            grey = _padded(grey * patch.valid, border)
            found = [_masked_correlation(grey, valid, template) for template in templates]
        best = np.asarray(found[0] if len(found) == 1 else np.maximum(found[0], found[1]), np.float32)
        return np.nan_to_num(best, nan=0.0, posinf=0.0, neginf=0.0)

    def _index(self, cells: Picture) -> npt.NDArray[np.int64]:
        """Bin (h, w) of each cell's colour."""
        q = (cells >> (8 - _BITS)).astype(np.int32)
        return np.asarray((q[..., 0] << 2 * _BITS) + (q[..., 1] << _BITS) + q[..., 2], dtype=np.int64)


def _smooth(histogram: Floats) -> Floats:
    """A histogram over the cube of colours, smeared by about one bin."""
    cube = histogram.reshape(_BINS, _BINS, _BINS)
    for axis in range(3):
        up = np.roll(cube, 1, axis)
        down = np.roll(cube, -1, axis)
        first = [slice(None)] * 3
        last = [slice(None)] * 3
        first[axis], last[axis] = slice(0, 1), slice(_BINS - 1, _BINS)
        up[tuple(first)], down[tuple(last)] = 0.0, 0.0
        cube = 0.5 * cube + 0.25 * (up + down)
    return np.asarray(cube.ravel())


def _correlate(field: Singles, kernel: Singles) -> Singles:
    return np.asarray(cv2.matchTemplate(field, kernel, cv2.TM_CCORR), np.float32)


def _padded(field: Singles, border: tuple[int, int, int, int]) -> Singles:
    return np.asarray(cv2.copyMakeBorder(field, *border, cv2.BORDER_CONSTANT, value=0.0), np.float32)


def _masked_correlation(field: Singles, valid: Singles, template: Singles) -> Singles:
    """Normalised correlation over the cells that are seen. field: 0 where ``valid`` is 0; same output size as CCORR."""
    centred = template - float(template.mean())
    ones = np.ones_like(template)
    n = np.maximum(_correlate(valid, ones), 1.0)
    image, image2 = _correlate(field, ones), _correlate(field * field, ones)
    mean, mean2 = _correlate(valid, centred), _correlate(valid, centred * centred)
    cross = _correlate(field, centred) - image * mean / n
    spread = np.maximum(image2 - image * image / n, 0.0) * np.maximum(mean2 - mean * mean / n, 0.0)
    # Less than a grey level of contrast is noise.
    return np.asarray(cross / np.sqrt(np.maximum(spread, n * n)), np.float32)


def _subcell(score: Singles, row: int, column: int) -> tuple[float, float]:
    """Offset of the maximum from its cell, by a parabola along each axis, within half a cell."""
    height, width = score.shape
    dx = dy = 0.0
    if 0 < column < width - 1:
        left, middle, right = (float(score[row, column + k]) for k in (-1, 0, 1))
        bend = left - 2 * middle + right
        if bend < -1e-6:
            dx = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
    if 0 < row < height - 1:
        up, middle, down = (float(score[row + k, column]) for k in (-1, 0, 1))
        bend = up - 2 * middle + down
        if bend < -1e-6:
            dy = float(np.clip(0.5 * (up - down) / bend, -0.5, 0.5))
    return dx, dy
