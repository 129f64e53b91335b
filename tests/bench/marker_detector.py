"""Accuracy and speed of the shipped marker detectors on rendered frames with ground truth.

    python -m tests.bench.marker_detector [--quick] [--only ball|others] [--frames 100] [--seeds 4] [--first-seed 0]

Errors are against the projection of the ball's centre at mid-exposure. ``nees`` is the squared error divided by the
reported covariance, 1 if the covariance is right. Distractors (balls and boxes of other hues, wood) are in every frame;
the ball is missing in as many further frames. ``--frames``: per camera of a scene's three cameras; of lights and tags
as many are rendered per case as all scenes together have, in two dozen rooms that are mirrored and change colours.
Videos are consecutive frames through an encoder, "ultrafast" as ``tests/support/videos.py`` writes them, and a decoder.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from edge import scenes
from edge.detectors.marker.ball import MarkerDetector
from edge.detectors.marker.bright import BrightDetector
from edge.detectors.marker.tag import TagDetector
from edge.scenes import renderer_for
from edge.scenes.marker.renderer import MarkerRenderer
from edge.scenes.marker.scene import MarkerScene
from protocols.geometry.types import Floats
from tests.support.rendered_markers import Image, add_distractors, add_spot, add_tag, dim_room, exposed, tag_image
from tests.support.videos import write_video_frames

_ROOMS = 24  # drawn for lights and tags, each used mirrored and with its colours exchanged


@dataclasses.dataclass(frozen=True)
class Result:
    """Results over frames in which the ball is entirely in the image.

    error: (n, 2) [px]. nees, size_ratio, smear [px], seconds: (n,). missed: frames without a detection. false:
    detections more than 5 px away, of all looked_at.
    """

    error: Floats
    nees: Floats
    size_ratio: Floats
    smear: Floats
    seconds: Floats
    frames: int
    missed: int
    false: int
    looked_at: int

    @property
    def rms(self) -> float:
        """RMS of one coordinate [px], including frames in which distractors touch the ball."""
        return float(np.sqrt(np.mean(self.error**2)))


def measure(
    name: str = "marker",
    *,
    seeds: range = range(4),
    frames: int = 40,
    noise: float = 4.0,
    exposure_s: float | None = None,
    crf: int | None = None,
) -> Result:
    """Detect the ball in rendered frames of three cameras of each scene; crf: consecutive ones, through H.264."""
    rows: list[tuple[float, ...]] = []
    total = missed = false = 0
    for seed in seeds:
        scene = scenes.get_marker_scene(name, seed)
        if exposure_s is not None:
            cameras = tuple(dataclasses.replace(camera, exposure_s=exposure_s) for camera in scene.cameras)
            scene = dataclasses.replace(scene, cameras=cameras)
        for camera in scene.cameras[:3]:
            renderer = MarkerRenderer(scene, camera.name, np.random.default_rng(seed), noise_std=noise)
            detector = MarkerDetector(intrinsics=camera.intrinsics)
            moments = np.linspace(1.0, 60.0, frames) + 0.013 * seed
            if crf is not None:
                moments = 2.0 + 0.37 * seed + np.arange(frames) / 30.0
            images: Iterator[Image] = (renderer.render(moment) for moment in moments)
            if crf is not None:
                images = _compressed(images, (camera.intrinsics.width, camera.intrinsics.height), crf)
            for moment, image in zip(moments, images, strict=True):
                began = time.process_time()
                found = detector.detect(image)
                seconds = time.process_time() - began
                pixel, size, smear, whole = _truth(scene, camera.name, moment)
                total += whole
                if not found:
                    missed += whole
                    continue
                best = found[0]
                error = np.array([best.u, best.v]) - pixel
                if not float(np.hypot(*error)) < 5.0:
                    false += 1
                elif whole and best.covariance is not None:
                    uu, uv, vv = best.covariance
                    nees = float(error @ np.linalg.solve(np.array([[uu, uv], [uv, vv]]), error)) / 2.0
                    rows.append((*error, nees, best.size / size, smear, seconds))
    table = np.array(rows)
    return Result(
        table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5], total, missed, false, 3 * frames * len(seeds)
    )


def _compressed(images: Iterator[Image], size: tuple[int, int], crf: int) -> Iterator[Image]:
    """Consecutive images after an encoder and decoder."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        write_video_frames(file, size, ((index / 30.0, one) for index, one in enumerate(images)), crf=str(crf))
        with av.open(str(file)) as container:
            for frame in container.decode(video=0):
                yield np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)


def without_ball(name: str, *, seeds: range, frames: int, noise: float = 4.0) -> tuple[int, int]:
    """(frames, detections) of scenes without the ball: all detections are false.

    Distractors and the light differ from scene to scene, the noise from frame to frame.
    """
    total = found = 0
    for seed in seeds:
        scene = scenes.get_marker_scene(name, seed)
        scene = dataclasses.replace(scene, path=dataclasses.replace(scene.path, centre=np.array([0.0, 0.0, 5000.0])))
        for camera in scene.cameras[:3]:
            renderer = MarkerRenderer(scene, camera.name, np.random.default_rng([seed, 1]), noise_std=noise)
            detector = MarkerDetector(intrinsics=camera.intrinsics)
            for _ in range(frames):
                total += 1
                found += len(detector.detect(renderer.render(0.0)))
    return total, found


def _truth(scene: MarkerScene, name: str, moment: float) -> tuple[Floats, float, float, bool]:
    camera = scene.camera(name)
    pixels, size = scene.seen_by(name, moment + camera.exposure_s * np.array([0.0, -0.5, 0.5]))
    smear = float(np.linalg.norm(pixels[2] - pixels[1]))
    reach = 0.5 * size[0] + 0.5 * smear + 2.0
    limit = np.array([camera.intrinsics.width, camera.intrinsics.height])
    with np.errstate(invalid="ignore"):
        whole = bool(((pixels[0] > reach) & (pixels[0] < limit - reach)).all())
    return pixels[0], float(size[0]), smear, whole


def _speed(width: int, height: int, frames: int) -> float:
    """Median seconds of one detection at an image size."""
    scene = scenes.get_marker_scene("marker", 0)
    renderer = renderer_for(scene, "cam0", np.random.default_rng(0))
    detector = MarkerDetector()
    taken = []
    for moment in np.linspace(1.0, 30.0, frames):
        image = np.asarray(cv2.resize(renderer.render(moment), (width, height)), dtype=np.uint8)
        began = time.process_time()
        detector.detect(image)
        taken.append(time.process_time() - began)
    return float(np.median(taken))


def _others(frames: int, seed: int) -> None:
    """Points of light and tags: rendered in textured rooms with distractors, noise 4, seeds of their own.

    The last row of each kind is of rooms without any: all detections there are false.
    """
    rng = np.random.default_rng(seed)
    rooms = [dim_room(seed + index, 640, 480, 50.0) for index in range(min(_ROOMS, frames))]
    tag = tag_image(cv2.aruco.DICT_APRILTAG_36h11, 17, 400)
    print("frames  missed  false  rms px  median px  p95 px  nees  CPU ms  case")
    lights = [
        ("light, sharp", 1.0, 700.0, 0.0),
        ("light, smeared 8 px", 1.5, 1500.0, 8.0),
        ("light, soft", 3.0, 500.0, 0.0),
        ("no light", 1.0, 0.0, 0.0),
    ]
    tags = [
        ("tag, side 24 px", 24.0, 0.0),
        ("tag, side 50 px", 50.0, 0.0),
        ("tag, side 50 px, smeared 4 px", 50.0, 4.0),
        ("no tag", 0.0, 0.0),
    ]
    cases: list[tuple[Any, ...]] = [*lights, *tags]
    for title, *what in cases:
        detector = BrightDetector() if len(what) == 3 else TagDetector()
        errors, nees, seconds, missed, false = [], [], [], 0, 0
        for index in range(frames):
            picture = np.ascontiguousarray(rooms[index % len(rooms)][:: rng.choice([-1, 1]), :: rng.choice([-1, 1])])
            picture = picture[..., rng.permutation(3)].copy()
            truth, turn = rng.uniform((90, 90), (550, 390)), rng.uniform(0.0, 2.0 * np.pi)
            smear = what[-1] * np.array([np.cos(turn), np.sin(turn)])
            add_distractors(picture, rng, (truth[0], truth[1]))
            if title.startswith("no "):
                pass
            elif len(what) == 3:
                add_spot(picture, truth[0], truth[1], what[0], what[1], (smear[0], smear[1]))
            else:
                add_tag(picture, tag, truth, what[0], rng.uniform(-0.7, 0.7, 3), smear)
                picture = cv2.GaussianBlur(picture, (0, 0), 0.6)
            image = exposed(np.asarray(picture, dtype=np.float64), 4.0, rng)
            began = time.process_time()
            found = detector.detect(image)
            seconds.append(time.process_time() - began)
            if title.startswith("no "):
                false += bool(found)
                continue
            if not found:
                missed += 1
                continue
            error = np.array([found[0].u, found[0].v]) - truth
            if not float(np.hypot(*error)) < 5.0:
                false += 1
                continue
            assert found[0].covariance is not None
            uu, uv, vv = found[0].covariance
            errors.append(error)
            nees.append(float(error @ np.linalg.solve(np.array([[uu, uv], [uv, vv]]), error)) / 2.0)
        if not errors:
            print(f"{frames:6d}  {'–':>6}  {false:5d}{'':36}{1e3 * np.median(seconds):6.1f}  {title}")
            continue
        table = np.array(errors)
        r = np.hypot(*table.T)
        print(
            f"{frames:6d}  {missed:6d}  {false:5d}  {np.sqrt(np.mean(table**2)):6.3f}  {np.median(r):9.3f}  "
            f"{np.percentile(r, 95):6.3f}  {np.mean(nees):4.2f}  {1e3 * np.median(seconds):6.1f}  {title}"
        )


def _render_speed(frames: int) -> float:
    scene = scenes.get_marker_scene("marker", 0)
    renderer = renderer_for(scene, "cam0", np.random.default_rng(0))
    taken = []
    for moment in np.linspace(1.0, 30.0, frames):
        began = time.perf_counter()
        renderer.render(moment)
        taken.append(time.perf_counter() - began)
    return float(np.median(taken))


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--quick", action="store_true", help="a quarter of the frames")
    arguments.add_argument("--only", choices=("ball", "others"), help="the coloured ball; lights and tags")
    arguments.add_argument("--frames", type=int, default=100, help="of each camera of a scene")
    arguments.add_argument("--seeds", type=int, default=4, help="scenes")
    arguments.add_argument("--first-seed", type=int, default=0)
    options = arguments.parse_args()
    cv2.setNumThreads(1)
    frames = max(options.frames // (4 if options.quick else 1), 2)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    if options.only != "ball":
        _others(3 * frames * options.seeds, 5000 + options.first_seed)
    if options.only == "others":
        return
    cases = [
        ("room, noise 4", {"name": "marker"}),
        ("room, noise 2", {"name": "marker", "noise": 2.0}),
        ("room, 20 ms exposure", {"name": "marker", "exposure_s": 0.020}),
        ("room, film at crf 20", {"name": "marker", "crf": 20}),
        ("room, film at crf 24", {"name": "marker", "crf": 24}),
        ("field 1920x1080", {"name": "marker-outdoor"}),
        ("field, film at crf 20", {"name": "marker-outdoor", "crf": 20}),
    ]
    print("frames  missed  false of frames  rms px  median px  p95 px  max px  nees  size ratio      CPU ms  case")
    for title, case in cases:
        result = measure(frames=frames, seeds=seeds, **case)  # type: ignore[arg-type]
        r = np.hypot(*result.error.T)
        print(
            f"{result.frames:6d}  {result.missed:6d}  {result.false:5d} of {result.looked_at:6d}  {result.rms:6.3f}  "
            f"{np.median(r):9.3f}  {np.percentile(r, 95):6.3f}  {r.max():6.3f}  {result.nees.mean():4.2f}  "
            f"{result.size_ratio.mean():.3f} ± {result.size_ratio.std():.3f}  "
            f"{1e3 * np.median(result.seconds):6.1f}  {title}",
            flush=True,
        )
    for name in scenes.MARKER_SCENES:
        total, found = without_ball(name, seeds=seeds, frames=frames)
        print(f"{total:6d}  {'–':>6}  {found:5d} of {total:6d}  {name} without the ball", flush=True)
    for width, height in ((640, 480), (1280, 720), (1920, 1080)):
        seconds = _speed(width, height, frames)
        print(f"detect {width}x{height}: {1e3 * seconds:.1f} ms of CPU a frame, {1.0 / seconds:.0f} fps on one core")
    seconds = _render_speed(frames)
    print(f"render 640x480: {1e3 * seconds:.1f} ms a frame, {1.0 / seconds:.0f} fps on one core")


if __name__ == "__main__":
    main()
