"""Tiny ONNX models whose outputs are given, whatever the image, to test what is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

Array = npt.NDArray[np.float32]
SIZE = 64, 48
"""(width, height) of the models' input."""


def constant_model(outputs: Mapping[str, npt.ArrayLike], batch: int | str = "n", channels: int = 3) -> onnx.ModelProto:
    """A model of images (batch, channels, 48, 64) that gives these outputs (1, ...) for each image of a batch."""
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["zeros"]),
    ]
    stored = [numpy_helper.from_array(np.zeros(1, np.float32), "zero")]
    described = []
    for name, values in outputs.items():
        array = np.asarray(values, np.float32)
        shape = np.array([-1, *[1] * (array.ndim - 1)], np.int64)
        stored += [numpy_helper.from_array(array, f"{name}_given"), numpy_helper.from_array(shape, f"{name}_shape")]
        nodes.append(helper.make_node("Reshape", ["zeros", f"{name}_shape"], [f"{name}_zeros"]))
        nodes.append(helper.make_node("Add", [f"{name}_given", f"{name}_zeros"], [name]))
        described.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, *array.shape[1:]]))
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, channels, SIZE[1], SIZE[0]])
    return model_of(nodes, [images], described, stored)


def model_of(nodes: list[Any], inputs: list[Any], outputs: list[Any], stored: list[Any]) -> onnx.ModelProto:
    """A model of ONNX nodes."""
    graph = helper.make_graph(nodes, "test", inputs, outputs, stored)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def write_network(
    folder: Path, model: onnx.ModelProto | bytes, toml: str = "", classes: str = '{ 0 = "person" }'
) -> Path:
    """Write model.onnx and model.toml, and give the path of the second. toml: more lines of it."""
    content = model if isinstance(model, bytes) else model.SerializeToString()
    (folder / "model.onnx").write_bytes(content)
    file = folder / "model.toml"
    given = "" if "input =" in toml else f"input = [{SIZE[0]}, {SIZE[1]}]\n"
    file.write_text(f'model = "model.onnx"\nclasses = {classes}\n{given}{toml}\n')
    return file
