"""Rendered sessions like the four webcams: 4 to 6 unsynchronised cameras round a moved board, without and with lenses.

    python -m tests.bench.board_sessions [--seeds 1 2 3] [--keep FOLDER]

Every session has its own board (ChArUco, inverted or not, or chessboard), frame rates (6 to 30), image sizes, lenses
(k1 to k3, tangential, principal point), starts, stamps, exposure and readout times, defocus, noise and compression.
`syncline calibrate VIDEOS --detector KIND --out OUT` runs without lenses and with the true ones. Printed against the
truth after one similarity: cameras, worst rotation, worst centre, scale, worst lag over half a frame, CPU; then focal
lengths and lags over their stds.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from deploy.cli import run
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import fit_similarity
from protocols.geometry.types import Floats, Image
from protocols.session.calibration import read_calibration
from tests.support.board_session import BoardCamera, BoardWorld, board_world
from tests.support.videos import write_video_frames

SECONDS = 14.0
_PIXELS, _SUB = 40, 2  # of a square of the drawing; samples of a pixel each way
_BOARDS = (  # kind, squares, square [m], inverted, dictionary, ratio
    ("charuco", (5, 7), 0.045, False, "4X4_50", 0.75),
    ("charuco", (4, 5), 0.06, True, "5X5_100", 0.7),
    ("chessboard", (8, 5), 0.05, False, "4X4_50", 0.75),
    ("charuco", (7, 5), 0.04, False, "6X6_250", 0.8),
    ("chessboard", (7, 6), 0.045, False, "4X4_50", 0.75),
)
_NAMES = {False: "no lenses", True: "given lenses"}
_SIZES = ((640, 480), (848, 480), (800, 600))


@dataclass(frozen=True)
class Session:
    """One session. exposure, readout [s], defocus (sigma) [px] and crf by camera."""

    world: BoardWorld
    kind: str
    squares: tuple[int, int]
    square: float
    inverted: bool
    dictionary: str
    ratio: float
    exposure: dict[str, float]
    readout: dict[str, float]
    defocus: dict[str, float]
    crf: dict[str, str]

    @property
    def board_toml(self) -> str:
        """The description that a user writes."""
        text = f'board = "{self.kind}"\nsquares = "{self.squares[0]}x{self.squares[1]}"\nsquare_size = {self.square}\n'
        return text + (f'dictionary = "{self.dictionary}"\nratio = {self.ratio}\n' if self.kind == "charuco" else "")


def session(seed: int) -> Session:
    """The session of a seed."""
    rng = np.random.default_rng([seed, 31])
    kind, squares, square, inverted, dictionary, ratio = _BOARDS[seed % len(_BOARDS)]
    fps = tuple(rng.choice([6.0, 10.0, 12.0, 15.0, 25.0, 29.97], int(rng.integers(4, 7))).tolist())
    world = board_world(seed, fps, 3.0, squares, square)
    cameras = {name: replace(one, lens=_lens(rng)) for name, one in world.cameras.items()}
    names = list(cameras)
    exposure = {name: float(rng.uniform(0.002, 0.015)) for name in names}
    readout = {name: float(rng.uniform(0.0, 0.02)) for name in names}
    defocus = {name: float(rng.uniform(0.3, 0.9)) for name in names}
    crf = {name: str(rng.integers(18, 27)) for name in names}
    world = replace(world, cameras=cameras)
    return Session(world, kind, squares, square, inverted, dictionary, ratio, exposure, readout, defocus, crf)


def _lens(rng: np.random.Generator) -> Intrinsics:
    width, height = _SIZES[int(rng.integers(len(_SIZES)))]
    focal = width * rng.uniform(0.62, 1.0)
    place = np.array([0.5 * (width - 1), 0.5 * (height - 1)]) + rng.normal(0.0, 0.012 * width, 2)
    matrix = np.array([[focal, 0.0, place[0]], [0.0, focal * (1.0 + rng.normal(0.0, 5e-4)), place[1]], [0.0, 0.0, 1.0]])
    # Of real webcams: barrel, and what is left after it.
    bend = [rng.uniform(-0.35, 0.12), rng.uniform(-0.05, 0.18), *rng.normal(0.0, 7e-4, 2), rng.uniform(-0.08, 0.02)]
    return Intrinsics(width, height, matrix, np.array(bend))


def _drawing(one: Session) -> Image:
    """The print with a margin one square wide."""
    columns, rows = one.squares
    if one.kind == "chessboard":
        picture = np.kron(np.indices((rows, columns)).sum(axis=0) % 2 * 215 + 20, np.ones((_PIXELS, _PIXELS)))
        picture = np.pad(picture.astype(np.uint8), _PIXELS, constant_values=235)
    else:
        book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{one.dictionary}"))
        board = cv2.aruco.CharucoBoard(one.squares, 1.0, one.ratio, book)
        size = (columns + 2) * _PIXELS, (rows + 2) * _PIXELS
        picture = np.asarray(board.generateImage(size, marginSize=_PIXELS), dtype=np.uint8)
    return np.asarray(255 - picture if one.inverted else picture, dtype=np.uint8)


def frames(one: Session, name: str, seed: int) -> Iterator[tuple[float, Image]]:
    """Time stamps [s] and images of one camera."""
    camera, drawing, rng = one.world.cameras[name], _drawing(one), np.random.default_rng([seed, sum(map(ord, name))])
    lens = camera.lens
    scene = rng.integers(60, 180, (lens.height // 60 + 2, lens.width // 60 + 2), dtype=np.uint8)
    scene = cv2.resize(scene, (lens.width, lens.height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    noise = 2.5 * rng.standard_normal((lens.height, lens.width), dtype=np.float32)
    rays = _rays(lens)
    for frame in range(int(SECONDS * camera.fps)):
        middle = frame / camera.fps + rng.normal(0.0, 0.002)
        picture = _draw(one, camera, name, drawing, rays, scene, middle)
        picture += np.roll(noise, rng.integers(0, 400, 2), (0, 1))
        grey = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        yield frame / camera.fps, np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))


def _rays(lens: Intrinsics) -> npt.NDArray[np.float32]:
    """Normalised coordinates (H * sub, W * sub, 2) of the samples."""
    u, v = ((np.arange(count * _SUB) + 0.5) / _SUB - 0.5 for count in (lens.width, lens.height))
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    return lens.unproject(grid.reshape(-1, 2)).reshape(grid.shape).astype(np.float32)


def _draw(
    one: Session,
    camera: BoardCamera,
    name: str,
    drawing: Image,
    rays: npt.NDArray[np.float32],
    scene: npt.NDArray[np.float32],
    middle: float,
) -> npt.NDArray[np.float32]:
    """The image (H, W) at a camera time, with the blur of its exposure and the readout of its rows."""
    picture = scene.copy()
    half = 0.5 * np.array(one.squares) + 1.0
    corners = np.array([[x, y, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]) * [*half, 0.0] * one.square
    turn, place = _pose(one, camera, middle)
    seen = camera.lens.project(corners @ turn.T + place)
    if turn[:, 2] @ place < 0.1 * np.linalg.norm(place) or not np.isfinite(seen).all():
        return picture
    low = np.maximum(np.floor(seen.min(axis=0) - 40), 0).astype(int)
    high = np.minimum(np.ceil(seen.max(axis=0) + 40), [camera.lens.width, camera.lens.height]).astype(int)
    if (high - low < 8).any():
        return picture
    part = np.ascontiguousarray(rays[low[1] * _SUB : high[1] * _SUB, low[0] * _SUB : high[0] * _SUB])
    # Where the samples lie on the print is a parabola of time over the readout and the exposure.
    span = 0.5 * (one.readout[name] + one.exposure[name])
    before, now, after = (
        cv2.perspectiveTransform(part, _onto_print(one, *_pose(one, camera, middle + k * span))) for k in (-1, 0, 1)
    )
    speed, bend = 0.5 * (after - before), 0.5 * (after + before) - now
    row = (low[1] + np.arange(part.shape[0], dtype=np.float32) / _SUB) / camera.lens.height - 0.5
    size = int(high[0] - low[0]), int(high[1] - low[1])
    total, steps = np.zeros((size[1], size[0], 2), dtype=np.float32), (-0.33, 0.0, 0.33)
    layers = np.dstack([drawing, np.full_like(drawing, 255)])
    for step in steps:
        at = ((row * one.readout[name] + step * one.exposure[name]) / span)[:, None, None].astype(np.float32)
        print_ = cv2.remap(layers, now + at * (speed + at * bend), None, cv2.INTER_LINEAR, borderValue=(0, 0))
        total += cv2.resize(print_.astype(np.float32), size, interpolation=cv2.INTER_AREA) / len(steps)
    window = picture[low[1] : high[1], low[0] : high[0]]
    window *= 1.0 - total[..., 1] / 255.0
    window += total[..., 0]
    window[:] = cv2.GaussianBlur(window, (0, 0), one.defocus[name])
    return picture


def _pose(one: Session, camera: BoardCamera, time_s: float) -> tuple[Floats, Floats]:
    """Rotation, camera from board, and place of the board's middle in the camera's axes."""
    turn, place = one.world.board(time_s * camera.rate + camera.offset)
    return camera.pose.rotation @ turn, camera.pose.camera_from_world(place[None])[0]


def _onto_print(one: Session, turn: Floats, place: Floats) -> Floats:
    """Homography (3, 3) from normalised coordinates to pixels of the drawing."""
    half = 0.5 * np.array(one.squares) + 1.0
    scale = np.array([[_PIXELS / one.square, 0, half[0] * _PIXELS - 0.5], [0, _PIXELS / one.square, 0], [0, 0, 1.0]])
    scale[1, 2] = half[1] * _PIXELS - 0.5
    return scale @ np.linalg.inv(np.column_stack([turn[:, 0], turn[:, 1], place]))


def render(one: Session, folder: Path, seed: int) -> None:
    """Write the videos and board.toml of a session."""
    folder.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    for name, camera in one.world.cameras.items():
        file, size = folder / f"{name}.mp4", (camera.lens.width, camera.lens.height)
        if not file.exists():
            write_video_frames(file, size, frames(one, name, seed), crf=one.crf[name])
    (folder / "board.toml").write_text(one.board_toml)


def score(one: Session, folder: Path, lenses: bool) -> tuple[str, Floats, Floats]:
    """A line of figures; errors over stds of lags and of focal lengths."""
    rig, out = folder / "rig.toml", folder.parent / f"{folder.name}-{'given' if lenses else 'own'}"
    rig.unlink(missing_ok=True)
    if lenses:
        rig.write_text("".join(_table(name, camera) for name, camera in one.world.cameras.items()))
    began, printed = time.process_time(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()) as errors:
        status = run(["calibrate", str(folder), "--detector", one.kind, "--out", str(out)])
    spent, nothing = time.process_time() - began, np.zeros(0)
    if status != 0:
        return f"exit {status}: {errors.getvalue()[-300:]!r} {spent:.0f} s", nothing, nothing
    _, found = read_calibration(out / "calibration.toml")
    true = one.world.cameras
    places, real = (np.array([c[name].pose.position for name in found]) for c in (found, true))
    fit = fit_similarity(places, real)
    turns = [so3.angle_between(fit.pose(found[n].pose).rotation, true[n].pose.rotation) for n in found]
    result = json.loads((out / "result.json").read_text())
    lags, halves, z = [], [], []
    first = next(iter(found))
    for name, row in result["cameras"].items():
        if name not in found or name == first or not row.get("lag_std_s"):
            continue
        at, mine, base = row["lag_time_s"], true[name], true[first]
        clock = found[name].time_map
        # The reference time of this camera's time, by the estimate and in truth (the reference is a camera's clock).
        camera_time = (at - clock.time_offset) / clock.clock_rate
        error = at - (mine.rate * camera_time + mine.offset - base.offset) / base.rate
        lags.append(abs(error))
        halves.append(2.0 * abs(error) * mine.fps)
        z.append(error / row["lag_std_s"])
    stds = {name: float(result["cameras"][name].get("focal_std") or 0.0) for name in found}
    focal = [np.log(found[n].intrinsics.focal / true[n].lens.focal) / std for n, std in stds.items() if std > 0.0]
    worst = 100 * float(np.linalg.norm(fit.points(places) - real, axis=1).max())
    line = (
        f"{len(found)} of {len(true)} cameras, {np.degrees(max(turns)):.2f}°, {worst:.2f} cm, "
        f"scale {100 * abs(fit.scale - 1):.2f} %, lag {1e3 * max(lags, default=0.0):.1f} ms "
        f"({max(halves, default=0.0):.2f} of half a frame), {spent:.0f} s"
    )
    return line, np.array(z), np.array(focal)


def _table(name: str, camera: BoardCamera) -> str:
    lens = camera.lens
    values = f"matrix = {lens.matrix.tolist()}\ndistortions = {lens.distortions.tolist()}"
    return f'[{name}]\nname = "{name}"\nsize = [{lens.width}, {lens.height}]\n{values}\n'


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 8)))
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    scores: dict[bool, list[tuple[Floats, Floats]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as temporary:
        for seed in options.seeds:
            one, folder = session(seed), (options.keep or Path(temporary)) / f"session-{seed}"
            render(one, folder, seed)
            rates = ", ".join(f"{camera.fps:g}" for camera in one.world.cameras.values())
            print(f"seed {seed}: {one.kind} {one.squares[0]}x{one.squares[1]}, fps {rates}", flush=True)
            for lenses in (False, True):
                line, lag, focal = score(one, folder, lenses)
                print(
                    f"  {'given lenses' if lenses else 'no lenses'}: {line}; z {lag.round(1)} {focal.round(1)}",
                    flush=True,
                )
                scores[lenses].append((lag, focal))
    for lenses, parts in scores.items():
        lag, focal = (np.concatenate([np.zeros(0), *(part[k] for part in parts)]) for k in (0, 1))
        rms = [f"{np.sqrt(np.mean(z**2)):.2f} ({len(z)})" if len(z) else "-" for z in (lag, focal)]
        print(f"{_NAMES[lenses]}: rms of errors over stds: lags {rms[0]}, focal {rms[1]}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
