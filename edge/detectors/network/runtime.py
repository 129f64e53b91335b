"""Runs an ONNX model: onnxruntime where it is installed, else OpenCV's dnn module.

Before a runtime opens a file it is checked: that it is ONNX, of bounded size, and refers to nothing elsewhere. A
runtime reads whatever file a tensor's external data names, and runs loops of any length: neither is allowed here.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from edge.detectors.network.description import MAX_INPUT_PIXELS
from protocols.core.errors import InputError

Array = npt.NDArray[Any]
MAX_OUTPUT = 50_000_000
"""Numbers in all outputs of one run: four times what YOLOv5 gives for 32 images of 640x640 in 9 classes (1.1e7)."""
_INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_SIZE_TYPES = _INPUT_TYPES | {"tensor(int32)": np.int32}
_SIZE_INPUT = "orig_target_sizes"
"""Of the exports of RT-DETR, D-FINE and DEIM: (n, 2) width and height in which boxes are wanted [px]."""
_MAX_MEMORY = 4 << 30
"""[bytes] of all models of a process in onnxruntime: four times the largest model file that is accepted."""

MAX_BYTES = 1 << 30
"""Of model and external data together: ten times the largest common detectors (YOLOv8x: 0.26 GiB)."""
_MAX_DEPTH = 8
"""Of graphs within graphs."""
_LOOPS = frozenset({"Loop", "Scan"})
_CLASS_NAME = re.compile(r"[{,] *\d+: *(['\"])(?:\\.|[^\\])*?\1", re.DOTALL)
"""In Ultralytics' metadata ``names``: a dictionary {0: 'person', …} as Python prints it."""
_MAX_NAMES = 1 << 20
"""[bytes] of ``names`` that are read: as many classes as in the largest data sets (ImageNet: 21,841) of 48 each."""
_REMEDY = "export the model again"
# The part of onnx.proto3 (onnx.ai, IR version 10) that is looked at: message → field → (number, type, repeated).
_FIELDS: dict[str, dict[str, tuple[int, str, bool]]] = {
    "Model": {
        "ir_version": (1, "int64", False),
        "graph": (7, "Graph", False),
        "metadata_props": (14, "Entry", True),
        "functions": (25, "Function", True),
    },
    "Function": {"node": (7, "Node", True)},
    "Graph": {
        "node": (1, "Node", True),
        "initializer": (5, "Tensor", True),
        "input": (11, "Value", True),
        "sparse_initializer": (15, "Sparse", True),
    },
    "Value": {"name": (1, "string", False), "type": (2, "Type", False)},
    "Type": {"tensor_type": (1, "TensorType", False)},
    "TensorType": {"shape": (2, "Shape", False)},
    "Shape": {"dim": (1, "Dimension", True)},
    "Dimension": {"dim_value": (1, "int64", False), "dim_param": (2, "string", False)},
    "Node": {
        "input": (1, "string", True),
        "output": (2, "string", True),
        "op_type": (4, "string", False),
        "attribute": (5, "Attribute", True),
    },
    "Attribute": {
        "t": (5, "Tensor", False),
        "g": (6, "Graph", False),
        "tensors": (10, "Tensor", True),
        "graphs": (11, "Graph", True),
        "sparse_tensor": (22, "Sparse", False),
        "sparse_tensors": (23, "Sparse", True),
    },
    "Sparse": {"values": (1, "Tensor", False), "indices": (2, "Tensor", False)},
    "Tensor": {
        "name": (8, "string", False),
        "external_data": (13, "Entry", True),
        "data_location": (14, "int64", False),
    },
    "Entry": {"key": (1, "bytes", False), "value": (2, "bytes", False)},  # exporters write text of any encoding
}


class Runtime(Protocol):
    """A loaded model. batch: the fixed number of images that it takes, 0 = any number. classes: named in it, or 0."""

    batch: int
    classes: int

    def run(self, images: npt.NDArray[np.float32]) -> dict[str, Array]:
        """The outputs by name of images (n, 3, H, W), normalised; n is ``batch`` where that is not 0."""


def open_runtime(
    file: Path, backend: Literal["auto", "onnxruntime", "opencv"], size: tuple[int, int], threads: int
) -> Runtime:
    """Load a model that takes images of ``size`` (width, height). threads: at most as many as cores. InputError."""
    inputs, classes = check_model_file(file)
    batch = _fixed_batch(inputs, size, file)
    installed = find_spec("onnxruntime") is not None
    if backend == "onnxruntime" and not installed:
        remedy = 'pip install onnxruntime, or set backend = "opencv"'
        raise InputError("onnxruntime is not installed", file=file, remedy=remedy)
    if installed and backend != "opencv":
        return OnnxRuntime(file, batch, classes, size, min(threads, os.cpu_count() or 1))
    if _SIZE_INPUT in inputs:
        raise InputError(f"OpenCV does not run models with {_SIZE_INPUT}", file=file, remedy="pip install onnxruntime")
    return OpenCvRuntime(file, batch, classes)


class OnnxRuntime:
    """onnxruntime on the processor. size: (width, height) of the input. Raises InputError if it is not usable."""

    def __init__(self, file: Path, batch: int, classes: int, size: tuple[int, int], threads: int) -> None:
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
        inputs = {one.name: one for one in self._session.get_inputs()}
        wanted = inputs.pop(_SIZE_INPUT, None)
        self._size = None if wanted is None else np.array([size], dtype=_SIZE_TYPES.get(wanted.type, np.int64))
        (images,) = inputs.values()
        self._input, self.batch, self.classes = images.name, batch, classes
        if images.type not in _INPUT_TYPES:
            what = f"the model's input is a {images.type}"
            raise InputError(what, file=file, remedy="export it with an input of 32 or 16 bit floating point")
        self._type = _INPUT_TYPES[images.type]
        self._outputs = [one.name for one in self._session.get_outputs()]

    def run(self, images: npt.NDArray[np.float32]) -> dict[str, Array]:
        given: dict[str, Array] = {self._input: images.astype(self._type, copy=False)}
        if self._size is not None:
            given[_SIZE_INPUT] = self._size.repeat(len(images), axis=0)
        try:
            found = self._session.run(self._outputs, given)
        except Exception as error:  # noqa: BLE001 - as above
            raise _unusable(self._file, error) from None
        return _checked(dict(zip(self._outputs, found, strict=True)), self._file)


class OpenCvRuntime:
    """OpenCV's dnn module, one image at a time if the model allows. Raises InputError where it is not usable."""

    def __init__(self, file: Path, batch: int, classes: int) -> None:
        self._file, self.batch, self.classes = file, batch or 1, classes
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
    shapes = [shape for name, shape in inputs.items() if name != _SIZE_INPUT]
    if len(shapes) != 1:
        names = ", ".join(inputs)[:120]
        raise InputError(f"the model has {len(inputs)} inputs ({names})", file=file, remedy="export it with one")
    (shape,) = shapes
    fixed = [one if isinstance(one, int) and one > 0 else 0 for one in shape]
    written = "x".join(str(one or "?") for one in shape)[:80]
    if len(fixed) != 4 or fixed[1] not in (0, 3) or fixed[3] == 3:  # 3 last: height x width x channels
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


def check_model_file(file: Path) -> tuple[dict[str, list[int | str]], int]:
    """The shapes of a model's inputs, and how many classes it names, 0 = none.

    A size that is not fixed is a name, or 0. Raises InputError unless the file can be given to a runtime.
    """
    try:
        size = file.stat().st_size
        if not file.is_file():
            raise InputError("the model is not a file", file=file, remedy="give an .onnx file as `model`")
        if size > MAX_BYTES:
            raise InputError(f"the model has {size >> 20} MiB, at most {MAX_BYTES >> 20}", file=file, remedy=_REMEDY)
        content = file.read_bytes()
    except OSError as error:
        what = f"the model cannot be read: {error.strerror}"
        raise InputError(what, file=file, remedy="correct the path `model` in the network's .toml file") from None
    model = _message("Model")()
    try:
        model.ParseFromString(content)
    except DecodeError:
        raise InputError("the model is not an ONNX file, or damaged", file=file, remedy=_REMEDY) from None
    if not model.HasField("graph") or not model.graph.node or model.ir_version <= 0:
        raise InputError("the model is not an ONNX file, or empty", file=file, remedy=_REMEDY)
    _check_inputs(model.graph, frozenset(), file)
    for message in _messages(model, file):
        if message.DESCRIPTOR.name == "Node" and message.op_type in _LOOPS:
            what = f"the model has a {message.op_type}, whose duration is not bounded"
            raise InputError(what, file=file, remedy="export it without the loop")
        if message.DESCRIPTOR.name == "Tensor" and (message.external_data or message.data_location):
            size += _external_size(message, file)
            if size > MAX_BYTES:
                raise InputError(f"the model's data exceeds {MAX_BYTES >> 20} MiB", file=file, remedy=_REMEDY)
    constants = {one.name for one in model.graph.initializer}  # until IR version 3, these are listed as inputs too
    inputs = {
        one.name: [size.dim_param or size.dim_value for size in one.type.tensor_type.shape.dim]
        for one in model.graph.input
        if one.name not in constants
    }
    names = next((one.value for one in model.metadata_props if one.key == b"names"), b"")
    return inputs, len(_CLASS_NAME.findall(names[:_MAX_NAMES].decode(errors="replace")))


def _check_inputs(graph: Any, outer: frozenset[str], file: Path) -> None:
    """Raise InputError unless each node's inputs are computed before it: OpenCV does not check that. outer: names."""
    known = outer | {one.name for one in (*graph.input, *graph.initializer)} | {""}  # "": an input that is left out
    known |= {one.values.name for one in graph.sparse_initializer}
    for node in graph.node:
        unknown = [name for name in node.input if name not in known]
        if unknown:
            what = f"the model uses {unknown[0][:80]!r}, which nothing in it computes"
            raise InputError(what, file=file, remedy=_REMEDY)
        for attribute in node.attribute:
            for inner in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                _check_inputs(inner, known, file)
        known |= set(node.output)


def _external_size(tensor: Any, file: Path) -> int:
    """Size of the part of another file with a tensor's values. Raises InputError if it is not beside the model."""
    entries = {entry.key: entry.value.decode(errors="replace") for entry in tensor.external_data}
    place = entries.get(b"location", "")
    folder = file.resolve().parent
    try:
        data = (folder / place).resolve()
        inside = place != "" and data.is_relative_to(folder) and data.is_file()
        size = data.stat().st_size if inside else 0
    except (OSError, ValueError):
        inside, size = False, 0
    if not inside:
        what = f"the model's data {place[:80]!r} is not a file in the model's folder"
        raise InputError(what, file=file, remedy="put it there, or export the model as one file")
    length = entries.get(b"length", "")
    return min(int(length), size) if length.isdigit() and len(length) < 19 else size


def _messages(message: Any, file: Path, depth: int = 0) -> Iterator[Any]:
    """A message and all messages in it that are not unknown to ``_FIELDS``."""
    if depth > 3 * _MAX_DEPTH:  # a graph within a graph is three messages deeper: node, attribute, graph
        raise InputError("the model nests graphs too deeply", file=file, remedy=_REMEDY)
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for one in value if field.is_repeated else (value,):
                yield from _messages(one, file, depth + 1)


@cache
def _message(name: str) -> type[Any]:
    """The class of a message of ``_FIELDS``."""
    package = "syncline.onnx"
    file = descriptor_pb2.FileDescriptorProto(name="syncline_onnx.proto", package=package, syntax="proto3")
    kinds = descriptor_pb2.FieldDescriptorProto
    scalars = {"int64": kinds.TYPE_INT64, "string": kinds.TYPE_STRING, "bytes": kinds.TYPE_BYTES}
    for message, fields in _FIELDS.items():
        described = file.message_type.add(name=message)
        for field, (number, kind, repeated) in fields.items():
            made = described.field.add(name=field, number=number, type=scalars.get(kind, kinds.TYPE_MESSAGE))
            made.label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
            if kind not in scalars:
                made.type_name = f".{package}.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}"))
