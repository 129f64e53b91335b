"""The TOML file that says how to feed an ONNX detector and how to read its outputs."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocols.core.errors import InputError
from protocols.core.files import read_toml

Layout = Literal["yolov5", "yolov8", "yolox", "end2end", "detr", "separate"]
BoxFormat = Literal["cxcywh", "xyxy", "xywh"]
Activation = Literal["none", "sigmoid", "softmax"]

_Side = Annotated[int, Meta(ge=32, le=4096)]
_Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
_Level = Annotated[float, Meta(ge=-1e4, le=1e4)]
_Spread = Annotated[float, Meta(gt=0.0, le=1e4)]
_OutputName = Annotated[str, Meta(min_length=1, max_length=200)]
MAX_INPUT_PIXELS = 50_000_000
"""Of all images of a batch: 30 of 1280x1280; 0.6 GB as 32-bit numbers."""


class NetworkDescription(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How an ONNX detector is used. The defaults are those of Ultralytics' exports of YOLOv8 and later.

    model: the ONNX file; a relative path is relative to the TOML file. layout: of the outputs, see ``decode``. input:
    (width, height) [px] of the network's input. resize: letterbox keeps the aspect ratio and fills the rest with the
    grey level ``fill``; stretch does not. channels: their order. A pixel p (0..255) becomes (p · scale − mean) / std,
    mean and std in the order of the channels. outputs: names of the model's outputs by role (detections; or boxes,
    scores, labels; keypoints); default: see ``decode``. box, pixels: format of a box, and whether it is in pixels of
    the input or in fractions of it; default: of the layout. activation: turns the class scores into probabilities.
    classes: kind by class index; others are ignored. keypoints: their names in order, COCO's for example; those of
    face, shoulders, hips and ankles refine head, foot and colour. keypoint_values: 3 = u, v, confidence; 2 = u, v.
    mask_coefficients: of each candidate, behind everything else; not used. score, nms: least score; greatest overlap
    (intersection over union) of two objects of a kind, 1 = none removed; default: of the layout.
    box_std: std of a box's centre over its side. batch: images at once. threads: of the processor. backend: auto takes
    onnxruntime if it is installed, else OpenCV.
    """

    model: str
    layout: Layout = "yolov8"
    input: tuple[_Side, _Side] = (640, 640)
    resize: Literal["letterbox", "stretch"] = "letterbox"
    fill: Annotated[int, Meta(ge=0, le=255)] = 114
    channels: Literal["rgb", "bgr"] = "rgb"
    scale: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0 / 255.0
    mean: tuple[_Level, _Level, _Level] = (0.0, 0.0, 0.0)
    std: tuple[_Spread, _Spread, _Spread] = (1.0, 1.0, 1.0)
    outputs: dict[Literal["detections", "boxes", "scores", "labels", "keypoints"], _OutputName] = {}
    box: BoxFormat | None = None
    pixels: bool | None = None
    activation: Activation | None = None
    classes: dict[Annotated[str, Meta(pattern=r"^[0-9]{1,4}\Z")], Literal["person", "vehicle"]]
    keypoints: Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...], Meta(max_length=200)] = ()
    keypoint_values: Literal[2, 3] = 3
    mask_coefficients: Annotated[int, Meta(ge=0, le=1024)] = 0
    score: _Fraction = 0.25
    nms: _Fraction | None = None
    box_std: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.05
    batch: Annotated[int, Meta(ge=1, le=32)] = 4
    threads: Annotated[int, Meta(ge=1, le=64)] = 1
    backend: Literal["auto", "onnxruntime", "opencv"] = "auto"

    def __post_init__(self) -> None:
        if not self.classes:
            raise ValueError('classes is empty; name at least one, as in classes = { 0 = "person" }')
        if self.batch * self.input[0] * self.input[1] > MAX_INPUT_PIXELS:
            raise ValueError(f"batch is too large for this input; take at most {MAX_INPUT_PIXELS / 1e6:g} megapixels")
        if self.mask_coefficients and self.layout in ("detr", "separate"):
            raise ValueError(f'mask_coefficients has no effect on layout = "{self.layout}"; remove it')
        if self.resize == "stretch" and self.fill != 114:
            raise ValueError('fill has no effect on resize = "stretch"; remove it')

    @property
    def box_format(self) -> BoxFormat:
        """``box``, or what is usual of the layout."""
        return self.box or ("xyxy" if self.layout in ("end2end", "separate") else "cxcywh")

    @property
    def in_pixels(self) -> bool:
        """``pixels``, or what is usual of the layout."""
        return self.layout != "detr" if self.pixels is None else self.pixels

    @property
    def greatest_overlap(self) -> float:
        """``nms``, or what is usual of the layout."""
        usual = 1.0 if self.layout in ("end2end", "detr", "separate") else 0.6
        return usual if self.nms is None else self.nms

    @property
    def score_activation(self) -> Activation:
        """``activation``, or what is usual of the layout."""
        return self.activation or ("softmax" if self.layout == "detr" else "none")


def read_description(file: Path) -> NetworkDescription:
    """Read the TOML file of a network. Raises InputError."""
    values, _ = read_toml(file, "network's file")
    try:
        return msgspec.convert(values, NetworkDescription)
    except msgspec.ValidationError as error:
        remedy = "see docs/guide/detectors.md for an example"
        raise InputError(f"not a network's description: {error}", file=file, remedy=remedy) from None


def network_digest(file: Path) -> str:
    """A hash of a network's TOML file and model. Raises InputError."""
    model = file.parent / read_description(file).model
    try:
        with model.open("rb") as stream:
            return hashlib.sha256(file.read_bytes() + hashlib.file_digest(stream, "sha256").digest()).hexdigest()
    except OSError as error:
        what = f"the model cannot be read: {error.strerror}"
        raise InputError(what, file=model, remedy="correct the path `model` in the network's .toml file") from None
