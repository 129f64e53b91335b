"""Check of an ONNX file before a runtime opens it: that it is one, of bounded size, and refers to nothing elsewhere.

A runtime reads whatever file a tensor's external data names, and runs loops of any length: neither is allowed here.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from protocols.core.errors import InputError

MAX_BYTES = 1 << 30
"""Of model and external data together: ten times the largest common detectors (YOLOv8x: 0.26 GiB)."""
_MAX_DEPTH = 8
"""Of graphs within graphs."""
_LOOPS = frozenset({"Loop", "Scan"})
_REMEDY = "export the model again"

# The part of onnx.proto3 (onnx.ai, IR version 10) that is looked at: message → field → (number, type, repeated).
_FIELDS: dict[str, dict[str, tuple[int, str, bool]]] = {
    "Model": {"ir_version": (1, "int64", False), "graph": (7, "Graph", False), "functions": (25, "Function", True)},
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
    "Entry": {"key": (1, "string", False), "value": (2, "string", False)},
}


def check_model_file(file: Path) -> dict[str, list[int | str]]:
    """The shapes of a model's inputs. A size that is not fixed is a name, or 0.

    Raises InputError unless the file can be given to a runtime.
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
    return {
        one.name: [size.dim_param or size.dim_value for size in one.type.tensor_type.shape.dim]
        for one in model.graph.input
        if one.name not in constants
    }


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
    entries = {entry.key: entry.value for entry in tensor.external_data}
    place = entries.get("location", "")
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
    length = entries.get("length", "")
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
    scalars = {"int64": kinds.TYPE_INT64, "string": kinds.TYPE_STRING}
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
