"""Figure at the top of the README: images of three cameras, and the result.

``python -m tests.figures.demo_picture`` films the demo's world, calibrates it and writes docs/pictures/demo.png.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deploy.simulation.session import simulated_observations
from edge import scenes
from edge.scenes import renderer_for
from edge.scenes.common.base import SimulatedTrack
from edge.scenes.marker.scene import MarkerScene, simulate_tracks
from hub.calibration.pipeline import calibrate
from protocols.geometry.pose import Pose, fit_similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration
from tests.support.written import rig_of_scene

OUT = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "demo.png"
SEED, CAMERAS, SECONDS, SHOWN = 1, 3, 20.0, 6.0


def draw(out: Path = OUT) -> None:
    """Film, calibrate, draw."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scene = scenes.get_marker_scene("marker", SEED, CAMERAS)
    filmed = simulate_tracks(scene, SECONDS, SEED)
    calibration = calibrate(rig_of_scene(scene), simulated_observations(scene, filmed))
    figure = plt.figure(figsize=(12.6, 4.6), dpi=90)
    colours = ["#0072b2", "#d55e00", "#009e73"]
    for i, camera in enumerate(scene.cameras):
        axes = figure.add_axes((0.01, 0.665 - 0.325 * i, 0.2, 0.31))
        _draw_frame(axes, scene, filmed, camera.name, colours[i])
    world = figure.add_axes((0.23, 0.0, 0.42, 1.0), projection="3d")
    _draw_world(world, scene, calibration, colours)
    _draw_errors(figure.add_axes((0.73, 0.16, 0.25, 0.7)), scene, calibration, colours)
    figure.savefig(out, facecolor="white")


def _draw_frame(axes, scene: MarkerScene, filmed: dict[str, SimulatedTrack], name: str, colour: str) -> None:  # type: ignore[no-untyped-def]
    """One rendered frame with the track behind the marker."""
    image = renderer_for(scene, name, np.random.default_rng(0)).render(SHOWN)
    axes.imshow(image[:, :, ::-1])
    track = filmed[name]
    behind = (track.true_time > SHOWN - 1.5) & (track.true_time <= SHOWN)
    axes.plot(*track.pixels[behind].T, color=colour, lw=1.6)
    axes.set_axis_off()
    stamp = track.time[np.searchsorted(track.true_time, SHOWN)]
    axes.text(
        12,
        46,
        f"{name}: {stamp:.3f} s",
        color="white",
        fontsize=8.5,
        family="monospace",
        bbox={"color": "#00000088", "pad": 2},
    )


def _draw_world(axes, scene: MarkerScene, calibration: Calibration, colours: list[str]) -> None:  # type: ignore[no-untyped-def]
    """Recovered cameras and path laid on the true world by one similarity."""
    path = calibration.trajectories[0]
    clock = scene.camera(calibration.reference).clock
    true_time = (path.time - clock.epoch_ns / 1e9) / clock.rate
    align = fit_similarity(path.position, scene.marker_position(true_time))
    points = align.points(path.position)
    cut = np.flatnonzero(np.diff(true_time) > 0.1) + 1
    for part in np.split(points, cut):
        axes.plot(*part.T, color="#666666", lw=0.7)
    for i, (name, camera) in enumerate(calibration.cameras.items()):
        found, truth = align.pose(camera.pose), scene.camera(name).pose
        for pose, style, width in ((truth, ":", 1.0), (found, "-", 1.6)):
            for edge in _frustum(pose):
                axes.plot(*edge.T, style, color=colours[i], lw=width)
        axes.text(*(found.position + [0, 0, 0.25]), name, color=colours[i], fontsize=9)
    axes.set_box_aspect(np.ptp(np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()]), axis=1))
    axes.set_title("where they stand and what moved (dotted: truth)", fontsize=10, y=0.94)
    axes.tick_params(labelsize=6)


def _frustum(pose: Pose, size: float = 0.6) -> list[Floats]:
    corners = size * np.array([[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
    world = pose.world_from_camera(corners)
    rays = [np.array([pose.position, corner]) for corner in world]
    return [*rays, np.vstack([world, world[:1]])]


def _draw_errors(axes, scene: MarkerScene, calibration: Calibration, colours: list[str]) -> None:  # type: ignore[no-untyped-def]
    """Offset error over the recording, with the stated 95 % interval."""
    path = calibration.trajectories[0]
    seconds = path.time - path.time[0]
    for i, (name, camera) in enumerate(calibration.cameras.items()):
        if name == calibration.reference:
            continue
        times = camera.time_map
        truth = scene.true_time_map(name, calibration.reference)
        own = (path.time - times.time_offset) / times.clock_rate
        error = 1e3 * ((times.clock_rate * own + times.time_offset) - (truth.clock_rate * own + truth.time_offset))
        axes.plot(seconds, error, color=colours[i], lw=1.8, label=name)
        middle = 0.5 * seconds[-1]
        half = 1.96e3 * camera.time_offset_std
        axes.errorbar([middle + 0.4 * i], [np.interp(middle, seconds, error)], yerr=[half], color=colours[i], capsize=3)
    axes.axhline(0.0, color="#999999", lw=0.8)
    axes.set_ylim(-0.2, 0.2)
    axes.set_xlabel("time [s]", fontsize=9)
    axes.set_ylabel("error of the time offset [ms]", fontsize=9)
    axes.set_title("when they fired", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    axes.tick_params(labelsize=8)


if __name__ == "__main__":
    draw()
    print(OUT)
