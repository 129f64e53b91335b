"""What a detector's outputs mean: boxes, scores, classes and keypoints of each image, by layout.

Shapes for a batch of B images, N candidates, C classes and K keypoints of V values; P = K·V, or the number of mask
coefficients:

    yolov5     detections (B, N, 5 + C + P): box, objectness, class probabilities, keypoints. YOLOv5, YOLOv7
    yolov8     detections (B, 4 + C + P, N): box, class probabilities, keypoints. YOLOv8, YOLOv9, YOLO11, YOLO12
    yolox      as yolov5, boxes relative to the cells of strides 8, 16 and 32: YOLOX, unless its export decodes them
    end2end    detections (B, N, 6 + P): box, score, class, keypoints. YOLOv10, YOLO26, exports with built-in NMS; or
               (N, 7): index of the image, box, class, score. YOLOv7 with built-in NMS
    detr       scores (B, N, C or C + 1), boxes (B, N, 4): DETR and RT-DETR as Hugging Face exports them, logits and
               pred_boxes; with softmax the last class is *no object*
    separate   boxes (B, N, 4), scores (B, N), labels (B, N): RT-DETR, torchvision

For one image the axis of the batch may be missing in all of them. Of detections the other order of the last two axes is
recognised: there are more candidates than values of each, or as many as YOLOX has cells. Of the last two layouts,
``keypoints`` is (B, N, K, V) or (B, N, P).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.network.description import NetworkDescription
from protocols.core.errors import InputError
from protocols.geometry.types import Floats, Ints

Array = npt.NDArray[Any]
MAX_BOXES = 200
"""Detections in one image; more than the people in any image of the crowd data sets but the densest."""
_MAX_CANDIDATES = 2000
"""Of an image before non-maximum suppression, best first."""
_ROLES = {
    "yolov5": ("detections",),
    "yolov8": ("detections",),
    "yolox": ("detections",),
    "end2end": ("detections",),
    "detr": ("scores", "boxes"),
    "separate": ("boxes", "scores", "labels"),
}
_YOLOX_STRIDES = 8, 16, 32
"""[px] Of the cells; Ge et al. 2021, and the export of the reference implementation."""
_FIRST_CLASS = {"yolov5": 5, "yolov8": 4, "yolox": 5}
_USUAL_NAMES = {("detr", "scores"): "logits", ("detr", "boxes"): "pred_boxes"}


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """The n objects of one image, best first, in pixels of the network's input with (0, 0) the corner of the image.

    corner: (n, 4) left, top, right, bottom. score: (n,). kind: n texts. keypoints: (n, K, 3) u, v, confidence.
    """

    corner: Floats
    score: Floats
    kind: tuple[str, ...]
    keypoints: Floats

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Of one image: boxes (n, 4) as the model gives them, scores (n,), classes (n,), keypoints (n, K, 3)."""

    box: Floats
    score: Floats
    label: Ints
    keypoints: Floats


def decode(
    outputs: Mapping[str, Array],
    description: NetworkDescription,
    images: int,
    kind: str | None,
    file: Path,
    classes: int = 0,
) -> list[Boxes]:
    """The objects in each of the images of a run.

    outputs: of the model, by name. kind: keep only these; None = all. file: of the model, for messages. classes: that
    the model names, 0 = unknown. Raises InputError where the outputs are not what the description says.
    """
    parts = _parts(outputs, description, images, file)
    if classes:
        _check_classes(parts, description, classes, file)
    return [
        _select(
            _CANDIDATES[description.layout]({role: one[k] for role, one in parts.items()}, description, file),
            description,
            kind,
            file,
        )
        for k in range(images)
    ]


def check_grey(outputs: Mapping[str, Array], description: NetworkDescription, images: int, file: Path) -> None:
    """Raise InputError where the outputs for empty images show that the activation is not the layout's usual one.

    With softmax nearly all candidates are then *no object*, the last class; a model without that class has none there.
    """
    if description.layout == "detr" and description.activation is None:
        scores = _parts(outputs, description, images, file)["scores"]
        nothing = float((scores.argmax(axis=-1) == scores.shape[-1] - 1).mean()) if scores.size else 1.0
        if nothing < 0.5:
            what = f'of an empty image {100.0 * nothing:.0f} % of the candidates are "no object", the last class'
            remedy = 'set activation = "sigmoid" in the network\'s .toml file, or "softmax" if this is right'
            raise InputError(what, file=file, remedy=remedy)


def _parts(outputs: Mapping[str, Array], description: NetworkDescription, images: int, file: Path) -> dict[str, Array]:
    """The outputs by role, each (images, N, ...)."""
    layout = description.layout
    roles = _ROLES[layout]
    if "keypoints" in description.outputs or (description.keypoints and len(roles) > 1):
        roles = (*roles, "keypoints")
    named = {}
    for role in roles:
        usual = next(iter(outputs), "") if role == "detections" else _USUAL_NAMES.get((layout, role), role)
        name = description.outputs.get(role, usual)  # type: ignore[call-overload]
        if name not in outputs:
            known = ", ".join(f"{one} {'x'.join(map(str, outputs[one].shape))}" for one in list(outputs)[:8])
            what = f"the model has no output {name!r} for {role}; its outputs are {known}"
            raise InputError(what, file=file, remedy=f'set outputs = {{ {role} = "…" }} in the network\'s .toml file')
        named[role] = outputs[name]
    if layout == "end2end" and named["detections"].shape[1:] == (7,) and not _extra(description):
        named["detections"] = _by_image(named["detections"], images)
    lone = images == 1 and named.get("boxes", named.get("detections", np.zeros(0))).ndim == 2
    parts = {role: _with_batch(values[None] if lone else values, role, images, file) for role, values in named.items()}
    counts = {one.shape[1] for one in parts.values()}
    if len(counts) > 1:
        raise _not_as_described(parts, description, file)
    unused = sorted(set(description.outputs) - set(parts))
    if unused:
        raise InputError(f'outputs.{unused[0]} has no meaning for layout = "{layout}"', file=file, remedy="remove it")
    return parts


def _by_image(rows: Array, images: int) -> Array:
    """Rows (n, 7) of index of the image, box, class, score as (images, N, 6) of box, score, class, zeros behind."""
    groups = [rows[rows[:, 0] == k][:, [1, 2, 3, 4, 6, 5]] for k in range(images)]
    table = np.zeros((images, max(map(len, groups)), 6))
    for k, group in enumerate(groups):
        table[k, : len(group)] = group
    return table


def _check_classes(parts: dict[str, Array], description: NetworkDescription, classes: int, file: Path) -> None:
    """Raise InputError unless the description fits the classes that the model names."""
    remedy = "correct layout, classes, keypoints or mask_coefficients in the network's .toml file"
    highest = max(int(index) for index in description.classes)
    if highest >= classes:
        what = f"class {highest} is beyond the {classes} classes that the model names"
        raise InputError(what, file=file, remedy=remedy)
    first = _FIRST_CLASS.get(description.layout)
    if first is not None:
        expected, shape = first + classes + _extra(description), parts["detections"].shape[1:]
        if expected not in shape:
            what = f'the model gives {min(shape)} values a candidate; layout = "{description.layout}" with the'
            what += f" {classes} classes that it names has {expected}"
            raise InputError(what, file=file, remedy=remedy)


def _extra(description: NetworkDescription) -> int:
    """Numbers of each candidate behind box and classes."""
    return len(description.keypoints) * description.keypoint_values + description.mask_coefficients


def _with_batch(array: Array, role: str, images: int, file: Path) -> Array:
    """An output (images, N, ...). Raises InputError where it is none."""
    dims = {"scores": (2, 3), "labels": (2,), "keypoints": (3, 4)}.get(role, (3,))
    if array.ndim not in dims or array.shape[0] != images:
        shape = "x".join(map(str, array.shape)) or "a single number"
        what = f"the model's output for {role} is {shape} for {images} images"
        raise InputError(what, file=file, remedy="correct layout or outputs in the network's .toml file")
    if not np.issubdtype(array.dtype, np.number):
        raise InputError(f"the model's output for {role} is {array.dtype}", file=file, remedy="export it again")
    return array


def _rows(values: Array, channels_first: bool) -> Array:
    """One image's detections as (N, values): the longer axis is that of the candidates."""
    values_first = values.shape[0] < values.shape[1] or (channels_first and values.shape[0] == values.shape[1])
    return values.T if values_first else values


def _dense(parts: dict[str, Array], description: NetworkDescription, file: Path) -> _Candidates:
    """yolov5, yolov8 and yolox."""
    objectness = description.layout != "yolov8"
    cells = _yolox_cells(*description.input) if description.layout == "yolox" else None
    given = parts["detections"]
    rows = given if cells is not None and len(given) == len(cells) else _rows(given, not objectness)
    begin = _FIRST_CLASS[description.layout]
    end = rows.shape[1] - _extra(description)
    if end <= begin or (cells is not None and len(cells) != len(rows)):
        raise _not_as_described(parts, description, file)
    score, label = _best_class(rows[:, begin:end], description, file)
    if objectness:
        certain = rows[:, 4].astype(np.float64)
        score = score * (_sigmoid(certain) if description.activation == "sigmoid" else certain)
    box = rows[:, :4].astype(np.float64)
    if cells is not None:
        stride = cells[:, 2:]
        box = np.hstack([(box[:, :2] + cells[:, :2]) * stride, np.exp(np.clip(box[:, 2:], -20.0, 20.0)) * stride])
    return _Candidates(box, score, label, _keypoints(rows[:, end:], description))


def _yolox_cells(width: int, height: int) -> Floats:
    """Column, row and stride [px] of the cells (N, 3) of an input, in the order of YOLOX's candidates."""
    grids = [(np.indices((height // stride, width // stride)), stride) for stride in _YOLOX_STRIDES]
    return np.vstack([np.column_stack([x.ravel(), y.ravel(), np.full(x.size, s)]) for (y, x), s in grids]).astype(float)


def _end2end(parts: dict[str, Array], description: NetworkDescription, file: Path) -> _Candidates:
    rows = parts["detections"]
    width = 6 + _extra(description)
    if rows.shape[1] != width:
        rows = rows.T
    if rows.shape[1] != width:
        raise _not_as_described(parts, description, file)
    rows = rows.astype(np.float64)
    return _Candidates(rows[:, :4], rows[:, 4], _whole(rows[:, 5]), _keypoints(rows[:, 6:], description))


def _separate(parts: dict[str, Array], description: NetworkDescription, file: Path) -> _Candidates:
    """detr and separate."""
    boxes, scores = parts["boxes"], parts["scores"]
    if boxes.shape[1:] != (4,) or scores.ndim != (2 if description.layout == "detr" else 1):
        raise _not_as_described(parts, description, file)
    if description.layout == "detr":
        score, label = _best_class(scores, description, file)
    else:
        score, label = scores.astype(np.float64), _whole(parts["labels"].astype(np.float64))
    points = parts.get("keypoints", np.zeros((len(boxes), 0)))
    flat = points.reshape(len(boxes), math.prod(points.shape[1:]))
    if flat.shape[1] != len(description.keypoints) * description.keypoint_values:
        raise _not_as_described(parts, description, file)
    return _Candidates(boxes.astype(np.float64), score, label, _keypoints(flat, description))


_CANDIDATES = {
    "yolov5": _dense,
    "yolov8": _dense,
    "yolox": _dense,
    "end2end": _end2end,
    "detr": _separate,
    "separate": _separate,
}


def _best_class(values: Array, description: NetworkDescription, file: Path) -> tuple[Floats, Ints]:
    """Score and index (n,) of the best class of each candidate. values: (n, C)."""
    highest = max(int(index) for index in description.classes)
    softmax = description.score_activation == "softmax"
    classes = values.shape[1] - softmax  # the last one is "no object"
    if highest >= classes:
        what = f"class {highest} is beyond the model's {classes} classes"
        raise InputError(what, file=file, remedy="correct classes or keypoints in the network's .toml file")
    logits = values.astype(np.float64)
    if softmax:
        logits = np.exp(logits - logits.max(axis=1, keepdims=True))
        logits = logits[:, :-1] / logits.sum(axis=1, keepdims=True)
    label = logits.argmax(axis=1) if len(logits) else np.zeros(0, dtype=np.int64)
    score = logits[np.arange(len(label)), label]
    return (_sigmoid(score) if description.score_activation == "sigmoid" else score), label


def _select(found: _Candidates, description: NetworkDescription, kind: str | None, file: Path) -> Boxes:
    """The candidates of the wanted kinds above the threshold, without those that overlap a better one of their kind."""
    # The sum is not finite where any number is not.
    if not (np.isfinite(found.box.sum()) and np.isfinite(found.score.sum()) and np.isfinite(found.keypoints.sum())):
        raise InputError("the model's outputs are not finite numbers", file=file, remedy="check mean, std and scale")
    if len(found.score) and not (found.score.min() >= -1e-3 and found.score.max() <= 1.001):
        what = f"the model's scores reach {found.score.min():.3g} to {found.score.max():.3g}, not 0 to 1"
        raise InputError(
            what, file=file, remedy='set activation = "sigmoid", or correct layout, keypoints or mask_coefficients'
        )
    kinds = {int(index): one for index, one in description.classes.items() if kind in (None, one)}
    wanted = np.flatnonzero((found.score >= description.score) & np.isin(found.label, list(kinds)))
    wanted = wanted[np.argsort(-found.score[wanted], kind="stable")][:_MAX_CANDIDATES]
    corner = _corners(found.box[wanted], description)
    score = np.clip(found.score[wanted], 0.0, 1.0)
    named = [kinds[int(label)] for label in found.label[wanted]]
    kept = _suppressed(corner, score, named, description)[:MAX_BOXES]
    scale = np.ones(3) if description.in_pixels else np.array([*description.input, 1.0])
    return Boxes(corner[kept], score[kept], tuple(named[k] for k in kept), found.keypoints[wanted][kept] * scale)


def _suppressed(corner: Floats, score: Floats, kinds: Sequence[str], description: NetworkDescription) -> list[int]:
    """Indices, best first, of valid boxes that no better one of their kind overlaps."""
    valid = np.flatnonzero((corner[:, 2:] > corner[:, :2]).all(axis=1))
    if description.greatest_overlap >= 1.0 or not len(valid):
        return [int(k) for k in valid]
    boxes = np.column_stack([corner[valid, :2], corner[valid, 2:] - corner[valid, :2]])
    groups = [int(kinds[int(k)] == "vehicle") for k in valid]
    kept = cv2.dnn.NMSBoxesBatched(boxes.tolist(), score[valid].tolist(), groups, 0.0, description.greatest_overlap)
    return [int(valid[k]) for k in sorted(int(one) for one in np.ravel(kept))]


def _corners(box: Floats, description: NetworkDescription) -> Floats:
    """Left, top, right, bottom (n, 4) [px of the input], limited to what a number in a message may be."""
    if description.box_format == "cxcywh":
        box = np.hstack([box[:, :2] - 0.5 * box[:, 2:], box[:, :2] + 0.5 * box[:, 2:]])
    elif description.box_format == "xywh":
        box = np.hstack([box[:, :2], box[:, :2] + box[:, 2:]])
    if not description.in_pixels:
        box = box * np.tile(np.asarray(description.input, dtype=np.float64), 2)
    return np.clip(box, -1e5, 1e5)


def _keypoints(values: Array, description: NetworkDescription) -> Floats:
    """Keypoints (n, K, 3); where the model gives no confidence it is 1. values: (n, K·V)."""
    count, size = len(description.keypoints), description.keypoint_values
    points = values[:, : count * size].astype(np.float64).reshape(len(values), count, size)
    if description.keypoint_values == 3:
        return points
    return np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)


def _whole(labels: Floats) -> Ints:
    """Class indices; −1 where a number is not one."""
    valid = np.isfinite(labels) & (np.abs(labels) < 1e4)
    return np.where(valid, np.rint(np.where(valid, labels, 0.0)), -1).astype(np.int64)


def _sigmoid(values: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values, -60.0, 60.0))))


def _not_as_described(parts: dict[str, Array], description: NetworkDescription, file: Path) -> InputError:
    shapes = ", ".join(f"{role} {'x'.join(map(str, one.shape))}" for role, one in parts.items())
    what = f'the model\'s outputs ({shapes}) do not fit layout = "{description.layout}"'
    points = f" with {len(description.keypoints)} keypoints" if description.keypoints else ""
    return InputError(
        what + points, file=file, remedy="correct layout, keypoints or outputs in the network's .toml file"
    )
