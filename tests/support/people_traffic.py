"""Simulated detections of the scene ``people`` from geometry: misses, false detections, occlusions, noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from edge.scenes.people.scene import PeopleScene
from hub.tracking.detections import TrackingCamera
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb


@dataclass(frozen=True, slots=True)
class Faults:
    """Detection errors. noise_px: of every point. size_noise: relative. missed: probability for visible people. false:
    false detections per frame. colour_std: of a channel. hidden: occluded fraction from which on a person is not
    detected; merged: probability that two touching silhouettes are detected as one. latency_s: until a frame arrives,
    mean of an exponential, in addition to 20 ms.
    """

    noise_px: float = 1.5
    size_noise: float = 0.02
    missed: float = 0.05
    false: float = 0.05
    colour_std: float = 12.0
    hidden: float = 0.6
    merged: float = 0.5
    latency_s: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Traffic:
    """Observations in the order in which they arrive, and the truth."""

    scene: PeopleScene
    arrivals: list[tuple[float, pb.Observation]]
    infos: list[pb.CameraInfo]
    reference: str
    boots: dict[str, str] = field(default_factory=dict)

    def messages(self) -> Iterator[pb.Observation]:
        """In the order of arrival."""
        return (message for _, message in self.arrivals)

    def true_time(self, reference_s: Floats) -> Floats:
        """True times of reference times [s]."""
        clock = self.scene.camera(self.reference).clock
        return np.asarray((np.asarray(reference_s) - clock.epoch_ns / NANOSECONDS) / clock.rate)

    def true_time_ns(self, reference_ns: int) -> float:
        """The true time [s] of a reference time [ns]."""
        return self.scene.camera(self.reference).clock.true_time(reference_ns)


def cameras_of(scene: PeopleScene, reference: str, time_std: float = 1e-4) -> dict[str, TrackingCamera]:
    """The scene's cameras with a perfect calibration."""
    return {
        c.name: TrackingCamera(c.name, c.intrinsics, c.pose, scene.true_time_map(c.name, reference), time_std)
        for c in scene.cameras
    }


def film(scene: PeopleScene, seconds: float, seed: int, faults: Faults | None = None, start: float = 0.0) -> Traffic:
    """Observations of ``seconds`` of the scene."""
    faults = faults or Faults()
    arrivals = []
    infos = []
    for index, camera in enumerate(scene.cameras):
        rng = np.random.default_rng([seed, 77, index])
        count = int(seconds * camera.fps * camera.clock.rate)
        times = camera.capture_times(start + camera.start_s % 0.1, 0, count, rng)
        kept = rng.random(count) >= camera.drop_fraction
        lens = camera.intrinsics
        infos.append(
            pb.CameraInfo(
                schema_version=1,
                camera=camera.name,
                boot_id="boot0",
                width=lens.width,
                height=lens.height,
                fps=camera.fps,
                matrix=lens.matrix.ravel().tolist(),
                distortions=lens.distortions.tolist(),
            )
        )
        for sequence, moment in enumerate(times[kept].tolist()):
            stamp = camera.clock.device_time_ns(moment) + round(rng.normal(0, camera.clock.stamp_noise_s) * NANOSECONDS)
            message = pb.Observation(
                schema_version=1,
                camera=camera.name,
                boot_id="boot0",
                sequence=sequence,
                frame=sequence,
                device_time_ns=stamp,
                detections=_detections(scene, camera.name, moment, rng, faults),
            )
            arrivals.append((moment + 0.02 + float(rng.exponential(faults.latency_s)), message))
    arrivals.sort(key=lambda one: one[0])
    return Traffic(scene, arrivals, infos, scene.cameras[0].name)


def _detections(
    scene: PeopleScene, camera: str, moment: float, rng: np.random.Generator, faults: Faults
) -> list[pb.Detection]:
    simulated = scene.camera(camera)
    lens = simulated.intrinsics
    joints = scene.joints(np.array([moment]))[0]
    pixels = scene.seen_by(camera, joints)
    depth = simulated.pose.camera_from_world(joints.mean(axis=1))[:, 2]
    boxes = scene.boxes(camera, moment)
    detected: list[tuple[float, dict[str, object]]] = []
    gone: set[int] = set()
    for one in np.argsort(depth).tolist():
        if not np.isfinite(boxes[one]).all() or rng.random() < faults.missed or one in gone:
            continue
        before = [k for k in range(len(depth)) if depth[k] < depth[one] and np.isfinite(boxes[k]).all()]
        hidden = max((_covered(boxes[one], boxes[k]) for k in before), default=0.0)
        if hidden > faults.hidden:
            continue
        box = boxes[one].copy()
        for k in np.flatnonzero(depth > depth[one]).tolist():
            if np.isfinite(boxes[k]).all() and _covered(boxes[k], box) > 0.25 and rng.random() < faults.merged:
                low = np.minimum(box[:2], boxes[k][:2])
                box = np.concatenate([low, np.maximum(box[:2] + box[2:], boxes[k][:2] + boxes[k][2:]) - low])
                gone.add(k)
        head, feet = pixels[one, 0], pixels[one, [13, 14, 17, 18]]
        foot = np.array([feet[:, 0].mean(), feet[:, 1].max()])  # as the detectors have it: below the middle of the feet
        merged = not np.array_equal(box, boxes[one])
        top = np.array([box[0] + 0.5 * box[2], box[1]]) if merged else head
        point = pixels[one, 3] * 0.75 + pixels[one, 4] * 0.25  # between chest and pelvis
        if merged:
            point = point + rng.normal(0, 0.1, 2) * box[2:]
        noise = rng.normal(0, faults.noise_px, (3, 2))
        inside = [_inside(p, lens.width, lens.height) for p in (top, foot, point)]
        if not inside[2]:
            continue
        feet_hidden = any(_within(foot, boxes[k]) for k in before)
        size = float(np.linalg.norm(top - foot)) * (1.0 + rng.normal(0, faults.size_noise))
        blue, green, red = np.clip(np.array(scene.people[one].top) * 0.8 + rng.normal(0, faults.colour_std, 3), 0, 255)
        detected.append(
            (
                depth[one],
                {
                    "u": point[0] + noise[0, 0],
                    "v": point[1] + noise[0, 1],
                    "size": size if inside[0] and inside[1] and not feet_hidden else 0.0,
                    "score": 0.9,
                    "label": "person",
                    "kind": "person",
                    "head": (top + noise[1]).tolist() if inside[0] else [],
                    "foot": (foot + noise[2]).tolist() if inside[1] and not feet_hidden else [],
                    "box": box.tolist(),
                    "covariance": [faults.noise_px**2, 0.0, faults.noise_px**2],
                    "colour": pb.Colour(red=round(red), green=round(green), blue=round(blue)),
                },
            )
        )
    out = [pb.Detection(**values) for _, values in detected]  # type: ignore[arg-type]
    for _ in range(rng.poisson(faults.false)):
        u, v, tall = rng.uniform(40, lens.width - 40), rng.uniform(60, lens.height - 60), rng.uniform(40, 160)
        red, green, blue = rng.integers(0, 255, 3).tolist()
        out.append(
            pb.Detection(
                u=u, v=v, size=tall, score=0.5, label="person", kind="person",
                head=[u, v - 0.4 * tall], foot=[u, v + 0.6 * tall], colour=pb.Colour(red=red, green=green, blue=blue),
            )
        )  # fmt: skip
    return out


def _covered(box: Floats, other: Floats) -> float:
    low, high = np.maximum(box[:2], other[:2]), np.minimum(box[:2] + box[2:], other[:2] + other[2:])
    return float(np.prod(np.maximum(high - low, 0.0)) / max(float(np.prod(box[2:])), 1e-9))


def _within(point: Floats, box: Floats) -> bool:
    return bool(((point > box[:2]) & (point < box[:2] + box[2:])).all())


def _inside(point: Floats, width: int, height: int) -> bool:
    return bool(np.isfinite(point).all() and 2 < point[0] < width - 3 and 2 < point[1] < height - 3)
