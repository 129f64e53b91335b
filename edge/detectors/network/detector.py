"""A detector that runs an ONNX network described by a TOML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, DetectorOptions, Prediction
from edge.detectors.network.boxes import BoxLabeller, NetworkBox, seen_keypoints
from edge.detectors.network.decode import Boxes, check_grey, decode
from edge.detectors.network.description import NetworkDescription, read_description
from edge.detectors.network.runtime import Runtime, open_runtime
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.types import Image


@dataclass(frozen=True, slots=True)
class Resize:
    """From the image to the network's input, pixels from the image's corner: input = scale · image + shift, (u, v)."""

    scale: tuple[float, float]
    shift: tuple[int, int]


class NetworkDetector:
    """Detects people and vehicles in the images of one camera with a network.

    runtime: the loaded model; file: of the model, for messages. The model is run once on a grey image, so that one
    which does not fit its description is refused at once: raises InputError. Later, it is refused where its outputs are
    not finite.
    """

    def __init__(self, description: NetworkDescription, runtime: Runtime, file: Path, options: DetectorOptions) -> None:
        self._description = description
        self._runtime = runtime
        self._file = file
        self._options = options
        self._labeller = BoxLabeller(options.prefix, description.box_std)
        self._time = -1.0 / options.fps
        self.batch = runtime.batch or description.batch
        self._singly = self._checked = False
        width, height = description.input
        self._infer([np.full((height, width, 3), description.fill, dtype=np.uint8)])

    @classmethod
    def from_file(cls, file: Path, options: DetectorOptions) -> NetworkDetector:
        """The detector that a TOML file describes. Raises InputError."""
        description = read_description(file)
        model = file.parent / description.model
        runtime = open_runtime(model, description.backend, description.input, description.threads)
        return cls(description, runtime, model, options)

    def detect(
        self, image: Image, time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        found = self._detections(image, self._infer([image])[0], time_s)
        if not predictions:
            return found
        from edge.detectors.moving.tracklets import match_predictions

        return match_predictions(found, predictions)

    def detect_batch(self, images: Sequence[Image], times_s: Sequence[float]) -> list[list[Detection]]:
        """See ``BatchDetector``.

        A model that takes one image at a time, though its file says any number, is given one at a time.
        """
        found = None
        if not self._singly:
            try:
                found = self._infer(images)
            except InputError:
                if len(images) == 1:
                    raise
        if found is None:
            found = [one for image in images for one in self._infer([image])]
            self._singly = True
        return [self._detections(*one) for one in zip(images, found, times_s, strict=True)]

    def _infer(self, images: Sequence[Image]) -> list[tuple[Boxes, Resize]]:
        """What the network finds in each image; a batch of fixed size is filled up with the last one."""
        prepared = [prepare(image, self._description) for image in images]
        step = self._runtime.batch or len(prepared)
        found: list[tuple[Boxes, Resize]] = []
        for begin in range(0, len(prepared), step):
            part = prepared[begin : begin + step]
            inputs = [one for one, _ in part]
            inputs += [inputs[-1]] * (self._runtime.batch - len(inputs))
            outputs = self._runtime.run(np.stack(inputs))
            if not self._checked:
                check_grey(outputs, self._description, len(inputs), self._file)
                self._checked = True
            boxes = decode(
                outputs, self._description, len(inputs), self._options.kind, self._file, self._runtime.classes
            )
            found += [(one, resize) for one, (_, resize) in zip(boxes, part, strict=False)]
        return found

    def _detections(self, image: Image, found: tuple[Boxes, Resize], time_s: float | None) -> list[Detection]:
        now = self._time + 1.0 / self._options.fps if time_s is None else time_s
        self._time = now
        size = image.shape[1], image.shape[0]
        boxes = boxes_in_image(*found, size, self._description.keypoints)
        return list(self._labeller.detections(boxes, round(now * NANOSECONDS), size, image))


def prepare(image: Image, description: NetworkDescription) -> tuple[npt.NDArray[np.float32], Resize]:
    """An image (H, W, 3) uint8 BGR as the network's input (3, height, width), and how it was resized."""
    width, height = description.input
    rows, columns = image.shape[:2]
    scale = width / columns, height / rows
    shift = 0, 0
    inner = width, height
    if description.resize == "letterbox":
        inner = max(round(columns * min(scale)), 1), max(round(rows * min(scale)), 1)
        scale = inner[0] / columns, inner[1] / rows
        shift = (width - inner[0]) // 2, (height - inner[1]) // 2
    method = cv2.INTER_AREA if min(scale) < 0.5 else cv2.INTER_LINEAR
    resized = image if inner == (columns, rows) else cv2.resize(image, inner, interpolation=method)
    if inner != (width, height):
        filled = np.full((height, width, 3), description.fill, dtype=np.uint8)
        filled[shift[1] : shift[1] + inner[1], shift[0] : shift[0] + inner[0]] = resized
        resized = filled
    if description.channels == "rgb":
        resized = resized[:, :, ::-1]
    gain = (description.scale / np.array(description.std)).astype(np.float32)
    bias = (np.array(description.mean) / np.array(description.std)).astype(np.float32)
    planes = np.ascontiguousarray(resized.transpose(2, 0, 1), dtype=np.float32)
    return planes * gain[:, None, None] - bias[:, None, None], Resize(scale, shift)


def boxes_in_image(found: Boxes, resize: Resize, size: tuple[int, int], names: Sequence[str]) -> list[NetworkBox]:
    """The network's boxes in an image of ``size`` (width, height) px, clipped to it; those outside it are left out."""
    shift = np.array(resize.shift, dtype=np.float64)
    corner = ((found.corner.reshape(-1, 2, 2) - shift) / resize.scale).reshape(-1, 4)
    points = found.keypoints.copy()
    points[:, :, :2] = (points[:, :, :2] - shift) / resize.scale
    limit = np.array([*size, *size], dtype=np.float64)
    corner = np.clip(corner, 0.0, limit)
    boxes = []
    for k in np.flatnonzero((corner[:, 2:] - corner[:, :2] >= 1.0).all(axis=1)):
        left, top, right, bottom = (float(one) for one in corner[k])
        box = NetworkBox(found.kind[k], float(found.score[k]), left, top, right - left, bottom - top)
        boxes.append(replace(box, keypoints=seen_keypoints(names, points[k])) if names else box)
    return boxes
