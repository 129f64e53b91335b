"""Trains the small person network of the tests on rendered rooms, and writes it as ONNX: boxes and seven keypoints.

    pip install jax onnx
    python -m tests.support.networks.train [--out tests/support/networks/person.onnx]

It proves the path from an ONNX file to detections, and is good for rendered rooms only. A fully convolutional network
of stride 8 with a receptive field of 175 px: each cell gives a score (CenterNet's focal loss on a Gaussian at the
centre of each box; Zhou et al. 2019), the distances to the sides of the box (FCOS; Tian et al. 2019), and keypoints
relative to the cell. The graph ends in YOLOv8's layout. The same seed and versions give the same file; a quarter of an
hour on one core.
"""

from __future__ import annotations

import argparse
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge import scenes
from edge.scenes.people.renderer import PeopleRenderer
from edge.scenes.people.walking import JOINTS

Arrays = dict[str, Any]
SIZE = 320, 240
STRIDE = 8
CELLS = SIZE[0] // STRIDE, SIZE[1] // STRIDE
KEYPOINTS = {
    "nose": "head", "left_shoulder": "shoulder_l", "right_shoulder": "shoulder_r", "left_hip": "hip_l",
    "right_hip": "hip_r", "left_ankle": "ankle_l", "right_ankle": "ankle_r",
}  # fmt: skip
_JOINTS = [JOINTS.index(name) for name in KEYPOINTS.values()]
_CHANNELS, _DILATIONS = (3, 12, 24, 32), (1, 2, 4, 2, 1)
_VALUES = 5 + 3 * len(KEYPOINTS)
_KEYPOINT_SCALE = 64.0  # px: of the raw outputs
_FIRST_SEED, _VISIBLE, _BODY = 2000, 0.3, 0.45


def examples(rooms: int, images: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
    """Rendered images (n, 240, 320, 3) BGR, and people (n, 12, 5 + 21): box, weight, keypoints u, v, seen [px].

    Weight 1: visible; 0: too little of them to learn from; NaN: nobody.
    """
    pictures, people = [], []
    for seed in range(_FIRST_SEED, _FIRST_SEED + rooms):
        rng = np.random.default_rng([seed, 7])
        scene = scenes.get_people_scene(seed, None, 1 + seed % 6)
        camera = scene.cameras[seed % len(scene.cameras)]
        renderer = PeopleRenderer(scene, camera.name, rng, float(rng.uniform(1.0, 6.0)))
        shrink = np.array(SIZE) / (camera.intrinsics.width, camera.intrinsics.height)
        for moment in rng.uniform(0.0, 60.0, images):
            image, owners = renderer.render_with_owners(float(moment))
            pictures.append(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA))
            table = np.full((12, 5 + 3 * len(KEYPOINTS)), np.nan, np.float32)
            boxes = scene.boxes(camera.name, float(moment))
            joints = scene.seen_by(camera.name, scene.joints(np.array([moment]))[0][:, _JOINTS])
            for index in np.flatnonzero(np.isfinite(boxes).all(axis=1) & np.isfinite(joints).all(axis=(1, 2))):
                x, y, w, h = boxes[index]
                visible = (owners == index + 1).sum() / (_BODY * w * h)
                table[index, :4] = np.array([x + 0.5, y + 0.5, w, h]) * np.tile(shrink, 2)
                table[index, 4] = visible > _VISIBLE
                points = (joints[index] + 0.5) * shrink
                inside = ((points > 0) & (points < SIZE)).all(axis=1)
                table[index, 5:] = np.column_stack([points, inside]).ravel()
            people.append(table)
    return np.stack(pictures), np.stack(people)


def augmented(
    picture: npt.NDArray[np.uint8], table: npt.NDArray[np.float32], rng: np.random.Generator
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """An image (3, 240, 320) RGB 0..1 and its people, mirrored, scaled, shifted and in other light at random."""
    table = table.copy()
    scale = float(np.exp(rng.uniform(np.log(0.7), np.log(1.4))))
    shift = rng.uniform(-0.5, 0.5, 2) * (np.array(SIZE) * abs(1.0 - scale) + 20.0) + 0.5 * (1.0 - scale) * np.array(
        SIZE
    )
    mirrored = bool(rng.integers(2))
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    if mirrored:
        matrix = np.array([[-1.0, 0.0, SIZE[0] - 1.0], [0.0, 1.0, 0.0]]) @ np.vstack([matrix, [0.0, 0.0, 1.0]])
    warped = cv2.warpAffine(picture, matrix, SIZE, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    gain = rng.uniform(0.6, 1.4) * rng.uniform(0.85, 1.15, 3)
    image = np.clip(warped[:, :, ::-1] * (gain / 255.0) + rng.uniform(-0.1, 0.1), 0.0, 1.0)
    table[:, :4] *= scale
    table[:, :2] += shift
    points = table[:, 5:].reshape(len(table), -1, 3)
    points[:, :, :2] = points[:, :, :2] * scale + shift
    if mirrored:
        table[:, 0] = SIZE[0] - table[:, 0] - table[:, 2]
        points[:, :, 0] = SIZE[0] - points[:, :, 0]
        points[:, 1:] = points[:, [2, 1, 4, 3, 6, 5]]
    low = np.clip(table[:, :2], 0.0, SIZE)
    high = np.clip(table[:, :2] + table[:, 2:4], 0.0, SIZE)
    whole = table[:, 2] * table[:, 3]
    table[:, :2], table[:, 2:4] = low, high - low
    shown = table[:, 2] * table[:, 3] / np.maximum(whole, 1e-3)
    table[~(shown > 0.02)] = np.nan
    table[:, 4] = np.where(shown > 0.5, table[:, 4], np.where(np.isnan(table[:, 4]), np.nan, 0.0))
    points[:, :, 2] *= ((points[:, :, :2] > 0) & (points[:, :, :2] < SIZE)).all(axis=2)
    return image.transpose(2, 0, 1).astype(np.float32), table


def targets(table: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The wanted values (26, 30, 40): heat, box and keypoints; and weights (3, 30, 40) of heat, box, keypoints."""
    wanted = np.zeros((_VALUES, CELLS[1], CELLS[0]), np.float32)
    weight = np.zeros((3, CELLS[1], CELLS[0]), np.float32)
    weight[0] = 1.0
    v, u = np.meshgrid(*((np.arange(n) + 0.5) * STRIDE for n in CELLS[::-1]), indexing="ij")
    for row in table[np.isfinite(table[:, 4])]:
        x, y, w, h = row[:4]
        middle = x + 0.5 * w, y + 0.5 * h
        if row[4] == 0.0:
            inside = (np.abs(u - middle[0]) < 0.5 * w) & (np.abs(v - middle[1]) < 0.5 * h)
            weight[0][inside & (wanted[0] < 0.3)] = 0.0
            continue
        heat = np.exp(
            -0.5 * (((u - middle[0]) / max(0.12 * w, 3.0)) ** 2 + ((v - middle[1]) / max(0.06 * h, 3.0)) ** 2)
        )
        column, line = (min(int(at // STRIDE), n - 1) for at, n in zip(middle, CELLS, strict=True))
        heat[line, column] = 1.0
        near = (heat > 0.4) & (heat > wanted[0])
        wanted[0] = np.maximum(wanted[0], heat)
        sides = np.stack([u - x, v - y, x + w - u, y + h - v])
        near &= (sides > 1.0).all(axis=0)
        wanted[1:5, near] = sides[:, near]
        weight[1:, near] = heat[near]
        points = row[5:].reshape(-1, 3)
        for k, (pu, pv, seen) in enumerate(points):
            wanted[5 + 3 * k : 8 + 3 * k, near] = np.stack([pu - u, pv - v, np.full_like(u, seen)])[:, near]
    return wanted, weight


def initial(rng: np.random.Generator) -> Arrays:
    """He initialisation; the bias of the scores so that they begin at 0.02."""
    shapes = [(n, m, 3, 3) for m, n in pairwise(_CHANNELS)]
    shapes += [(_CHANNELS[-1], _CHANNELS[-1], 3, 3)] * len(_DILATIONS) + [(_VALUES, _CHANNELS[-1], 1, 1)]
    weights: Arrays = {}
    for index, shape in enumerate(shapes):
        std = np.sqrt(2.0 / np.prod(shape[1:])) * (0.3 if index == len(shapes) - 1 else 1.0)
        weights[f"w{index}"] = (std * rng.standard_normal(shape)).astype(np.float32)
        weights[f"b{index}"] = np.zeros(shape[0], np.float32)
    weights[f"b{len(shapes) - 1}"][0] = -4.0
    weights[f"b{len(shapes) - 1}"][1:5] = np.log(np.array([20.0, 45.0, 20.0, 45.0]) / STRIDE)
    return weights


def layers() -> list[tuple[int, int, bool]]:
    """Stride, dilation and whether the input is added, of each hidden layer."""
    return [(2, 1, False)] * (len(_CHANNELS) - 1) + [(1, dilation, True) for dilation in _DILATIONS]


def raw_outputs(weights: Arrays, images: Any) -> Any:
    """The raw values (n, 26, 30, 40) of images (n, 3, 240, 320)."""
    import jax
    from jax import lax

    values = images
    hidden = layers()
    for index, (stride, dilation, residual) in enumerate(hidden):
        padding = [(dilation, dilation)] * 2
        found = lax.conv_general_dilated(
            values, weights[f"w{index}"], (stride, stride), padding, rhs_dilation=(dilation, dilation)
        )
        found = jax.nn.relu(found + weights[f"b{index}"][None, :, None, None])
        values = values + found if residual else found
    last = len(hidden)
    return (
        lax.conv_general_dilated(values, weights[f"w{last}"], (1, 1), "VALID")
        + weights[f"b{last}"][None, :, None, None]
    )


def loss(weights: Arrays, images: Any, wanted: Any, weight: Any) -> Any:
    """Penalty-reduced focal loss of the scores, and absolute errors of the logarithms of sides and of keypoints."""
    import jax
    import jax.numpy as jnp

    raw = raw_outputs(weights, images)
    heat = wanted[:, 0]
    log_p, log_q = jax.nn.log_sigmoid(raw[:, 0]), jax.nn.log_sigmoid(-raw[:, 0])
    p = jnp.exp(log_p)
    positive = heat >= 1.0
    focal = -jnp.where(positive, (1 - p) ** 2 * log_p, (1 - heat) ** 4 * p**2 * log_q) * weight[:, 0]
    people = jnp.maximum(positive.sum(), 1)
    sides = jnp.abs(raw[:, 1:5] - jnp.log(jnp.maximum(wanted[:, 1:5], 1.0) / STRIDE)).mean(axis=1)
    points, target = (one.reshape(len(raw), -1, 3, *one.shape[2:]) for one in (raw[:, 5:], wanted[:, 5:]))
    seen = target[:, :, 2]
    distance = (jnp.abs(points[:, :, :2] - target[:, :, :2] / _KEYPOINT_SCALE).sum(axis=2) * seen).mean(axis=1)
    certain = -(seen * jax.nn.log_sigmoid(points[:, :, 2]) + (1 - seen) * jax.nn.log_sigmoid(-points[:, :, 2])).mean(
        axis=1
    )
    near = jnp.maximum(weight[:, 1].sum(), 1.0)
    return focal.sum() / people + ((3.0 * sides + 2.0 * distance + 0.3 * certain) * weight[:, 1]).sum() / near


def train(steps: int, rooms: int, images: int, batch: int, seed: int) -> Arrays:
    """Adam with a cosine schedule."""
    import jax
    import jax.numpy as jnp

    pictures, people = examples(rooms, images)
    print(f"{len(pictures)} images", flush=True)
    rng = np.random.default_rng(seed)
    weights = initial(rng)
    first, second = ({name: jnp.zeros_like(one) for name, one in weights.items()} for _ in range(2))

    @jax.jit
    def step(weights: Arrays, first: Arrays, second: Arrays, number: Any, data: Any) -> Any:
        value, slope = jax.value_and_grad(loss)(weights, *data)
        rate = 2e-3 * 0.5 * (1.0 + jnp.cos(jnp.pi * number / steps)) * jnp.minimum(1.0, (number + 1) / 100)
        size = jnp.sqrt(sum((one**2).sum() for one in slope.values()))
        slope = jax.tree.map(lambda one: one * jnp.minimum(1.0, 5.0 / size), slope)
        first = jax.tree.map(lambda a, b: 0.9 * a + 0.1 * b, first, slope)
        second = jax.tree.map(lambda a, b: 0.99 * a + 0.01 * b**2, second, slope)
        c1, c2 = 1 - 0.9 ** (number + 1), 1 - 0.99 ** (number + 1)
        moved = jax.tree.map(lambda w, a, b: w - rate * (a / c1) / (jnp.sqrt(b / c2) + 1e-8), weights, first, second)
        return moved, first, second, value

    running = 0.0
    for number in range(steps):
        chosen = [augmented(pictures[k], people[k], rng) for k in rng.integers(len(pictures), size=batch)]
        wanted, weight = zip(*(targets(table) for _, table in chosen), strict=True)
        data = np.stack([image for image, _ in chosen]), np.stack(wanted), np.stack(weight)
        weights, first, second, value = step(weights, first, second, float(number), data)
        running += float(value)
        if number % 100 == 99:
            print(f"step {number + 1}: loss {running / 100:.3f}", flush=True)
            running = 0.0
    return {name: np.asarray(one) for name, one in weights.items()}


def to_onnx(weights: Arrays) -> Any:
    """The network as an ONNX model: images (n, 3, 240, 320) to detections (n, 26, 1200) in YOLOv8's layout."""
    from onnx import TensorProto, helper, numpy_helper

    nodes, stored = [], []

    def constant(name: str, value: npt.NDArray[Any]) -> str:
        stored.append(numpy_helper.from_array(value, name))
        return name

    def add(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    value = "images"
    hidden = layers()
    for index in range(len(hidden) + 1):
        w, b = (constant(f"{part}{index}", weights[f"{part}{index}"]) for part in "wb")
        if index == len(hidden):
            value = add("Conv", [value, w, b], "raw")
            break
        stride, dilation, residual = hidden[index]
        made = {"strides": [stride] * 2, "pads": [dilation] * 4, "dilations": [dilation] * 2, "kernel_shape": [3, 3]}
        found = add("Relu", [add("Conv", [value, w, b], f"conv{index}", **made)], f"relu{index}")
        value = add("Add", [value, found], f"sum{index}") if residual else found
    flat = add("Reshape", ["raw", constant("flat_shape", np.array([0, _VALUES, -1], np.int64))], "flat")
    v, u = np.meshgrid(*((np.arange(n) + 0.5) * STRIDE for n in CELLS[::-1]), indexing="ij")
    grid = np.stack([u.ravel(), v.ravel()])[None].astype(np.float32)

    def part(begin: int, end: int, name: str) -> str:
        limits = [constant(f"{name}_{k}", np.array([one], np.int64)) for k, one in enumerate((begin, end, 1))]
        return add("Slice", [flat, *limits], name)

    def exp(name: str, begin: int) -> str:
        limited = add("Clip", [part(begin, begin + 2, name), "low", "high"], f"{name}_limited")
        return add("Mul", [add("Exp", [limited], f"{name}_exp"), "stride"], f"{name}_px")

    constant("low", np.array(-5.0, np.float32))
    constant("high", np.array(5.0, np.float32))
    constant("stride", np.array(STRIDE, np.float32))
    constant("half", np.array(0.5, np.float32))
    constant("grid", grid)
    near, far = exp("near", 1), exp("far", 3)
    moved = add("Mul", [add("Sub", [far, near], "difference"), "half"], "shift")
    pieces = [add("Add", ["grid", moved], "centre"), add("Add", [near, far], "sides")]
    pieces.append(add("Sigmoid", [part(0, 1, "logit")], "score"))
    constant("keypoint_scale", np.array(_KEYPOINT_SCALE, np.float32))
    for k, name in enumerate(KEYPOINTS):
        offset = add("Mul", [part(5 + 3 * k, 7 + 3 * k, f"{name}_raw"), "keypoint_scale"], f"{name}_offset")
        pieces.append(add("Add", ["grid", offset], name))
        pieces.append(add("Sigmoid", [part(7 + 3 * k, 8 + 3 * k, f"{name}_logit")], f"{name}_seen"))
    add("Concat", pieces, "detections", axis=1)
    cells = CELLS[0] * CELLS[1]
    graph = helper.make_graph(
        nodes,
        "person",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, ["batch", 3, SIZE[1], SIZE[0]])],
        [helper.make_tensor_value_info("detections", TensorProto.FLOAT, ["batch", _VALUES, cells])],
        stored,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("person.onnx"))
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--rooms", type=int, default=120)
    parser.add_argument("--images", type=int, default=12, help="of each room")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    model = to_onnx(train(options.steps, options.rooms, options.images, options.batch, options.seed))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_bytes(model.SerializeToString())
    print(f"{options.out}: {options.out.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
