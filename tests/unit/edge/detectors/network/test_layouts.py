"""Outputs of every layout give the same detections, by both runtimes, and wrong ones are refused with one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import helper, numpy_helper

from edge.detectors.base import BatchDetector, Detection
from edge.detectors.network.decode import decode
from edge.detectors.network.description import NetworkDescription
from edge.detectors.network.detector import NetworkDetector
from edge.detectors.plugins import load_detector
from protocols.core.errors import InputError
from tests.support.networks import Array, constant_model, write_network

pytest.importorskip("onnxruntime", reason="the extra `onnx` is not installed")

IMAGE = np.full((480, 640, 3), 90, dtype=np.uint8)
"""Ten times the networks' input."""
PERSON = np.array([20.0, 24.0, 10.0, 30.0])  # cx, cy, w, h
TRUCK = np.array([50.0, 10.0, 20.0, 12.0])
FILL = 90  # candidates of low score
CLASSES = '{ 0 = "person", 2 = "vehicle" }'
POINTS = 'keypoints = ["nose", "left_ankle", "right_ankle"]'


def corners(box: Array) -> Array:
    return np.concatenate([box[:2] - 0.5 * box[2:], box[:2] + 0.5 * box[2:]])


def table(objectness: bool) -> Array:
    """Candidates (N, 4 [+ 1] + 3 classes): a person, the same one again, a dog, a truck, and many of low score."""
    rows = [(PERSON, 0.9, 0), (PERSON + [1.0, 0.0, 0.0, 0.0], 0.7, 0), (PERSON, 0.8, 1), (TRUCK, 0.6, 2)]
    rows += [(TRUCK, 0.01, 2)] * FILL
    out = []
    for box, score, label in rows:
        classes = np.full(3, 0.001)
        classes[label] = score / 0.95 if objectness else score
        out.append(np.concatenate([box, [0.95] if objectness else [], classes]))
    return np.array(out, dtype=np.float32)


def lone(box: Array, score: float, label: float, *more: float) -> list[float]:
    return [*corners(box), score, label, *more]


def cell_relative(rows: Array) -> Array:
    """Candidates as YOLOX gives them: (x - column · s) / s and log(w / s) of its cell; one cell each, none else."""
    cells = [(x, y, s) for s in (8, 16, 32) for y in range(48 // s) for x in range(64 // s)]
    out = np.zeros((len(cells), rows.shape[1]), dtype=np.float32)
    for k, row in zip((3, 49, 11, 60), rows[:4], strict=True):
        x, y, s = cells[k]
        out[k] = [row[0] / s - x, row[1] / s - y, *np.log(row[2:4] / s), *row[4:]]
    return out


LOGITS = np.array([[6.0, 0.0, 0.0, 0.0], [0.0, 0.0, 5.0, 0.0], [0.0, 0.0, 0.0, 9.0]])
SIZE4 = np.array([64.0, 48.0, 64.0, 48.0])
OUTPUTS = {
    'layout = "yolov8"': {"output0": table(False).T[None]},
    'layout = "yolov8" # turned': {"output0": table(False)[None]},
    'layout = "yolov5"': {"output0": table(True)[None]},
    'layout = "yolov5" # turned': {"output0": table(True).T[None]},
    'layout = "yolox"': {"output0": cell_relative(table(True))[None]},
    'layout = "yolox" # fewer cells than values': {
        "output0": np.hstack([cell_relative(table(True)), np.zeros((62, 77))])[None]
    },
    'layout = "yolov8"\nmask_coefficients = 2': {"output0": np.hstack([table(False), np.full((94, 2), 7.0)]).T[None]},
    'layout = "end2end"': {"output0": [[lone(PERSON, 0.9, 0), lone(TRUCK, 0.6, 2), lone(PERSON, 0.8, 1)]]},
    'layout = "detr"': {
        "logits": np.vstack([LOGITS, LOGITS[2:]])[None],
        "pred_boxes": np.array([PERSON, TRUCK, PERSON, PERSON])[None] / SIZE4,
    },
    'layout = "detr"\nactivation = "sigmoid"\noutputs = { scores = "a", boxes = "b" }': {
        "a": np.array([[[2.197, -9.0, -9.0], [-9.0, -9.0, 0.405], [-9.0, 3.0, -9.0]]]),
        "b": np.array([PERSON, TRUCK, PERSON])[None] / SIZE4,
    },
    'layout = "detr"\nactivation = "none"\nnms = 0.6': {
        "logits": table(False)[None, :, 4:],
        "pred_boxes": table(False)[None, :, :4] / SIZE4,
    },
    'layout = "separate"': {
        "boxes": np.array([corners(PERSON), corners(TRUCK), corners(PERSON)])[None],
        "scores": np.array([[0.9, 0.6, 0.9]]),
        "labels": np.array([[0.0, 2.0, 1.0]]),
    },
    'layout = "separate"\nbox = "xywh"\npixels = false': {
        "boxes": np.array([[15.0, 9.0, 10.0, 30.0], [40.0, 4.0, 20.0, 12.0]])[None] / SIZE4,
        "scores": np.array([[0.9, 0.6]]),
        "labels": np.array([[0.0, 2.0]]),
    },
}


def detect(folder: Path, outputs: dict[str, Array], toml: str, batch: int | str = "n") -> list[Detection]:
    file = write_network(folder, constant_model(outputs, batch), toml, CLASSES)
    return load_detector(file).detect(IMAGE)


@pytest.mark.parametrize("backend", ["onnxruntime", "opencv"])
@pytest.mark.parametrize("toml", list(OUTPUTS))
def test_a_person_and_a_truck_are_found_where_they_are(tmp_path: Path, toml: str, backend: str) -> None:
    found = detect(tmp_path, OUTPUTS[toml], f'{toml}\nbackend = "{backend}"')
    assert [one.kind for one in found] == ["person", "vehicle"]
    person, truck = found
    assert person.box == pytest.approx((150.0, 90.0, 100.0, 300.0), abs=0.05)
    assert person.head == pytest.approx((199.5, 89.5), abs=0.05)
    assert person.foot == pytest.approx((199.5, 389.5), abs=0.05)
    assert (person.u, person.v) == pytest.approx((199.5, 89.5 + 0.38 * 300.0), abs=0.05)
    assert person.size == pytest.approx(300.0, abs=0.05)
    assert person.colour == (90, 90, 90)
    assert person.covariance == pytest.approx((25.0, 0.0, 225.0), rel=1e-3)
    assert truck.box == pytest.approx((400.0, 40.0, 200.0, 120.0), abs=0.05)
    assert (truck.u, truck.v, truck.head, truck.foot) == (pytest.approx(499.5), pytest.approx(99.5), None, None)
    if "detr" not in toml or "nms" in toml:
        assert (person.score, truck.score) == pytest.approx((0.9, 0.6), abs=1e-3)
    assert [one.label for one in found] == ["p0", "t0"]


KEYPOINTS = [22.0, 12.0, 0.9, 18.0, 37.0, 0.8, 24.0, 36.0, 0.7]
WITH_KEYPOINTS = {
    'layout = "yolov8"\nclasses = { 0 = "person" }': {
        "o": np.array([[*PERSON, 0.9, *KEYPOINTS]] + [[*PERSON, 0.0, *KEYPOINTS]] * 20).T[None]
    },
    'layout = "end2end"': {"o": [[lone(PERSON, 0.9, 0, *KEYPOINTS)]]},
    'layout = "detr"\nactivation = "softmax"': {
        "logits": LOGITS[None, :1],
        "pred_boxes": PERSON[None, None] / SIZE4,
        "keypoints": (np.array(KEYPOINTS).reshape(1, 1, 3, 3) / [64.0, 48.0, 1.0]),
    },
}


@pytest.mark.parametrize("toml", list(WITH_KEYPOINTS))
def test_keypoints_of_face_and_ankles_refine_head_and_foot(tmp_path: Path, toml: str) -> None:
    layout, _, classes = toml.partition("\nclasses = ")
    model = constant_model(WITH_KEYPOINTS[toml])
    file = write_network(tmp_path, model, f"{layout}\n{POINTS}", classes or CLASSES)
    (person,) = load_detector(file).detect(IMAGE)
    assert person.head == pytest.approx((219.5, 89.5), abs=0.05)
    assert person.foot == pytest.approx((209.5, 365.0 + 0.039 * 300.0 - 0.5), abs=0.05)
    # An ankle that is not seen is not used.
    hidden = {name: np.where(np.isclose(values, 0.7), 0.1, values) for name, values in WITH_KEYPOINTS[toml].items()}
    file = write_network(tmp_path, constant_model(hidden), f"{layout}\n{POINTS}", classes or CLASSES)
    (person,) = load_detector(file).detect(IMAGE)
    assert person.foot == pytest.approx((199.5, 389.5), abs=0.05)


def test_only_the_wanted_kind_is_reported(tmp_path: Path) -> None:
    file = write_network(tmp_path, constant_model(OUTPUTS['layout = "yolov8"']), "", CLASSES)
    assert [one.kind for one in load_detector(file, kind="vehicle", prefix="cam1-").detect(IMAGE)] == ["vehicle"]
    assert [one.label for one in load_detector(file, kind="vehicle", prefix="cam1-").detect(IMAGE)] == ["cam1-t0"]


def test_two_people_that_overlap_less_than_the_threshold_both_stay(tmp_path: Path) -> None:
    rows = table(False)
    rows[1, 0] = 24.0  # overlap 6 / 14
    outputs = {"o": rows.T[None]}
    assert [one.kind for one in detect(tmp_path, outputs, "nms = 0.5")] == ["person", "person", "vehicle"]
    assert [one.kind for one in detect(tmp_path, outputs, "nms = 0.4")] == ["person", "vehicle"]


def test_torchvision_leaves_out_the_axis_of_the_batch() -> None:
    description = NetworkDescription(
        model="", layout="separate", classes={"1": "person"}, input=(64, 48), keypoints=("nose",)
    )
    for count in (0, 1, 3):
        outputs = {
            "boxes": np.tile(corners(PERSON), (count, 1)),
            "labels": np.ones(count, np.int64),
            "scores": np.full(count, 0.9, np.float32),
            "keypoints": np.ones((count, 1, 3), np.float32),
        }
        (found,) = decode(outputs, description, 1, None, Path("m.onnx"))
        assert len(found) == count
        assert found.keypoints.shape == (count, 1, 3)


def test_detections_of_a_batch_may_be_listed_with_the_index_of_their_image() -> None:
    description = NetworkDescription(model="", layout="end2end", classes={"2": "vehicle"}, input=(64, 48))
    rows = np.array([[1, *corners(TRUCK), 2, 0.6], [0, *corners(TRUCK), 0, 0.9], [1, *corners(PERSON), 2, 0.5]])
    first, second, third = decode({"o": rows}, description, 3, None, Path("m.onnx"))
    assert (len(first), len(third)) == (0, 0)
    assert second.score.tolist() == [0.6, 0.5]
    assert second.corner[0].tolist() == corners(TRUCK).tolist()
    assert [len(one) for one in decode({"o": rows[:0]}, description, 2, None, Path("m.onnx"))] == [0, 0]


@pytest.mark.parametrize(
    ("toml", "outputs", "names", "message"),
    [
        ('layout = "yolov8"', {"o": table(True)[None]}, 3, "gives 8 values a candidate; .* 3 classes .* has 7;"),
        ('layout = "yolov5"', {"o": table(False)[None]}, 3, "gives 7 values a candidate; .* 3 classes .* has 8;"),
        ('layout = "end2end"', {"o": [[lone(PERSON, 0.9, 0)]]}, 2, "class 2 is beyond the 2 classes that"),
        ('layout = "yolov8"', {"o": table(False)[None]}, 3, ""),
    ],
)  # fmt: skip
def test_classes_that_the_model_names_have_to_fit_the_layout(
    tmp_path: Path, toml: str, outputs: dict[str, Array], names: int, message: str
) -> None:
    model = constant_model(outputs)
    model.metadata_props.add(key="names", value=str({k: f"it's {k}, {k}: 'so' \xe4" for k in range(names)}))
    content = model.SerializeToString().replace("\xe4".encode(), b"\xff\xfe")  # not UTF-8
    file = write_network(tmp_path, content, toml, CLASSES)
    if message:
        with pytest.raises(InputError, match=message):
            load_detector(file)
    else:
        assert len(load_detector(file).detect(IMAGE)) == 2


@pytest.mark.parametrize(
    ("batch", "size", "backend"),
    [("n", 4, "auto"), (3, 3, "auto"), (1, 1, "auto"), (3, 3, "opencv"), ("n", 1, "opencv")],
)
def test_a_batch_gives_what_single_images_give(tmp_path: Path, batch: int | str, size: int, backend: str) -> None:
    file = write_network(
        tmp_path, constant_model(OUTPUTS['layout = "yolov8"'], batch), f'backend = "{backend}"', CLASSES
    )
    detector = load_detector(file)
    assert isinstance(detector, BatchDetector)
    assert detector.batch == size
    times = [0.1 * k for k in range(5)]
    together = detector.detect_batch([IMAGE] * 5, times)
    alone = load_detector(file)
    assert together == [alone.detect(IMAGE, time) for time in times]


def test_a_model_that_takes_one_image_though_it_declares_any_number_gets_one(tmp_path: Path) -> None:
    """It was refused after the first image, with advice about its input."""
    model = constant_model(OUTPUTS['layout = "yolov8"'])
    shape = numpy_helper.from_array(np.array([1, 3, 48, 64]), "one")
    model.graph.initializer.append(shape)
    model.graph.node[0].input[0] = "image"
    model.graph.node.insert(0, helper.make_node("Reshape", ["images", "one"], ["image"]))
    detector = load_detector(write_network(tmp_path, model, "", CLASSES))
    assert isinstance(detector, NetworkDetector)
    run, ran = detector._runtime.run, []

    def failing(images: Array) -> dict[str, Array]:
        ran.append(len(images))
        if len(ran) <= 2:
            raise InputError("no memory for anything")
        return run(images)

    detector._runtime.run = failing  # type: ignore[method-assign]
    with pytest.raises(InputError, match="no memory"):
        detector.detect_batch([IMAGE] * 3, [0.0, 0.1, 0.2])
    for _ in range(2):
        assert [len(found) for found in detector.detect_batch([IMAGE] * 3, [0.0, 0.1, 0.2])] == [2, 2, 2]
    assert ran == [3, 1, 3, 1, 1, 1, 1, 1, 1], "a failure of another reason is no reason to go one by one"


@pytest.mark.parametrize(
    ("side", "box", "head", "foot", "size"),
    [
        ("top", [20.0, 14.0, 10.0, 28.0], False, True, False),
        ("bottom", [20.0, 34.0, 10.0, 28.0], True, False, False),
        ("left", [5.0, 24.0, 10.0, 28.0], False, False, False),
        ("none", [20.0, 24.0, 10.0, 28.0], True, True, True),
    ],
)
def test_what_the_image_border_cuts_is_not_measured(
    tmp_path: Path, side: str, box: list[float], head: bool, foot: bool, size: bool
) -> None:
    (person,) = detect(tmp_path, {"o": [[lone(np.array(box), 0.9, 0)]]}, 'layout = "end2end"')
    assert (person.head is not None, person.foot is not None, person.size > 0.0) == (head, foot, size), side
    assert person.covariance is not None
    assert (person.covariance[0] > 100.0) == (side == "left")


@pytest.mark.parametrize(
    ("toml", "outputs", "message"),
    [
        ('layout = "yolov8"', {"o": np.zeros((1, 4, 50))}, r"outputs \(detections 4x50\) do not fit"),
        ('layout = "yolov8"', {"o": np.zeros((1, 5, 50))}, "class 2 is beyond the model's 1 classes"),
        ('layout = "yolov8"', {"o": np.zeros((1, 50))}, r"outputs \(detections 1x50\) do not fit"),
        ('layout = "yolov8"', {"o": np.zeros((1, 1, 7, 50))}, "output for detections is 1x1x7x50 for 1 images"),
        ('layout = "yolov8"', {"o": np.full((1, 7, 50), np.nan)}, "not finite"),
        ('layout = "yolov8"', {"o": np.full((1, 7, 50), 8.0)}, "scores reach 8 to 8"),
        (f'layout = "yolov8"\n{POINTS}', {"o": np.zeros((1, 12, 50))}, "with 3 keypoints"),
        ('layout = "end2end"', {"o": np.zeros((1, 50, 7))}, "do not fit"),
        ('layout = "yolox"', {"o": np.zeros((1, 50, 8))}, "do not fit"),
        ('layout = "detr"', {"o": np.zeros((1, 50, 4))}, "no output 'logits' for scores; its outputs are o 1x50x4"),
        ('layout = "detr"', {"logits": np.full((1, 50, 80), -5.0), "pred_boxes": np.ones((1, 50, 4))},
         'of an empty image 0 % of the candidates are "no object".*set activation = "sigmoid"'),
        ('layout = "separate"', {"boxes": np.zeros((1, 5, 4)), "scores": np.zeros((1, 6)), "labels": np.zeros((1, 5))},
         "do not fit"),
        ('outputs = { boxes = "o" }', {"o": np.zeros((1, 7, 50))}, "outputs.boxes has no meaning"),
        ('outputs = { detections = "x" }', {"o": np.zeros((1, 7, 50))}, "no output 'x'"),
    ],
)  # fmt: skip
def test_outputs_that_are_not_as_described_are_one_line(
    tmp_path: Path, toml: str, outputs: dict[str, Array], message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        detect(tmp_path, outputs, toml)
    assert "model.onnx" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_classes_and_boxes_that_make_no_sense_are_no_detections(tmp_path: Path) -> None:
    rows = [
        lone(PERSON, 0.9, 7), lone(PERSON, 0.9, -1), lone(PERSON, 0.9, 1e9), [25.0, 39.0, 15.0, 9.0, 0.9, 0.0],
        [-900.0, 0.0, -800.0, 10.0, 0.9, 0.0], [1e30, 0.0, 1e31, 9.0, 0.9, 0.0],
    ]  # fmt: skip
    assert detect(tmp_path, {"o": [rows]}, 'layout = "end2end"') == []
