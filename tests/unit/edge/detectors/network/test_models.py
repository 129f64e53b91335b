"""Model files: hostile and wrong ones are refused with one line; images reach the network as they are described."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from deploy.cli import run
from edge.detectors.network import runtime
from edge.detectors.network.decode import Boxes
from edge.detectors.network.description import NetworkDescription
from edge.detectors.network.detector import boxes_in_image, prepare
from edge.detectors.network.runtime import check_model_file, open_runtime
from edge.detectors.plugins import load_detector
from protocols.core.errors import InputError
from tests.support.networks import constant_model, model_of, write_network
from tests.support.videos import write_video

pytest.importorskip("onnxruntime", reason="the extra `onnx` is not installed")

NOTHING = {"o": np.zeros((1, 5, 50))}
GOOD = constant_model(NOTHING)


def with_external(location: str) -> onnx.ModelProto:
    """A model whose first tensor is in another file."""
    model = constant_model(NOTHING)
    tensor = model.graph.initializer[1]
    assert len(tensor.raw_data) == 1000
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "1000")):
        tensor.external_data.add(key=key, value=value)
    return model


def with_loop() -> onnx.ModelProto:
    """A model that would count to 2⁶²."""
    steps = numpy_helper.from_array(np.array(2**62), "steps")
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"])],
        "body",
        [
            helper.make_tensor_value_info("k", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
        ],
        [helper.make_tensor_value_info("go_on", TensorProto.BOOL, [])],
    )
    model = constant_model(NOTHING)
    model.graph.initializer.append(steps)
    model.graph.node.append(helper.make_node("Loop", ["steps", ""], [], body=body))
    return model


def two_inputs() -> onnx.ModelProto:
    model = constant_model(NOTHING)
    model.graph.input.append(helper.make_tensor_value_info("sizes", TensorProto.FLOAT, [1, 2]))
    return model


def of_wanted_size(kind: int = TensorProto.INT64) -> onnx.ModelProto:
    """A model that gives one box as large as its second input says, as RT-DETR's own export does."""
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["n", 3, 48, 64])
    size = helper.make_tensor_value_info("orig_target_sizes", kind, ["n", 2])
    names = {"boxes": ["n", 1, 4], "scores": ["n", 1], "labels": ["n", 1]}
    stored = [numpy_helper.from_array(np.array(part), name) for name, part in (("1", [1]), ("n4", [-1, 1, 4]))]
    nodes = [
        helper.make_node("Cast", ["orig_target_sizes"], ["size"], to=TensorProto.FLOAT),
        helper.make_node("Sub", ["size", "size"], ["corner"]),
        helper.make_node("Concat", ["corner", "size"], ["flat"], axis=1),
        helper.make_node("Reshape", ["flat", "n4"], ["boxes"]),
        helper.make_node("ReduceMin", ["corner"], ["labels"], axes=[1]),
        helper.make_node("Cos", ["labels"], ["scores"]),
        helper.make_node("ReduceMean", ["images"], ["unused"]),
    ]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in names.items()]
    return model_of(nodes, [images, size], outputs, stored)


def of_input(shape: list[Any], kind: int = TensorProto.FLOAT) -> onnx.ModelProto:
    images = helper.make_tensor_value_info("images", kind, shape)
    out = helper.make_tensor_value_info("o", kind, None)
    return model_of([helper.make_node("Identity", ["images"], ["o"])], [images], [out], [])


def unknown_operator() -> onnx.ModelProto:
    model = constant_model(NOTHING)
    model.graph.node[0].op_type = "Frobnicate"
    return model


def of_huge_outputs(numbers: int) -> onnx.ModelProto:
    """A model whose outputs are its mean, many times: a few bytes that say how much memory to take."""
    shape = numpy_helper.from_array(np.array([1, 5, numbers // 5]), "shape")
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["n", 3, 48, 64])
    mean = helper.make_node("ReduceMean", ["images"], ["mean"], axes=[0, 1, 2, 3], keepdims=0)
    expand = helper.make_node("Expand", ["mean", "shape"], ["o"])
    return model_of([mean, expand], [images], [helper.make_tensor_value_info("o", TensorProto.FLOAT, None)], [shape])


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (of_huge_outputs(10**10), "needs more than 4 GiB"),
        (of_huge_outputs(10**14), "needs more than 4 GiB"),
        (b"", "not an ONNX file"),
        (b"hello world" * 99, "not an ONNX file"),
        (GOOD.SerializeToString()[:-100], "not an ONNX file"),
        (onnx.ModelProto(ir_version=8), "not an ONNX file, or empty"),
        (with_external("../secret.bin"), "'../secret.bin' is not a file in the model's folder"),
        (with_external("/etc/passwd"), "'/etc/passwd' is not a file"),
        (with_external("missing.bin"), "'missing.bin' is not a file"),
        (with_loop(), "a Loop, whose duration is not bounded"),
        (two_inputs(), r"2 inputs \(images, sizes\)"),
        (of_input([1, 3]), "the model's input is 1x3;"),
        (of_input(["b", "h", "w", 3]), "images, batch x 3 x height x width"),
        (of_input(["n", 1, 48, 64]), "nx1x48x64"),
        (of_input(["n", 3, 480, 640]), r"set input = \[640, 480\]"),
        (of_input([20000, 3, 48, 64]), "20000 images at once"),
        (of_input(["n", 3, 48, 64], TensorProto.UINT8), r"a tensor\(uint8\)"),
        (of_input(["n", 3, 48, 64]), "output for detections is 1x3x48x64"),
        (unknown_operator(), "cannot be run.*Frobnicate"),
        (GOOD.SerializeToString().replace(b"zeros", b"ze\xf8os", 1), "not an ONNX file"),
        (GOOD.SerializeToString().replace(b"zeros", b"zerus", 1), "uses 'zeros', which nothing in it computes"),
    ],
)
def test_a_hostile_or_wrong_model_is_one_line(tmp_path: Path, model: onnx.ModelProto | bytes, message: str) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(2000))
    folder = tmp_path / "models"
    folder.mkdir()
    with pytest.raises(InputError, match=message) as caught:
        load_detector(write_network(folder, model))
    assert caught.value.file == folder / "model.onnx"
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (b"hello world" * 99, "not an ONNX file"),
        (two_inputs(), r"2 inputs \(images, sizes\)"),
        (of_input([1, 3]), "the model's input is 1x3;"),
        (of_input(["n", 3, 480, 640]), r"set input = \[640, 480\]"),
        (of_input(["n", 3, 48, 64]), "cannot be run"),
        (unknown_operator(), "cannot be run.*Frobnicate"),
        (GOOD.SerializeToString().replace(b"zeros", b"ze\xf8os", 1), "not an ONNX file"),
        (GOOD.SerializeToString().replace(b"zeros", b"zerus", 1), "uses 'zeros', which nothing in it computes"),
    ],
)
def test_opencv_refuses_them_too(tmp_path: Path, model: onnx.ModelProto | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_detector(write_network(tmp_path, model, 'backend = "opencv"'))


@pytest.mark.parametrize("kind", [TensorProto.INT64, TensorProto.INT32, TensorProto.FLOAT])
def test_a_model_that_asks_for_the_size_of_its_boxes_gets_that_of_its_input(tmp_path: Path, kind: int) -> None:
    toml = 'layout = "separate"\nresize = "stretch"'
    detector = load_detector(write_network(tmp_path, of_wanted_size(kind), toml))
    (person,) = detector.detect(np.zeros((480, 640, 3), np.uint8))
    assert person.box == pytest.approx((0.0, 0.0, 640.0, 480.0))
    with pytest.raises(InputError, match="OpenCV does not run models with orig_target_sizes"):
        load_detector(write_network(tmp_path, of_wanted_size(), f'{toml}\nbackend = "opencv"'))


def test_outputs_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "MAX_OUTPUT", 999)
    with pytest.raises(InputError, match="outputs have more than 999 numbers"):
        load_detector(write_network(tmp_path, of_huge_outputs(1000)))
    model = constant_model(NOTHING)
    model.metadata_props.add(key="names", value=",0:''" * 10**6)
    (tmp_path / "model.onnx").write_bytes(model.SerializeToString())
    assert check_model_file(tmp_path / "model.onnx")[1] == runtime._MAX_NAMES // 5


def test_external_data_beside_the_model_is_read_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "weights.bin").write_bytes(bytes(1000))
    file = write_network(tmp_path, with_external("weights.bin"))
    assert load_detector(file).detect(np.zeros((48, 64, 3), np.uint8)) == []
    size = (tmp_path / "model.onnx").stat().st_size
    monkeypatch.setattr(runtime, "MAX_BYTES", size + 999)
    with pytest.raises(InputError, match="the model's data exceeds"):
        check_model_file(tmp_path / "model.onnx")
    monkeypatch.setattr(runtime, "MAX_BYTES", size - 1)
    with pytest.raises(InputError, match="at most"):
        check_model_file(tmp_path / "model.onnx")


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("layout = 'yolo'", "Invalid enum value 'yolo'"),
        ("colour = 3", "unknown field `colour`"),
        ("score = 1.5", "score"),
        ("input = [64, 100000]", "<= 4096"),
        ("input = [4096, 4096]\nbatch = 32", "batch is too large"),
        ("std = [1.0, 0.0, 1.0]", "> 0"),
        ("threads = 100", "<= 64"),
        ("score = ", "not valid TOML"),
        ("mean = [nan, 0.0, 0.0]", "mean"),
        ('fill = 0\nresize = "stretch"', "fill has no effect"),
        ('mask_coefficients = 32\nlayout = "detr"', "mask_coefficients has no effect"),
        ("#" * 5_000_000, "has more than 4194304 bytes"),
    ],
)
def test_a_wrong_description_is_one_line(tmp_path: Path, toml: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_detector(write_network(tmp_path, GOOD, toml))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("classes", ["{}", '{ 0 = "dog" }', '{ person = "person" }', '{ -1 = "person" }'])
def test_classes_are_indices_with_a_kind(tmp_path: Path, classes: str) -> None:
    with pytest.raises(InputError, match="classes"):
        load_detector(write_network(tmp_path, GOOD, classes=classes))


def test_the_command_ends_with_status_2_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_network(tmp_path, b"hello")
    video = tmp_path / "a.mp4"
    write_video(video, [np.zeros((48, 64, 3), np.uint8)] * 3, [0.0, 0.1, 0.2])
    command = ["detect", "person", str(video), "--out", str(tmp_path / "o.csv"), "--detector"]
    assert run([*command, str(file)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert run([*command, str(tmp_path / "none.toml")]) == 2
    assert run([*command, "no-such-detector"]) == 2
    assert "there is no detector 'no-such-detector'" in capsys.readouterr().err
    assert not (tmp_path / "o.csv").exists()


@pytest.mark.parametrize("resize", ["letterbox", "stretch"])
@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1000, 300), (33, 21)])
def test_a_box_in_the_network_is_the_box_in_the_image(resize: Any, size: tuple[int, int]) -> None:
    width, height = size
    image = np.zeros((height, width, 3), np.uint8)
    x, y, w, h = round(0.25 * width), round(0.3 * height), round(0.5 * width), round(0.4 * height)
    image[y : y + h, x : x + w] = 255
    description = NetworkDescription(model="", classes={"0": "person"}, input=(320, 320), resize=resize)
    prepared, how = prepare(image, description)
    assert prepared.shape == (3, 320, 320)
    rows, columns = (np.flatnonzero((prepared[0] > 0.5).any(axis=axis)) for axis in (1, 0))
    corner = np.array([[columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]], dtype=np.float64)
    found = Boxes(corner, np.ones(1), ("person",), np.array([[[*corner[0, :2], 1.0]]]))
    (box,) = boxes_in_image(found, how, size, ["nose"])
    pixel = 1.0 / min(how.scale)
    assert (box.left, box.top, box.width, box.height) == pytest.approx((x, y, w, h), abs=2.1 * pixel)
    assert box.keypoints["nose"] == pytest.approx((x, y), abs=1.1 * pixel)


def test_pixels_are_normalised_in_the_order_of_the_channels() -> None:
    image = np.full((32, 64, 3), (10, 20, 30), np.uint8)  # blue, green, red
    shape = {"model": "", "classes": {"0": "person"}, "input": (64, 64), "fill": 200}
    rgb, _ = prepare(image, NetworkDescription(**shape, mean=(0.1, 0.2, 0.3), std=(1.0, 2.0, 4.0)))  # type: ignore[arg-type]
    assert rgb[:, 32, 10] == pytest.approx([30 / 255 - 0.1, (20 / 255 - 0.2) / 2.0, (10 / 255 - 0.3) / 4.0], abs=1e-6)
    assert rgb[0, 5, 10] == pytest.approx(200 / 255 - 0.1, abs=1e-6)
    bgr, _ = prepare(image, NetworkDescription(**shape, channels="bgr", scale=1.0))  # type: ignore[arg-type]
    assert bgr[:, 32, 10].tolist() == [10.0, 20.0, 30.0]


def test_both_runtimes_give_the_same_numbers(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    weights = numpy_helper.from_array(rng.standard_normal((6, 3, 3, 3)).astype(np.float32), "w")
    model = model_of(
        [helper.make_node("Conv", ["images", "w"], ["o"], pads=[1, 1, 1, 1])],
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, ["n", 3, 48, 64])],
        [helper.make_tensor_value_info("o", TensorProto.FLOAT, ["n", 6, 48, 64])],
        [weights],
    )
    write_network(tmp_path, model)
    image = rng.random((1, 3, 48, 64), dtype=np.float32)
    found = [
        open_runtime(tmp_path / "model.onnx", name, (64, 48), 99).run(image)["o"] for name in ("onnxruntime", "opencv")
    ]
    assert found[0] == pytest.approx(found[1], abs=1e-4)
