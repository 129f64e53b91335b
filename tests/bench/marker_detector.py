"""How well and how fast the shipped marker detector works on rendered frames, whose truth is known.

    python -m tests.bench.marker_detector [--quick] [--only ball|others]

Errors are against the projection of the ball's centre at mid-exposure. ``nees`` is the squared error divided by the
reported covariance, 1 if the covariance is right. Look-alikes (balls and boxes of other hues, wood) are in every frame.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import cv2
import numpy as np

from edge import scenes
from edge.detectors.bright import BrightDetector
from edge.detectors.marker import MarkerDetector
from edge.detectors.tag import TagDetector
from edge.scenes.marker import MarkerScene
from edge.scenes.rendering import MarkerRenderer
from protocols.geometry.types import Floats
from tests.rendered_markers import add_look_alikes, add_spot, add_tag, dim_room, exposed, tag_image


@dataclasses.dataclass(frozen=True)
class Result:
    """Over frames in which the ball lies whole in the image. error: (n, 2) [px]. nees, size_ratio, smear [px],
    seconds: (n,). missed: frames without a detection. false: detections more than 5 px away, of all frames."""

    error: Floats
    nees: Floats
    size_ratio: Floats
    smear: Floats
    seconds: Floats
    frames: int
    missed: int
    false: int

    @property
    def rms(self) -> float:
        """Of one coordinate [px], look-alikes touching the ball and all."""
        return float(np.sqrt(np.mean(self.error**2)))


def measure(
    name: str = "marker",
    *,
    seeds: range = range(4),
    frames: int = 40,
    noise: float = 4.0,
    exposure_s: float | None = None,
) -> Result:
    """Detect the ball in rendered frames of three cameras of each world."""
    rows: list[tuple[float, ...]] = []
    total = missed = false = 0
    for seed in seeds:
        scene = scenes.get(name, seed)
        if exposure_s is not None:
            cameras = tuple(dataclasses.replace(camera, exposure_s=exposure_s) for camera in scene.cameras)
            scene = dataclasses.replace(scene, cameras=cameras)
        for camera in scene.cameras[:3]:
            renderer = MarkerRenderer(scene, camera.name, np.random.default_rng(seed), noise_std=noise)
            detector = MarkerDetector(intrinsics=camera.intrinsics)
            for moment in np.linspace(1.0, 60.0, frames) + 0.013 * seed:
                image = renderer.render(moment)
                began = time.perf_counter()
                found = detector.detect(image)
                seconds = time.perf_counter() - began
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
    return Result(table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5], total, missed, false)


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
    scene = scenes.get("marker", 0)
    renderer = scene.renderer("cam0", np.random.default_rng(0))
    detector = MarkerDetector()
    taken = []
    for moment in np.linspace(1.0, 30.0, frames):
        image = np.asarray(cv2.resize(renderer.render(moment), (width, height)), dtype=np.uint8)
        began = time.perf_counter()
        detector.detect(image)
        taken.append(time.perf_counter() - began)
    return float(np.median(taken))


def _others(frames: int, seed: int) -> None:
    """Points of light and tags: drawn into textured rooms with look-alikes, noise 4, seeds of their own."""
    rng = np.random.default_rng(seed)
    tag = tag_image(cv2.aruco.DICT_APRILTAG_36h11, 17, 400)
    print("frames  missed  false  rms px  median px  p95 px  nees  CPU ms  case")
    lights = [
        ("light, sharp", 1.0, 700.0, 0.0),
        ("light, smeared 8 px", 1.5, 1500.0, 8.0),
        ("light, soft", 3.0, 500.0, 0.0),
    ]
    tags = [
        ("tag, side 24 px", 24.0, 0.0),
        ("tag, side 50 px", 50.0, 0.0),
        ("tag, side 50 px, smeared 4 px", 50.0, 4.0),
    ]
    for title, *what in [*lights, *tags]:
        detector = BrightDetector() if len(what) == 3 else TagDetector()
        errors, nees, seconds, missed, false = [], [], [], 0, 0
        for index in range(frames):
            picture = dim_room(seed + index, 640, 480, 50.0)
            truth, turn = rng.uniform((90, 90), (550, 390)), rng.uniform(0.0, 2.0 * np.pi)
            smear = what[-1] * np.array([np.cos(turn), np.sin(turn)])
            add_look_alikes(picture, rng, (truth[0], truth[1]))
            if len(what) == 3:
                add_spot(picture, truth[0], truth[1], what[0], what[1], (smear[0], smear[1]))
            else:
                add_tag(picture, tag, truth, what[0], rng.uniform(-0.7, 0.7, 3), smear)
                picture = cv2.GaussianBlur(picture, (0, 0), 0.6)
            image = exposed(np.asarray(picture, dtype=np.float64), 4.0, rng)
            began = time.process_time()
            found = detector.detect(image)
            seconds.append(time.process_time() - began)
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
        table = np.array(errors)
        r = np.hypot(*table.T)
        print(
            f"{frames:6d}  {missed:6d}  {false:5d}  {np.sqrt(np.mean(table**2)):6.3f}  {np.median(r):9.3f}  "
            f"{np.percentile(r, 95):6.3f}  {np.mean(nees):4.2f}  {1e3 * np.median(seconds):6.1f}  {title}"
        )


def _render_speed(frames: int) -> float:
    scene = scenes.get("marker", 0)
    renderer = scene.renderer("cam0", np.random.default_rng(0))
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
    options = arguments.parse_args()
    quick = options.quick
    cv2.setNumThreads(1)
    frames = 15 if quick else 60
    if options.only != "ball":
        _others(30 if quick else 100, 5000)
    if options.only == "others":
        return
    cases = [
        ("room, noise 4", {"name": "marker"}),
        ("room, noise 2", {"name": "marker", "noise": 2.0}),
        ("room, 20 ms exposure", {"name": "marker", "exposure_s": 0.020}),
        ("field 1920x1080", {"name": "marker-outdoor", "seeds": range(1 if quick else 2)}),
    ]
    print("frames  missed  false  rms px  median px  p95 px  max px  nees  size ratio      case")
    for title, options in cases:
        result = measure(frames=frames, **options)  # type: ignore[arg-type]
        r = np.hypot(*result.error.T)
        print(
            f"{result.frames:6d}  {result.missed:6d}  {result.false:5d}  {result.rms:6.3f}  {np.median(r):9.3f}  "
            f"{np.percentile(r, 95):6.3f}  {r.max():6.3f}  {result.nees.mean():4.2f}  "
            f"{result.size_ratio.mean():.3f} ± {result.size_ratio.std():.3f}  {title}"
        )
    for width, height in ((640, 480), (1280, 720), (1920, 1080)):
        seconds = _speed(width, height, frames)
        print(f"detect {width}x{height}: {1e3 * seconds:.1f} ms a frame, {1.0 / seconds:.0f} fps on one core")
    seconds = _render_speed(frames)
    print(f"render 640x480: {1e3 * seconds:.1f} ms a frame, {1.0 / seconds:.0f} fps on one core")


if __name__ == "__main__":
    main()
