"""Clips of a moved board: the four webcams, and simulated boards with imperfect prints and no lenses.

    python -m tests.bench.board_clips [--worlds 3] [--data FOLDER]
    python -m tests.bench.board_clips --cut

Webcams: `calibrate` with the recording's lenses and without, against its calibration; then the lenses that each half of
the clips gives, and the residuals with either lens on independent clocks. Needs ../shared/data.
--cut: how many drawn chessboards are found that a side of the image cuts, and how far their corners are off.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.cli import run
from edge.detectors.board.description import parse_board
from edge.detectors.board.detector import BoardDetector
from hub.calibration.pipeline import calibrate
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import fit_similarity
from protocols.session.calibration import CameraCalibration, read_calibration
from protocols.session.folder import read_folder
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from tests.bench.real_rigs import DEFAULT_DATA
from tests.support.board_session import board_world
from tests.support.boards import cut_chessboards

BOARD = 'board = "charuco"\nsquares = "4x5"\nsquare_size = 0.054\ninverted = true\n'
PRINT = 8e-5  # m: std of a corner's place on a simulated print


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=3)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA)
    parser.add_argument("--cut", action="store_true")
    options = parser.parse_args()
    if options.cut:
        return cut()
    worlds, data = options.worlds, options.data / "webcams"
    if data.exists():
        webcams(data)
    else:
        print(f"no {data}: webcams left out")
    off, scores = np.concatenate([simulated(seed) for seed in range(100, 100 + worlds)]).T
    rms = [float(np.sqrt(np.mean(column**2))) for column in (off, scores)]
    print(
        f"simulated, 4 cameras at 6 fps, no lenses: focal lengths off by {100 * rms[0]:.2f} %, {rms[1]:.2f} stds (rms)"
    )
    worst = np.max([fisheye(seed) for seed in range(100, 100 + worlds)], axis=0)
    print(f"simulated, 4 fisheye lenses not given: {worst[0]:.2f}°, {worst[1]:.2f} cm, focal lengths {worst[2]:.2f} %")
    return 0


def cut() -> int:
    """Boards of 9x6 squares, 24 views of each case, seeds that no test has."""
    board = parse_board({"board": "chessboard", "squares": "9x6", "inverted": False})
    for hidden in (1, 2, 3, 4):
        found, off = 0, [0.0]
        for image, truth in cut_chessboards((9, 6), 24, hidden, seed=700 + hidden):
            numbers, pixels = BoardDetector(board).find(image)
            found += len(numbers) > 0
            off += np.linalg.norm(pixels - truth[numbers], axis=1).tolist()
        worst, rms = max(off), float(np.sqrt(np.mean(np.square(off))))
        print(
            f"{hidden} rows or columns hidden: found in {found} of 24, corners {rms:.3f} px off, worst {worst:.2f} px"
        )
    return 0


def webcams(data: Path) -> None:
    """Against the recording's calibration, and the two halves against each other."""
    truth = {
        name.replace("cam", "cam_"): camera
        for name, camera in read_calibration(data / "session" / "truth_calibration.toml")[1].items()
    }
    with tempfile.TemporaryDirectory() as temporary:
        for given in (True, False):
            folder = Path(temporary) / f"clips-{given}"
            folder.mkdir()
            for video in (data / "video").glob("*.mp4"):
                (folder / video.name).symlink_to(video)
            (folder / "board.toml").write_text(BOARD)
            if given:
                (folder / "rig.toml").write_text("".join(_lens_table(name, one) for name, one in truth.items()))
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                status = run(["calibrate", str(folder), "--detector", "charuco", "--out", str(folder / "out")])
            _, found = read_calibration(folder / "out" / "calibration.toml")
            rig, seen = read_folder(folder / "out" / "session")
            print(f"{'given lenses' if given else 'no lenses'}: exit {status}, {_compared(found, truth, seen)}")
    apart = replace(rig, metadata={key: value for key, value in rig.metadata.items() if key != "in_step"})
    known = {name: replace(camera, intrinsics=truth[name].intrinsics) for name, camera in rig.cameras.items()}
    for text, one, rows in (
        ("first half", apart, _half(seen, True)),
        ("second half", apart, _half(seen, False)),
        ("all, own lenses", apart, seen),
        ("all, given lenses", replace(apart, cameras=known), seen),
    ):
        found = calibrate(one, rows).cameras
        focal = ", ".join(
            f"{100 * (c.intrinsics.focal / truth[n].intrinsics.focal - 1):+.1f} ± {100 * c.focal_std:.1f} %"
            for n, c in found.items()
        )
        print(f"{text}: focal lengths {focal}; rms {', '.join(f'{c.rms_px:.2f}' for c in found.values())} px")


def _compared(found: dict[str, CameraCalibration], truth: dict[str, CameraCalibration], seen: Observations) -> str:
    """Errors after one similarity of the centres. rays: of the directions, in the world, of all corners seen.

    A principal point that lies elsewhere turns a camera's axes, but not what it measures: its rays.
    """
    places, true = (np.array([one[name].pose.position for name in found]) for one in (found, truth))
    fit = fit_similarity(places, true)
    turns = [so3.angle_between(fit.pose(one.pose).rotation, truth[name].pose.rotation) for name, one in found.items()]
    place = 100 * float(np.linalg.norm(fit.points(places) - true, axis=1).max())
    apart = []
    for name, one in found.items():
        pixels = np.concatenate([track.pixels for track in seen.tracks.values() if track.camera == name])
        mine, theirs = _rays(one, pixels) @ fit.rotation.T, _rays(truth[name], pixels)
        apart.append(float(np.sqrt(np.mean(np.linalg.norm(np.cross(mine, theirs), axis=1) ** 2))))
    return (
        f"{place:.2f} cm, {np.degrees(max(turns)):.2f}°, rays {np.degrees(max(apart)):.2f}° (rms of the worst camera), "
        f"scale {100 * abs(fit.scale - 1):.2f} %"
    )


def _rays(camera: CameraCalibration, pixels: np.ndarray) -> np.ndarray:
    """Directions (n, 3) of pixels in the world, of length 1."""
    rays = np.column_stack([camera.intrinsics.unproject(pixels), np.ones(len(pixels))]) @ camera.pose.rotation
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def _lens_table(name: str, camera: CameraCalibration) -> str:
    lens = camera.intrinsics
    values = f"matrix = {lens.matrix.tolist()}\ndistortions = {lens.distortions.tolist()}"
    return f'[{name}]\nname = "{name}"\nsize = [{lens.width}, {lens.height}]\n{values}\n'


def _half(seen: Observations, first: bool) -> Observations:
    middle = 0.5 * max(float(track.time.max()) for track in seen.tracks.values())
    tracks = {key: track.select((track.time < middle) == first) for key, track in seen.tracks.items()}
    return replace(seen, tracks={key: track for key, track in tracks.items() if len(track)})


def simulated(seed: int) -> np.ndarray:
    """Errors of the logarithms of focal lengths, and over their stds: (cameras, 2)."""
    world = board_world(seed, (6.0,) * 4, size=0.054)
    rng = np.random.default_rng(seed)
    printed = {label: point + rng.normal(0.0, PRINT, 3) for label, point in world.points.items()}
    rig: Rig = world.rig(lenses=False)
    found = calibrate(rig, replace(world, points=printed).observations(seed=seed)).cameras
    off = {n: np.log(one.intrinsics.focal / world.cameras[n].lens.focal) for n, one in found.items()}
    return np.array([[value, value / found[n].focal_std] for n, value in off.items()])


def fisheye(seed: int) -> tuple[float, float, float]:
    """Largest errors of rotations [degrees], centres [cm] and focal lengths [%] with lenses of 100 to 130 degrees."""
    world, rng = board_world(seed, (30.0, 25.0, 30.0, 24.0)), np.random.default_rng(seed)
    lenses = {}
    for name in world.cameras:
        focal = rng.uniform(380, 520)
        matrix = np.array([[focal, 0, 639.5 + rng.normal(0, 8)], [0, focal, 359.5 + rng.normal(0, 8)], [0, 0, 1]])
        bend = np.array([rng.uniform(-0.06, 0.06), rng.uniform(-0.02, 0.02), 0.0, 0.0])
        lenses[name] = Intrinsics(1280, 720, matrix, bend, True)
    amplitude = world.motion[0] * np.array([2.2] * 3 + [1.0] * 3)[:, None]  # also near the images' borders
    true = {name: replace(one, lens=lenses[name]) for name, one in world.cameras.items()}
    world = replace(world, cameras=true, motion=(amplitude, *world.motion[1:]))
    found = calibrate(world.rig(lenses=False), world.observations(12.0, seed=seed)).cameras
    places, real = (np.array([one[name].pose.position for name in found]) for one in (found, true))
    fit = fit_similarity(places, real)
    turns = [so3.angle_between(fit.pose(one.pose).rotation, true[name].pose.rotation) for name, one in found.items()]
    focal_off = [abs(one.intrinsics.focal / true[name].lens.focal - 1.0) for name, one in found.items()]
    away = np.linalg.norm(fit.points(places) - real, axis=1).max()
    return float(np.degrees(max(turns))), 100 * float(away), 100 * max(focal_off)


if __name__ == "__main__":
    raise SystemExit(main())
