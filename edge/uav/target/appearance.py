"""Appearance model of the target in a ground-aligned patch that rotates with the car.

Colour is a table of log-likelihood ratios, target against its surroundings; shape is a grey template. Both are
evaluated at every cell of the patch at once; maxima of their mean are the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.correlation.filter import refined
from edge.uav.ground import colour_table
from edge.uav.target.ground_patch import GroundPatch
from protocols.geometry.types import Floats, Image, Singles

_BITS = 5  # per colour channel in the table
_BINS = 1 << _BITS
_SMOOTHING = 0.25  # share of a colour's bin that either neighbour gets
_MAX_LOG_RATIO = 2.5  # of a pixel's colour
_MAX_TARGET_CELLS = 30.0  # the target's length in patch cells
_MIN_TARGET_CELLS = 12.0  # the same, at least: cells of 0.4 m still tell a car's windows from its roof
_MIN_SHAPE_RATIO = 0.75  # to the typical shape response: the same car under other illumination
_BRIGHTNESS = np.array([0.114, 0.587, 0.299])  # of blue, green and red, as in OpenCV's grey
_MIN_BRIGHTNESS_CONTRAST = 4.0  # squared, in variances of the background: two stds stand out from a patterned ground
_LOG_LEVELS = np.log(np.maximum(np.arange(256.0), 8.0))  # darker is noise
_MIN_VISIBLE_SHARE = 0.3  # of the footprint inside the image


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A candidate detection. ground: (2,); score: 1 = as the target typically matches, 0 = as background.

    colour, shape: its responses; visible_share: share of the footprint inside the image; angle: of the patch in which
    it was found [rad]; patch: that patch.
    """

    ground: Floats
    score: float
    colour: float
    shape: float
    visible_share: float
    angle: float = 0.0
    patch: GroundPatch | None = None


class AppearanceModel:
    """Colour and shape of the target, learnt from its first box and adapted at certain detections."""

    def __init__(self, length: float, width: float, cell_size: float) -> None:
        """length, width: footprint along and across the patch's x axis; cell_size: of a cell [ground units]."""
        self.length, self.width = length, width
        self.cell_size = float(
            np.clip(cell_size, max(length, width) / _MAX_TARGET_CELLS, max(length, width) / _MIN_TARGET_CELLS)
        )
        self._make_masks()
        self._target_histogram: Floats = np.zeros(_BINS**3)
        self._first_histogram: Floats | None = None
        self._background_histogram: Floats = np.zeros(_BINS**3)
        self._log_ratio_table: Singles = np.zeros(_BINS**3, np.float32)
        self._template: Singles | None = None
        self._first_template: Singles | None = None
        self._channel: Singles | None = None  # weights (1, 3) of blue, green and red; None: brightness
        self.colour_scale = 1.0
        self._shape_scale = 0.9

    def _make_masks(self) -> None:
        """Weights over the cells of the footprint and of the ring around it."""
        half = self.template_half
        nx, ny = (round(h / self.cell_size) for h in half)
        x = np.abs(np.arange(-nx, nx + 1)) * self.cell_size / (self.length / 2.0)
        y = np.abs(np.arange(-ny, ny + 1)) * self.cell_size / (self.width / 2.0)
        soft = 0.5 * self.cell_size
        inside = np.clip((1.0 - x) * self.length / 2.0 / soft + 0.5, 0, 1)[None, :]
        inside = inside * np.clip((1.0 - y) * self.width / 2.0 / soft + 0.5, 0, 1)[:, None]
        # A car's corners are round, and a box drawn by hand is too large.
        r4 = (x[None, :] ** 4 + y[:, None] ** 4) * 0.9
        self._target_mask = (inside * np.clip(1.6 - r4, 0.0, 1.0)).astype(np.float32)
        ring = np.clip(1.0 - inside - 0.25, 0.0, 1.0)
        self._ring_mask = ring.astype(np.float32)
        self._shares: dict[tuple[int, ...], tuple[Singles, Singles]] = {}  # in view, of target and ring, by patch size

    @property
    def template_half(self) -> tuple[float, float]:
        """Half size of the template [ground units], footprint and ring."""
        margin = 0.22 * min(self.length, self.width) + 1.5 * self.cell_size
        return self.length / 2.0 + margin, self.width / 2.0 + margin

    def reshape(self, length: float, width: float) -> None:
        """Change the footprint (to the car's own, once its heading is known); the colour model is kept."""
        self.length, self.width = length, width
        self._make_masks()
        self._template = self._first_template = None

    def rescale(self, factor: float) -> None:
        """Ground units became smaller by ``factor``: lengths grow, the cells stay the same."""
        self.length, self.width, self.cell_size = self.length * factor, self.width * factor, self.cell_size * factor
        self._make_masks()
        self._resize_templates()

    def reset(self) -> None:
        """Start over with the next ``learn``."""
        self._first_histogram = self._template = self._first_template = None

    def set_cell_size(self, cell_size: float) -> None:
        """Change the resolution when the target's size in the image changed; the templates are resampled."""
        longer = max(self.length, self.width)
        wanted = float(np.clip(cell_size, longer / _MAX_TARGET_CELLS, longer / _MIN_TARGET_CELLS))
        if 0.7 < wanted / self.cell_size < 1.4:
            return
        self.cell_size = wanted
        self._make_masks()
        self._resize_templates()

    def _resize_templates(self) -> None:
        size = self._target_mask.shape[::-1]
        for name in ("_template", "_first_template"):
            old = getattr(self, name)
            if old is not None and old.shape[::-1] != size:
                setattr(self, name, cv2.resize(old, size, interpolation=cv2.INTER_AREA))

    def learn(self, patch: GroundPatch, centre: Floats, rate: float, moving: bool = False) -> None:
        """Update from the target at ``centre`` (2,) ground in a patch.

        rate: 1 = replace the model. moving: whether the target's motion is known, which tells it from the ground.
        """
        nx, ny = self._target_mask.shape[1] // 2, self._target_mask.shape[0] // 2
        at = patch.to_cells(centre[None])[0]
        template_size = (2 * nx + 1, 2 * ny + 1)
        cells = cv2.getRectSubPix(patch.cells, template_size, (float(at[0]), float(at[1])))
        ix, iy = round(float(at[0])) - nx, round(float(at[1])) - ny
        height, width = patch.valid.shape
        target_weight = np.zeros((height, width))
        x0, y0, x1, y1 = max(ix, 0), max(iy, 0), min(ix + template_size[0], width), min(iy + template_size[1], height)
        if x1 <= x0 or y1 <= y0:
            return
        target_weight[y0:y1, x0:x1] = self._target_mask[y0 - iy : y1 - iy, x0 - ix : x1 - ix]
        outside = np.ones((height, width))
        outside[y0:y1, x0:x1] = self._ring_mask[y0 - iy : y1 - iy, x0 - ix : x1 - ix]
        weights = target_weight * patch.valid, outside * patch.valid
        totals = [float(part.sum()) for part in weights]
        if min(totals) <= 0.0:
            return
        target_sample, background_sample = (
            colour_table.histogram(patch.cells, part / total, _BITS, _SMOOTHING)
            for part, total in zip(weights, totals, strict=True)
        )
        if self._first_histogram is None or rate > 0.5:
            self._first_histogram = self._target_histogram = target_sample
            self._background_histogram = background_sample
        else:
            self._target_histogram = (1 - rate) * self._target_histogram + rate * target_sample
            self._background_histogram = (1 - 2 * rate) * self._background_histogram + 2 * rate * background_sample
        target_histogram = 0.35 * self._first_histogram + 0.65 * self._target_histogram
        floor = 2e-5
        ratio = np.log((target_histogram + floor) / (self._background_histogram + floor))
        self._log_ratio_table = np.clip(ratio, -_MAX_LOG_RATIO, _MAX_LOG_RATIO).astype(np.float32)
        if rate >= 1.0 or self._template is None:
            self._channel = _separating_channel(patch.cells, weights[0] / totals[0], weights[1] / totals[1])
        grey = self._grey(np.asarray(cells, np.uint8))
        if not moving:
            # What lies around stays behind on the ground, and would hold the template there; its mean level is enough.
            level = np.float32((grey * self._ring_mask).sum() / self._ring_mask.sum())
            grey = level + self._target_mask * (grey - level)
        if self._template is None or self._first_template is None:
            self._template = self._first_template = grey
        else:
            # Mean brightness is not part of the shape.
            shift = float(grey.mean()) - float(self._template.mean())
            self._template = ((1 - rate) * (self._template + shift) + rate * grey).astype(np.float32)

    def calibrate(self, colour: float, shape: float, rate: float) -> None:
        """Update the typical colour and shape responses, for which the score is 1."""
        self.colour_scale = (1 - rate) * self.colour_scale + rate * max(colour, 0.15)
        self._shape_scale = (1 - rate) * self._shape_scale + rate * max(shape, 0.3)

    def log_brightness(self, patch: GroundPatch, centre: Floats) -> float:
        """Mean log intensity of the footprint over all channels, of a target at ``centre`` (2,) ground."""
        ky, kx = self._target_mask.shape
        at = patch.to_cells(centre[None])[0]
        cells = cv2.getRectSubPix(patch.cells, (kx, ky), (float(at[0]), float(at[1])))
        levels = _LOG_LEVELS[cells].mean(axis=2)
        return float((levels * self._target_mask).sum() / float(self._target_mask.sum()))

    def shape_matches(self, candidate: Candidate) -> bool:
        """Whether the shape response is close to the typical one, whatever the colour."""
        return candidate.shape > _MIN_SHAPE_RATIO * self._shape_scale

    def colour_log_ratios(self, cells: Image) -> Singles:
        """Log-likelihood ratio (h, w) of each cell's colour."""
        return colour_table.values(self._log_ratio_table, cells, _BITS)

    def candidates(self, patch: GroundPatch, limit: int = 6, min_score: float = 0.3) -> list[Candidate]:
        """Local maxima of the score in the patch, the best first."""
        ky, kx = self._target_mask.shape
        height, width = patch.valid.shape
        if height < 3 or width < 3:
            return []
        border = (ky // 2, ky // 2, kx // 2, kx // 2)
        ratio = _padded(self.colour_log_ratios(patch.cells) * patch.valid, border)
        valid = _padded(patch.valid, border)
        total, ring_total = float(self._target_mask.sum()), float(self._ring_mask.sum())
        if patch.complete and patch.valid.shape in self._shares:
            visible, seen_ring = self._shares[patch.valid.shape]
        else:
            visible = np.maximum(_correlate(valid, self._target_mask) / total, 0.0)
            seen_ring = np.maximum(_correlate(valid, self._ring_mask) / ring_total, 0.0)
            if patch.complete:
                self._shares[patch.valid.shape] = visible, seen_ring
        inner = _correlate(ratio, self._target_mask) / (total * np.maximum(visible, 0.2))
        outer = _correlate(ratio, self._ring_mask) / (ring_total * np.maximum(seen_ring, 0.2))
        colour = inner - 0.5 * outer
        shape = self._shape_response(patch, border)
        relative_colour = np.clip(colour / self.colour_scale, -0.5, 1.1)
        relative_shape = np.clip(shape / self._shape_scale, -0.5, 1.1)
        score = np.where(visible > _MIN_VISIBLE_SHARE, 0.5 * relative_colour + 0.5 * relative_shape, -1.0).astype(
            np.float32
        )
        around = np.ones((max(3, ky // 3 | 1), max(3, kx // 3 | 1)), np.uint8)
        peak = (score >= cv2.dilate(score, around)) & (score > min_score)
        rows, columns = np.nonzero(peak)
        order = np.argsort(score[rows, columns], kind="stable")[::-1]
        min_distance = 0.2 * (kx + ky)
        found: list[Candidate] = []
        taken: list[tuple[int, int]] = []
        for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
            if any((row - r) ** 2 + (column - c) ** 2 < min_distance * min_distance for r, c in taken):
                continue
            taken.append((row, column))
            dx, dy = _subcell(score, row, column)
            ground = patch.to_ground(np.array([[column + dx, row + dy]]))[0]
            at_score, at_colour, at_shape, share = (
                float(field[row, column]) for field in (score, colour, shape, visible)
            )
            found.append(Candidate(ground, at_score, at_colour, at_shape, share, patch.angle, patch))
            if len(found) == limit:
                break
        return found

    def _grey(self, cells: Image) -> Singles:
        """The one channel (h, w) of the shape."""
        if self._channel is None:
            return np.asarray(cv2.cvtColor(cells, cv2.COLOR_BGR2GRAY), np.float32)
        return np.asarray(cv2.transform(cells.astype(np.float32), self._channel), np.float32)

    def _shape_response(self, patch: GroundPatch, border: tuple[int, int, int, int]) -> Singles:
        """Normalised cross-correlation with the template, maximum over the first and the adapted one."""
        best = np.zeros(patch.valid.shape, np.float32)
        if self._template is None or self._first_template is None:
            return best
        grey = self._grey(patch.cells)
        if patch.complete:
            grey = np.asarray(cv2.copyMakeBorder(grey, *border, cv2.BORDER_REPLICATE), np.float32)
        else:
            valid, grey = _padded(patch.valid, border), _padded((grey - float(grey.mean())) * patch.valid, border)
            sums = _visible_sums(grey, valid, self._template.shape)
        for number, template in enumerate((self._template, self._first_template)):
            if number and template is self._template:
                break
            if patch.complete:
                found = _correlate(grey, template, cv2.TM_CCOEFF_NORMED)
            else:
                found = _masked_correlation(grey, valid, sums, template)
            best = np.maximum(best, found) if number else found
        return np.where(np.isfinite(best), best, np.float32(0.0))


def _separating_channel(cells: Image, target: Floats, background: Floats) -> Singles | None:
    """Weights (1, 3) of the colours in which a target stands out, where it does not by brightness, else None.

    Its mean squared difference from the background's mean, in variances of the background, is the greatest: what is
    inside of a target, such as a car's windows, counts as its outline does. target, background: weights (h, w), sum 1,
    of the cells (h, w, 3).
    """
    colours = cells.reshape(-1, 3) - background.ravel() @ cells.reshape(-1, 3)
    moments = [(colours * weights.reshape(-1, 1)).T @ colours for weights in (target, background)]
    whitened = np.linalg.inv(np.linalg.cholesky(moments[1] + np.eye(3)))  # one grey level: below is noise
    _, vectors = np.linalg.eigh(whitened @ moments[0] @ whitened.T)
    by_brightness = _BRIGHTNESS @ moments[0] @ _BRIGHTNESS / (_BRIGHTNESS @ (moments[1] + np.eye(3)) @ _BRIGHTNESS)
    if by_brightness >= _MIN_BRIGHTNESS_CONTRAST:
        return None
    best = vectors[:, -1] @ whitened
    return np.asarray(best / np.abs(best).sum(), np.float32)[None]


def _correlate(field: Singles, kernel: Singles, method: int = cv2.TM_CCORR) -> Singles:
    return np.asarray(cv2.matchTemplate(field, kernel, method), np.float32)


def _padded(field: Singles, border: tuple[int, int, int, int]) -> Singles:
    return np.asarray(cv2.copyMakeBorder(field, *border, cv2.BORDER_CONSTANT, value=0.0), np.float32)


def _visible_sums(field: Singles, valid: Singles, shape: tuple[int, ...]) -> list[Singles]:
    """Number of visible cells below a template of this shape, sum and sum of squares of ``field``."""
    inner = np.s_[shape[0] // 2 : -(shape[0] // 2), shape[1] // 2 : -(shape[1] // 2)]
    parts = (cv2.boxFilter(one, -1, shape[::-1], normalize=False)[inner] for one in (valid, field, field * field))
    return [np.asarray(one, np.float32) for one in parts]


def _masked_correlation(field: Singles, valid: Singles, sums: list[Singles], template: Singles) -> Singles:
    """Normalised correlation over the visible cells. field: 0 where ``valid`` is 0; same output size as CCORR."""
    centred = template - float(template.mean())
    n, image, image2 = np.maximum(sums[0], 1.0), *sums[1:]
    mean, mean2 = _correlate(valid, centred), _correlate(valid, centred * centred)
    cross = _correlate(field, centred) - image * mean / n
    spread = np.maximum(image2 - image * image / n, 0.0) * np.maximum(mean2 - mean * mean / n, 0.0)
    # Contrast below one grey level is noise.
    return np.asarray(cross / np.sqrt(np.maximum(spread, n * n)), np.float32)


def _subcell(score: Singles, row: int, column: int) -> tuple[float, float]:
    """Offset of the maximum from its cell, by a parabola along each axis, within half a cell."""
    height, width = score.shape
    dx = refined(score[row], column) if 0 < column < width - 1 else 0.0
    return dx, refined(score[:, column], row) if 0 < row < height - 1 else 0.0
