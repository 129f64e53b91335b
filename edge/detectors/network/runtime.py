"""Runs an ONNX model: onnxruntime where it is installed, else OpenCV's dnn module."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.network.description import MAX_INPUT_PIXELS
from edge.detectors.network.model_file import check_model_file
from protocols.core.errors import InputError

Array = npt.NDArray[Any]
MAX_OUTPUT = 50_000_000
"""Numbers in all outputs of one run: four times what YOLOv5 gives for 32 images of 640x640 in 9 classes (1.1e7)."""
_INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_MAX_MEMORY = 4 << 30
"""[bytes] of all models of a process in onnxruntime: four times the largest model file that is accepted."""


class Runtime(Protocol):
    """A loaded model. batch: the fixed number of images that it takes, 0 = any number."""

    batch: int

    def run(self, images: npt.NDArray[np.float32]) -> dict[str, Array]:
        """The outputs by name of images (n, 3, H, W), normalised; n is ``batch`` where that is not 0."""


def open_runtime(
    file: Path, backend: Literal["auto", "onnxruntime", "opencv"], size: tuple[int, int], threads: int
) -> Runtime:
    """Load a model that takes images of ``size`` (width, height). threads: at most as many as cores. InputError."""
    batch = _fixed_batch(check_model_file(file), size, file)
    installed = find_spec("onnxruntime") is not None
    if backend == "onnxruntime" and not installed:
        remedy = 'pip install onnxruntime, or set backend = "opencv"'
        raise InputError("onnxruntime is not installed", file=file, remedy=remedy)
    if installed and backend != "opencv":
        return OnnxRuntime(file, batch, min(threads, os.cpu_count() or 1))
    return OpenCvRuntime(file, batch)


class OnnxRuntime:
    """onnxruntime on the processor. Raises InputError where the model is not usable."""

    def __init__(self, file: Path, batch: int, threads: int) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what is wrong is reported by us, in one line
        memory = onnxruntime.OrtMemoryInfo(
            "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
        )
        onnxruntime.create_and_register_allocator(memory, onnxruntime.OrtArenaCfg({"max_mem": _MAX_MEMORY}))
        options.add_session_config_entry("session.use_env_allocators", "1")
        # Waiting threads would otherwise spin, and take the core of the next agent.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._file = file
        try:
            self._session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001 - onnxruntime's errors have no other common class
            raise _unusable(file, error) from None
        (images,) = self._session.get_inputs()
        self._input, self.batch = images.name, batch
        if images.type not in _INPUT_TYPES:
            what = f"the model's input is a {images.type}"
            raise InputError(what, file=file, remedy="export it with an input of 32 or 16 bit floating point")
        self._type = _INPUT_TYPES[images.type]
        self._outputs = [one.name for one in self._session.get_outputs()]

    def run(self, images: npt.NDArray[np.float32]) -> dict[str, Array]:
        try:
            found = self._session.run(self._outputs, {self._input: images.astype(self._type, copy=False)})
        except Exception as error:  # noqa: BLE001 - as above
            raise _unusable(self._file, error) from None
        return _checked(dict(zip(self._outputs, found, strict=True)), self._file)


class OpenCvRuntime:
    """OpenCV's dnn module, one image at a time if the model allows. Raises InputError where it is not usable."""

    def __init__(self, file: Path, batch: int) -> None:
        self._file, self.batch = file, batch or 1
        try:
            self._net = cv2.dnn.readNetFromONNX(str(file))
            self._outputs = list(self._net.getUnconnectedOutLayersNames())
        except cv2.error as error:
            raise _unusable(file, error) from None

    def run(self, images: npt.NDArray[np.float32]) -> dict[str, Array]:
        try:
            self._net.setInput(images)
            found = self._net.forward(self._outputs)
        except cv2.error as error:
            raise _unusable(self._file, error) from None
        return _checked(dict(zip(self._outputs, found, strict=True)), self._file)


def _fixed_batch(inputs: dict[str, list[int | str]], size: tuple[int, int], file: Path) -> int:
    """The number of images that a model takes at once, 0 = any. inputs: shapes by name. InputError if not images."""
    if len(inputs) != 1:
        names = ", ".join(inputs)[:120]
        raise InputError(f"the model has {len(inputs)} inputs ({names})", file=file, remedy="export it with one")
    (shape,) = inputs.values()
    fixed = [one if isinstance(one, int) and one > 0 else 0 for one in shape]
    written = "x".join(str(one or "?") for one in shape)[:80]
    if len(fixed) != 4 or fixed[1] not in (0, 3):
        what = f"the model's input is {written or 'one number'}"
        raise InputError(what, file=file, remedy="export it with an input of images, batch x 3 x height x width")
    if any(given not in (0, wanted) for given, wanted in zip(fixed[2:], (size[1], size[0]), strict=True)):
        remedy = f"set input = [{fixed[3] or size[0]}, {fixed[2] or size[1]}] in the network's .toml file"
        raise InputError(
            f"the model's input is {written}, not {size[0]} wide and {size[1]} high", file=file, remedy=remedy
        )
    if fixed[0] * size[0] * size[1] > MAX_INPUT_PIXELS:
        raise InputError(f"the model takes {fixed[0]} images at once", file=file, remedy="export it for fewer")
    return fixed[0]


def _checked(outputs: dict[str, Array], file: Path) -> dict[str, Array]:
    if sum(one.size for one in outputs.values()) > MAX_OUTPUT:
        raise InputError(
            f"the model's outputs have more than {MAX_OUTPUT} numbers", file=file, remedy="use a smaller one"
        )
    return outputs


def _unusable(file: Path, error: Exception) -> InputError:
    """A runtime's error as one line."""
    text = " ".join(str(error).split()).replace(str(file), file.name)
    if "AllocateRaw" in text or "Insufficient memory" in text:
        text = f"it needs more than {_MAX_MEMORY >> 30} GiB, or than there are"
    elif len(text) > 240:
        text = f"{text[:120]} … {text[-120:]}"
    return InputError(f"the model cannot be run: {text}", file=file, remedy="export it again, and check `input`")
