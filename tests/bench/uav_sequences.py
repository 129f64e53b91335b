"""Sequences for the any-view bench: recordings with boxes, windows that pan away from a target and back, and worlds."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from protocols.geometry.types import Floats, Image

AWAY_S = (0.5, 1.0, 2.0, 4.0)
"""Lengths of the absences [s]."""
_PAN_S = 0.6  # of the pan to the side, and of the pan back
_MARGIN = 0.25  # of a box side between the target and the window while away


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """Images with a target. box: (n, 4) x, y, width, height [px], nan where not known; fps: frames a second.

    inside: (n,) share of the box within the image; visible: (n,) share of it that is also not occluded.
    """

    name: str
    kind: str
    images: list[Image]
    box: Floats
    fps: float
    visible: Floats

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images [px]."""
        return self.images[0].shape[1], self.images[0].shape[0]


def share_inside(box: Floats, size: tuple[int, int]) -> Floats:
    """Share (n,) of boxes (n, 4) within an image of this size."""
    low = np.maximum(box[:, :2], 0.0)
    high = np.minimum(box[:, :2] + box[:, 2:], np.array(size, dtype=np.float64))
    return np.asarray(np.prod(np.clip(high - low, 0.0, None), axis=1) / np.maximum(np.prod(box[:, 2:], axis=1), 1e-9))


def read_video(file: Path, width: int | None = None, most: int = 10**6) -> tuple[list[Image], float]:
    """Frames, reduced to ``width`` [px] if given, and the factor of the reduction."""
    capture = cv2.VideoCapture(str(file))
    frames: list[Image] = []
    factor = 1.0
    while len(frames) < most:
        found, image = capture.read()
        if not found:
            break
        if width is not None and image.shape[1] != width:
            factor = width / image.shape[1]
            image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        frames.append(np.asarray(image, np.uint8))
    return frames, factor


def oblique(folder: Path, width: int | None = 640, most: int = 300) -> Iterator[Sequence]:
    """The oblique drone videos of the data folder."""
    for file in sorted(folder.glob("*/video.mp4")):
        with (file.parent / "truth.csv").open(newline="") as lines:
            box = np.array([[float(row[key]) for key in "xywh"] for row in csv.DictReader(lines)])
        images, factor = read_video(file, width, most)
        n = min(len(images), len(box))
        box = box[:n] * factor
        images = images[:n]
        size = (images[0].shape[1], images[0].shape[0])
        yield Sequence(file.parent.name, "oblique", images, box, 10.0, share_inside(box, size))


def mirrored(whole: Sequence, factor: float) -> Sequence:
    """A sequence with left and right exchanged, reduced by ``factor``."""
    box = factor * whole.box
    images = [
        cv2.resize(image[:, ::-1], None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) for image in whole.images
    ]
    box[:, 0] = images[0].shape[1] - box[:, 0] - box[:, 2]
    return replace(whole, images=[np.asarray(image, np.uint8) for image in images], box=box)


def barred(whole: Sequence, rows: int = 40) -> Sequence:
    """A sequence between black bars above and below, this many rows high."""
    images = [cv2.copyMakeBorder(image, rows, rows, 0, 0, cv2.BORDER_CONSTANT) for image in whole.images]
    return replace(whole, images=[np.asarray(image, np.uint8) for image in images], box=whole.box + [0.0, rows, 0, 0])


def beneath_reticle(whole: Sequence) -> Sequence:
    """A sequence with a white cross about the middle of the first box, a third of its longer side each way."""
    middle = whole.box[0, :2] + 0.5 * whole.box[0, 2:]
    reach, (x, y) = max(8, round(0.35 * float(whole.box[0, 2:].max()))), np.rint(middle).astype(int).tolist()
    images = [image.copy() for image in whole.images]
    for image in images:
        for colour, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                cv2.line(image, (x + 3 * dx, y + 3 * dy), (x + reach * dx, y + reach * dy), colour, width)
    return replace(whole, images=images)


def zoomed(whole: Sequence, factor: float = 2.0) -> Sequence:
    """A sequence that is zoomed in within one frame after a third of it, the view about the target from then on."""
    size, first = np.array(whole.size, dtype=np.float64), len(whole.images) // 3 + 1
    images, box = list(whole.images), whole.box.copy()
    for k in range(first, len(images)):
        middle = np.clip(box[k, :2] + 0.5 * box[k, 2:], 0.5 * size / factor, size - 0.5 * size / factor)
        matrix = np.column_stack([factor * np.eye(2), 0.5 * size - factor * middle])
        images[k] = np.asarray(cv2.warpAffine(images[k], matrix, whole.size), np.uint8)
        box[k] = [*(factor * box[k, :2] + matrix[:, 2]), *(factor * box[k, 2:])]
    return replace(whole, images=images, box=box, visible=share_inside(box, whole.size) * (whole.visible >= 0.5))


def aerial(folder: Path) -> Iterator[Sequence]:
    """Every car of the aerial-traffic video that stays for all of it; whole frames."""
    images, _ = read_video(folder / "traffic.mp4")
    rows: dict[int, dict[int, list[float]]] = {}
    with (folder / "dfs_ground_truth.csv").open(newline="") as lines:
        for row in csv.reader(lines):
            try:
                frame, track = int(float(row[0])), int(float(row[1]))
                x, y, w, h = (float(value) for value in row[2:6])
            except ValueError:
                continue
            if abs(w) > 5 and abs(h) > 5:
                rows.setdefault(track, {})[frame] = [min(x, x + w), min(y, y + h), abs(w), abs(h)]
    first = min(min(track) for track in rows.values())
    for track, boxes in sorted(rows.items()):
        box = np.full((len(images), 4), np.nan)
        for frame, values in boxes.items():
            if 0 <= frame - first < len(images):
                box[frame - first] = values
        if np.isfinite(box[:, 0]).sum() >= 0.9 * len(images) and np.isfinite(box[0, 0]):
            box = box[: int(np.flatnonzero(np.isfinite(box[:, 0]))[-1]) + 1]  # nothing is known after the last label
            for k in range(4):
                known = np.isfinite(box[:, k])
                box[:, k] = np.interp(np.arange(len(box)), np.flatnonzero(known), box[known, k])
            size = (images[0].shape[1], images[0].shape[0])
            yield Sequence(f"car{track}", "nadir", images[: len(box)], box, 30.0, share_inside(box, size))


def _turned(whole: Sequence, how: str, factor: float) -> Sequence:
    """A sequence whose pictures are turned or mirrored, or shown backwards, and reduced by ``factor``."""
    (width, height), box, way = whole.size, whole.box.copy(), -1 if how == "backwards" else 1
    if how in ("mirrored", "half turn"):
        box[:, 0] = width - box[:, 0] - box[:, 2]
    if how == "half turn":
        box[:, 1] = height - box[:, 1] - box[:, 3]
    if how == "quarter turn":
        box = np.column_stack([height - box[:, 1] - box[:, 3], box[:, 0], box[:, 3], box[:, 2]])
    sides = {"mirrored": (1, -1, 1), "half turn": (-1, -1, 1), "quarter turn": (-1, 1, 1)}.get(how, (1, 1, 1))
    axes = (1, 0, 2) if how == "quarter turn" else (0, 1, 2)
    images = []
    for image in whole.images[::way]:
        seen = np.ascontiguousarray(image[:: sides[0], :: sides[1]].transpose(axes))
        scaled = seen if factor == 1.0 else cv2.resize(seen, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        images.append(np.asarray(scaled, np.uint8))
    return replace(whole, images=images, box=factor * box[::way])


# How the pictures are turned, their factor; first frame, every how many; shift and scale of the first box, in sides;
# seconds before and while away.
VARIANTS = (
    ("as it is", 1.0, 0, 1, 0.0, 1.0, 0.6, 0.5),
    ("as it is", 1.0, 6, 1, 0.0, 1.0, 0.6, 0.5),
    ("mirrored", 1.0, 3, 1, 0.1, 1.0, 0.6, 0.5),
    ("quarter turn", 1.0, 0, 1, 0.0, 1.0, 0.6, 0.5),
    ("backwards", 1.0, 0, 1, 0.0, 1.0, 0.6, 0.5),
    ("as it is", 1.0, 0, 2, 0.0, 1.0, 0.6, 0.5),
    ("half turn", 1.0, 4, 2, 0.0, 1.0, 0.6, 0.5),
    ("as it is", 1.0, 2, 1, 0.0, 1.4, 0.6, 0.5),
    ("mirrored", 1.0, 0, 1, 0.0, 0.7, 0.6, 0.5),
    ("half turn", 0.7, 0, 1, 0.0, 1.0, 0.6, 0.5),
    ("backwards", 1.0, 0, 2, -0.1, 1.0, 0.6, 0.5),
    ("quarter turn", 1.0, 0, 1, 0.0, 1.0, 0.4, 0.8),
)


def varied(folder: Path, part: str) -> Iterator[Sequence]:
    """Windows of the aerial-traffic video in each of ``VARIANTS``; part: of the "even" or the "odd" cars, or "all"."""
    cars = [pair for pair in enumerate(aerial(folder)) if part == "all" or (pair[0] % 2 == 0) == (part == "even")]
    for number, (how, factor, first, every, shift, scale, before, away) in enumerate(VARIANTS):
        for k, car in cars:
            window = pan_away(_turned(car, how, factor), away, (480, 270), before, 31 * number + k, first)
            if window is None:
                continue
            box = window.box[::every].copy()
            sides = box[0, 2:].copy()
            corner = box[0, :2] + (np.array([shift, abs(shift)]) + 0.5 * (1.0 - scale)) * sides
            box[0] = [*corner, *(scale * sides)]
            yield replace(
                window, images=window.images[::every], box=box, visible=window.visible[::every], fps=window.fps / every
            )


def pan_away(
    whole: Sequence, away_s: float, size: tuple[int, int], first_s: float, seed: int, start: int = 0
) -> Sequence | None:
    """A window of the images that follows the target, pans away from it for ``away_s`` and comes back.

    size: of the window [px]. first_s: seconds that it follows before. None where the images are too small or few.
    """
    rng = np.random.default_rng(seed)
    fps = whole.fps
    follow, pan, gone = round(first_s * fps), max(round(_PAN_S * fps), 2), max(round(away_s * fps), 2)
    total = follow + 2 * pan + gone + max(round(2.5 * fps), 25)
    box = whole.box[start : start + total]
    if len(box) < follow + 2 * pan + gone + 22:
        return None
    total = len(box)
    limit = np.array(whole.size) - size
    centre = box[:, :2] + 0.5 * box[:, 2:]
    smooth = np.column_stack(
        [np.convolve(np.pad(centre[:, k], 7, mode="edge"), np.full(15, 1 / 15), "valid") for k in (0, 1)]
    )
    wander = rng.uniform(-0.15, 0.15, 2) * size
    near = np.clip(smooth - 0.5 * np.array(size) + wander, 0, limit)
    # The side on which there is most room to leave the target behind.
    begin, end = follow + pan, follow + pan + gone
    choices = []
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            clear = np.array(size)[axis] * 0.5 + (0.5 + _MARGIN) * box[begin:end, 2 + axis].max()
            far = near.copy()
            far[:, axis] = smooth[:, axis] - 0.5 * size[axis] + side * clear
            far[:, 1 - axis] += rng.uniform(-0.2, 0.2) * size[1 - axis]
            far = np.clip(far, 0, limit)
            moved = np.column_stack([box[:, :2] - far, box[:, 2:]])
            if share_inside(moved[begin:end], size).max() == 0.0:
                choices.append(far)
    if not choices:
        return None
    far = choices[int(rng.integers(len(choices)))]
    t = np.arange(total)
    up = np.clip((t - follow) / pan, 0, 1)
    down = np.clip((t - end) / pan, 0, 1)
    share = (0.5 - 0.5 * np.cos(np.pi * up)) - (0.5 - 0.5 * np.cos(np.pi * down))
    corner = np.rint(near + share[:, None] * (far - near)).astype(int)
    images = [
        np.ascontiguousarray(whole.images[start + i][y : y + size[1], x : x + size[0]])
        for i, (x, y) in enumerate(corner)
    ]
    moved = np.column_stack([box[:, :2] - corner, box[:, 2:]])
    visible = share_inside(moved, size)
    name = f"{whole.name} away {away_s:g} s"
    return Sequence(name, f"{whole.kind} away", images, moved, fps, visible)
