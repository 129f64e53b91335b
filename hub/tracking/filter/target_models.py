"""What a target of each kind is like: how it moves, how large it is, where on it a camera's points lie."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Body:
    """A kind of target.

    upright: whether it stands along the world's up, so that head and foot tell its height. size_m: how large one
    is [m], a person's height, and log_size_std its spread. speed_m_s: std of one component of the velocity.
    restlessness: density of the white acceleration [m²/s³]; of an upright kind for one of size ``size_m``. The rest is
    in shares of the size. point_above: the representative point above the centre. point_noise, head_noise, foot_noise:
    std of these points' places on the body, one axis. jump_m_s: std of one component of a change of the velocity at
    once [m/s], and jumps_per_s, how often that happens; 0 = never.
    """

    kind: str
    upright: bool
    size_m: float
    log_size_std: float
    speed_m_s: float
    restlessness: float
    point_above: float = 0.0
    point_noise: float = 0.0
    head_noise: float = 0.0
    foot_noise: float = 0.0
    jump_m_s: float = 0.0
    jumps_per_s: float = 0.0


PERSON = Body("person", True, 1.70, 0.07, 1.0, 0.8, 0.12, 0.045, 0.02, 0.045)
VEHICLE = Body("vehicle", False, 1.8, 0.5, 6.0, 3.0, 0.0, 0.05)
MARKER = Body("marker", False, 0.1, 1.5, 1.5, 2.0, jump_m_s=4.0, jumps_per_s=0.3)
BODIES = (PERSON, VEHICLE, MARKER)
INDEX = {body.kind: index for index, body in enumerate(BODIES)}
