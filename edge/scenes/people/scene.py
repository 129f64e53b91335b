"""``people``: people walking in a furnished room, seen by cameras with clocks of their own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.scenes.common.base import CameraPlacement, SimulatedScene, SimulatedTrack, place_cameras
from edge.scenes.people.walking import CROWN, JOINTS, WalkingPaths, body_joints, random_walks
from protocols.geometry.types import Bools, Floats

HIDDEN_PX = 3.0
"""A head top or foot point at least this far inside a nearer body's box is occluded."""
MAX_PEOPLE = 12  # in the room
ROOM = (5.0, 3.0)
"""Half the side and the height [m] of the room."""
_WALKED = 2.7  # half the side of the area where people walk [m]
_CAMERAS = CameraPlacement(
    distance=(4.1, 4.8),
    height=(2.0, 2.75),
    aim=0.2,
    focal=(0.55, 0.75),
    size=(640, 480),
    exposure_s=0.008,
    fps=(10.0,),
    roll=0.06,
)
_STREAMS = {"cameras": 0, "people": 1}  # the background has stream 2
RADII = {"head": 0.062, "neck": 0.032, "torso": 0.085, "pelvis": 0.075, "arm": 0.028, "thigh": 0.05, "shank": 0.036}
"""Radii of the parts of a body, over its height."""
_SKIN = ((150, 178, 224), (120, 150, 205), (84, 112, 165), (60, 82, 128))  # BGR
_HAIR = ((30, 36, 48), (48, 72, 105), (92, 140, 178), (122, 124, 128))  # BGR
_TOPS = (
    (52, 44, 190), (165, 92, 40), (70, 140, 60), (215, 216, 220), (48, 46, 50), (40, 170, 215), (150, 70, 130),
    (120, 118, 112), (165, 150, 60), (80, 110, 200), (110, 60, 40), (60, 90, 100),
)  # fmt: skip
_TROUSERS = ((92, 60, 44), (42, 42, 46), (118, 138, 150), (70, 84, 96), (140, 100, 70), (60, 62, 90))  # BGR
_SHOES = ((40, 42, 48), (205, 206, 210), (50, 70, 110))  # BGR


@dataclass(frozen=True, slots=True)
class Person:
    """One person. height: [m]. Colours in full light, BGR 0..255. pattern: of the top: plain, stripes or checks."""

    name: str
    height: float
    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    top: tuple[float, float, float]
    trousers: tuple[float, float, float]
    shoes: tuple[float, float, float]
    pattern: str


@dataclass(frozen=True, slots=True, eq=False)
class PeopleScene(SimulatedScene):
    """People who walk in a room and avoid each other.

    people: (n) appearance. paths: where they walk.
    """

    people: tuple[Person, ...]
    paths: WalkingPaths
    room: tuple[float, float]

    @property
    def heights(self) -> Floats:
        """Heights (n,) [m]."""
        return np.array([person.height for person in self.people])

    def joints(self, true_time: Floats) -> Floats:
        """All joints (t, n, 19, 3) [m], see ``walking.JOINTS``, at true times (t,) [s]."""
        return body_joints(*self.paths.at(true_time), self.heights)

    def heads(self, true_time: Floats) -> Floats:
        """Tops of the heads (t, n, 3) [m]; they move up and down with the gait."""
        return self.joints(true_time)[:, :, CROWN]

    def feet(self, true_time: Floats) -> Floats:
        """Foot points (t, n, 3) [m] on the floor below the bodies."""
        place, _, _ = self.paths.at(true_time)
        return np.concatenate([place, np.zeros((*place.shape[:2], 1))], axis=-1)

    def centres(self, true_time: Floats) -> Floats:
        """Midpoints (t, n, 3) [m] of head and foot."""
        return 0.5 * (self.heads(true_time) + self.feet(true_time))

    def seen_by(self, camera: str, points: Floats) -> Floats:
        """Distorted pixels (..., 2) of points (..., 3) [m]; NaN where they are behind the camera."""
        simulated = self.camera(camera)
        flat = simulated.pose.camera_from_world(points.reshape(-1, 3))
        flat = np.where(flat[:, 2:] > 0.2, flat, np.nan)
        with np.errstate(invalid="ignore"):
            flat = np.where(np.hypot(flat[:, 0], flat[:, 1])[:, None] < 1.5 * flat[:, 2:], flat, np.nan)
        return simulated.intrinsics.project(flat).reshape(*points.shape[:-1], 2)

    def boxes(self, camera: str, true_time: float) -> Floats:
        """Bounding boxes (n, 4) x, y, w, h [px] of the bodies in a camera's image, without occlusion.

        Clipped to the image; NaN where a body is outside the image.
        """
        simulated = self.camera(camera)
        joints = self.joints(np.array([true_time]))[0]
        pixels = self.seen_by(camera, joints)
        depth = simulated.pose.camera_from_world(joints.reshape(-1, 3))[:, 2].reshape(joints.shape[:2])
        reach = joint_radii(self.heights) * simulated.intrinsics.focal / np.maximum(depth, 0.2)
        reach[:, CROWN] = 0.0
        lens = simulated.intrinsics
        limit = np.array([lens.width, lens.height]) - 0.5
        low = np.clip((pixels - reach[..., None]).min(axis=1), -0.5, limit)
        high = np.clip((pixels + reach[..., None]).max(axis=1), -0.5, limit)
        boxes = np.concatenate([low, high - low], axis=1)
        return np.where((boxes[:, 2:] > 0.0).all(axis=1, keepdims=True), boxes, np.nan)


def joint_radii(heights: Floats) -> Floats:
    """Radii of the body around its joints (n, 19) [m]."""
    share = {"crown": 0.0, "head": RADII["head"], "neck": RADII["neck"], "chest": RADII["torso"]}
    share |= {"pelvis": RADII["pelvis"], "shoulder": 0.045, "elbow": RADII["arm"], "hand": RADII["arm"]}
    share |= {"hip": RADII["thigh"], "knee": RADII["shank"], "ankle": 0.03, "toe": 0.02}
    return np.asarray(heights[:, None] * np.array([share[name.partition("_")[0]] for name in JOINTS]))


def people_room(seed: int, cameras: int, people: int) -> PeopleScene:
    """The scene ``people`` of a seed; see ``edge.scenes.get_people_scene``."""
    rng = np.random.default_rng([seed, _STREAMS["people"]])
    centre = np.array([0.0, 0.0, 0.9])
    placed_cameras = place_cameras(np.random.default_rng([seed, _STREAMS["cameras"]]), centre, cameras, _CAMERAS)
    tops = rng.permutation(len(_TOPS))
    persons = tuple(
        Person(
            name=f"person{index}",
            height=float(np.clip(rng.normal(1.72, 0.09), 1.5, 1.95)),
            skin=_SKIN[int(rng.integers(len(_SKIN)))],
            hair=_HAIR[int(rng.integers(len(_HAIR)))],
            top=_TOPS[int(tops[index])],
            trousers=_TROUSERS[int(rng.integers(len(_TROUSERS)))],
            shoes=_SHOES[int(rng.integers(len(_SHOES)))],
            pattern=("plain", "plain", "stripes", "checks")[int(rng.integers(4))],
        )
        for index in range(people)
    )
    return PeopleScene("people", seed, placed_cameras, persons, random_walks(rng, people, _WALKED), ROOM)


def simulate_people_tracks(
    scene: PeopleScene, duration_s: float, seed: int, *, pixel_noise: float, drop_fraction: float | None = None
) -> dict[str, SimulatedTrack]:
    """Simulate detections by camera, labelled person0-head, person0-foot, …; size: [px] from head to foot.

    pixel_noise: std of each coordinate [px]. For the others see ``SimulatedScene.exposures``.
    """
    tracks = {}
    names = [(f"{one.name}-head", f"{one.name}-foot") for one in scene.people]
    for camera, rng, true_time, kept in scene.exposures(duration_s, seed, drop_fraction):
        seconds = camera.clock.stamps(true_time, rng)
        pixels, visible = visible_points(scene, camera.name, true_time)
        visible &= kept[:, None, None]
        size = np.linalg.norm(pixels[:, :, 0] - pixels[:, :, 1], axis=-1)
        noisy = pixels + rng.normal(0.0, pixel_noise, pixels.shape)
        frame, person, end = np.nonzero(visible)
        tracks[camera.name] = SimulatedTrack(
            camera=camera.name,
            frame=frame.astype(np.int64),
            time=seconds[frame],
            pixels=noisy[frame, person, end],
            size=size[frame, person],
            label=tuple(names[who][which_end] for who, which_end in zip(person, end, strict=True)),
            true_time=true_time[frame],
            is_outlier=np.zeros(len(frame), dtype=np.bool_),
        )
    return tracks


def visible_points(scene: PeopleScene, camera: str, true_time: Floats) -> tuple[Floats, Bools]:
    """Pixels (t, n, 2, 2) of head tops and foot points, and whether each is visible (t, n, 2).

    Points outside the image or behind a nearer person are not visible.
    """
    simulated = scene.camera(camera)
    lens = simulated.intrinsics
    points = np.stack([scene.heads(true_time), scene.feet(true_time)], axis=2)
    pixels = scene.seen_by(camera, points)
    depth = simulated.pose.camera_from_world(points.reshape(-1, 3))[:, 2].reshape(points.shape[:3])
    limit = np.array([lens.width, lens.height]) - 0.5
    with np.errstate(invalid="ignore"):
        visible = np.asarray(((pixels > -0.5) & (pixels < limit)).all(axis=-1), dtype=np.bool_)
        for index, moment in enumerate(true_time):
            boxes = scene.boxes(camera, float(moment))
            low, high = boxes[:, :2] + HIDDEN_PX, boxes[:, :2] + boxes[:, 2:] - HIDDEN_PX
            inside = ((pixels[index][:, :, None] > low) & (pixels[index][:, :, None] < high)).all(axis=-1)
            nearer = depth[index].mean(axis=-1)[None, None] < depth[index].mean(axis=-1)[:, None, None]
            visible[index] &= ~(inside & nearer).any(axis=-1)
    return pixels, visible
