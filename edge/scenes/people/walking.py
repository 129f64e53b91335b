"""Walking people: random paths that avoid each other, and the joints of a walking body.

World axes: z up, metres, the floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocols.geometry.types import Floats

JOINTS = (
    "crown", "head", "neck", "chest", "pelvis",
    "shoulder_l", "elbow_l", "hand_l", "shoulder_r", "elbow_r", "hand_r",
    "hip_l", "knee_l", "ankle_l", "toe_l", "hip_r", "knee_r", "ankle_r", "toe_r",
)  # fmt: skip
CROWN = JOINTS.index("crown")
_STEP_S, _LENGTH_S = 0.2, 240.0  # of the stored path
_TURN_S = 1.2  # duration of the turn at an end of the path
_STRIDE = 0.82  # length of two steps over the body's height


@dataclass(frozen=True, slots=True, eq=False)
class WalkingPaths:
    """Paths of n people at any time: walked to an end, then back, and so on without end.

    points: (m, n, 2) [m] on the floor every 0.2 s. travelled: (m, n) [m] path length until then. heading: (m, n) [rad]
    unwrapped.
    """

    points: Floats
    travelled: Floats
    heading: Floats

    @property
    def length_s(self) -> float:
        """Time [s] from one end to the other."""
        return float((len(self.points) - 4) * _STEP_S)

    def at(self, true_time: Floats) -> tuple[Floats, Floats, Floats]:
        """Places (t, n, 2) [m], path lengths (t, n) [m] and headings (t, n) [rad] at true times (t,) [s]."""
        there, back = _back_and_forth(np.asarray(true_time, dtype=np.float64), self.length_s)
        place = _spline(self.points, there)
        heading = _spline(self.heading[..., None], there)[..., 0] + np.pi * back[:, None]
        return place, _spline(self.travelled[..., None], there)[..., 0], heading


def _back_and_forth(time: Floats, length: float) -> tuple[Floats, Floats]:
    """Time along the path, slower at its ends, and the fraction (0..1) of the turn to go back."""
    turned, within = np.divmod(time, length)
    # Constant rate, except for the first and last 2 s, where it falls to zero and rises again.
    ease = 2.0
    rate = length / (length - ease)
    begin, end = np.clip(within, 0.0, ease), np.clip(length - within, 0.0, ease)
    lost = (ease - begin) ** 2 / (2 * ease) - (ease - end) ** 2 / (2 * ease)
    along = np.clip((within - ease / 2 + lost) * rate, 0.0, length)
    odd = np.mod(turned, 2.0) == 1.0
    nearest = np.where(within < 0.5 * length, within, within - length)  # to the turn before or after
    turn = np.clip(0.5 + nearest / _TURN_S, 0.0, 1.0)
    smooth = turn * turn * (3.0 - 2.0 * turn)
    starts = within < 0.5 * length
    to_back = np.where(odd == starts, smooth, 1.0 - smooth)
    return np.where(odd, length - along, along), to_back


def _spline(values: Floats, time: Floats) -> Floats:
    """A uniform cubic B-spline over values (m, n, k), at times (t,) [s]: (t, n, k)."""
    place = np.clip(time / _STEP_S, 0.0, len(values) - 4 - 1e-9)
    first = place.astype(np.int64)
    u = (place - first)[:, None, None]
    weights = (
        (1 - u) ** 3 / 6.0,
        (3 * u**3 - 6 * u**2 + 4) / 6.0,
        (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6.0,
        u**3 / 6.0,
    )
    return np.asarray(sum(weight * values[first + k] for k, weight in enumerate(weights)))


def random_walks(rng: np.random.Generator, people: int, half: float) -> WalkingPaths:
    """Paths of people who walk between random goals within ±half [m], at 0.9 to 1.4 m/s, by a social-force model."""
    step = 0.05
    speed = rng.uniform(0.9, 1.4, people)
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(people) / people
    place = 0.6 * half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    goal = rng.uniform(-half, half, (people, 2))
    velocity = np.zeros((people, 2))
    rest = np.zeros(people)
    kept = []
    every = round(_STEP_S / step)
    for index in range(round(_LENGTH_S / step) + 4 * every):
        if index % every == 0:
            kept.append(place.copy())
        towards = goal - place
        distance = np.linalg.norm(towards, axis=1)
        for one in np.flatnonzero(distance < 0.4):
            goal[one] = rng.uniform(-half, half, 2)
            rest[one] = rng.uniform(1.0, 3.0) if rng.random() < 0.15 else 0.0
        rest = np.maximum(rest - step, 0.0)
        wish = np.where(rest > 0, 0.0, speed)[:, None] * towards / np.maximum(distance, 1e-9)[:, None]
        apart = place[:, None] - place[None]
        gap = np.linalg.norm(apart, axis=-1) + 10.0 * np.eye(people)
        push = 3.0 * np.exp(-(gap - 0.45) / 0.22)
        away = apart / gap[..., None]
        aside = np.stack([-away[..., 1], away[..., 0]], axis=-1)  # everybody keeps to one side
        force = (push[..., None] * (away + 0.5 * aside)).sum(axis=1)
        velocity += step * ((wish - velocity) / 0.4 + force)
        fast = np.maximum(np.linalg.norm(velocity, axis=1) / 1.5, 1.0)
        velocity /= fast[:, None]
        place = np.clip(place + step * velocity, -half, half)
    points = np.array(kept)
    steps = np.diff(points, axis=0, append=points[-1:])
    travelled = np.concatenate([np.zeros((1, people)), np.cumsum(np.linalg.norm(steps, axis=-1), axis=0)[:-1]])
    return WalkingPaths(points, travelled, _headings(steps))


def _headings(steps: Floats) -> Floats:
    """Headings (m, n): the direction of motion, kept while they stand, smoothed over about a second."""
    kernel = np.exp(-0.5 * (np.arange(-8, 9) * _STEP_S / 0.45) ** 2)
    smooth = np.stack(
        [
            np.stack([np.convolve(steps[:, n, k], kernel, mode="same") for k in range(2)], -1)
            for n in range(steps.shape[1])
        ],
        axis=1,
    )
    angle = np.arctan2(smooth[..., 1], smooth[..., 0])
    return np.unwrap(angle, axis=0)


def body_joints(place: Floats, travelled: Floats, heading: Floats, height: Floats) -> Floats:
    """Joints (t, n, 19, 3) [m] of walking people, in the order of JOINTS.

    place: (t, n, 2). travelled: (t, n) [m] path length, which sets the phase of the legs. heading: (t, n) [rad].
    height: (n,) [m].
    """
    phase = 2.0 * np.pi * travelled / (_STRIDE * height)
    thigh, shank = 0.245 * height, 0.235 * height
    swing = 0.42
    legs = []
    for side in (0.0, np.pi):
        forward = swing * np.sin(phase + side)
        bend = 0.15 + 0.75 * np.clip(np.cos(phase + side), 0.0, 1.0) ** 2  # the swing leg bends
        knee = np.stack([thigh * np.sin(forward), -thigh * np.cos(forward)], -1)
        ankle = knee + np.stack([shank * np.sin(forward - bend), -shank * np.cos(forward - bend)], -1)
        legs.append((knee, ankle))
    pelvis = 0.04 * height - np.minimum(legs[0][1][..., 1], legs[1][1][..., 1])  # the lower foot is on the floor
    joints = np.zeros((*place.shape[:2], len(JOINTS), 3))  # forward, left, up

    def put(name: str, forward: Floats | float, left: Floats | float, up: Floats) -> None:
        joints[..., JOINTS.index(name), 0] = forward
        joints[..., JOINTS.index(name), 1] = left
        joints[..., JOINTS.index(name), 2] = up

    for part, share in (("pelvis", 0.0), ("chest", 0.245), ("neck", 0.325), ("head", 0.405), ("crown", 0.47)):
        put(part, 0.02 * height * (share > 0.1), 0.0, pelvis + share * height)
    for (knee, ankle), name, left in zip(legs, ("l", "r"), (1.0, -1.0), strict=True):
        put(f"hip_{name}", 0.0, left * 0.05 * height, pelvis)
        put(f"knee_{name}", knee[..., 0], left * 0.05 * height, pelvis + knee[..., 1])
        put(f"ankle_{name}", ankle[..., 0], left * 0.05 * height, pelvis + ankle[..., 1])
        put(
            f"toe_{name}", ankle[..., 0] + 0.085 * height, left * 0.055 * height, pelvis + ankle[..., 1] - 0.02 * height
        )
        arm = -0.5 * swing * left * np.sin(phase)
        put(f"shoulder_{name}", 0.0, left * 0.105 * height, pelvis + 0.29 * height)
        put(f"elbow_{name}", 0.17 * height * np.sin(arm), left * 0.12 * height, pelvis + (0.29 - 0.165) * height)
        put(
            f"hand_{name}",
            0.34 * height * np.sin(arm + 0.1),
            left * 0.12 * height,
            pelvis + 0.29 * height - 0.31 * height * np.cos(arm),
        )
    cosine, sine = np.cos(heading)[..., None], np.sin(heading)[..., None]
    world = np.empty_like(joints)
    world[..., 0] = place[..., :1] + cosine * joints[..., 0] - sine * joints[..., 1]
    world[..., 1] = place[..., 1:] + sine * joints[..., 0] + cosine * joints[..., 1]
    world[..., 2] = joints[..., 2]
    return world
