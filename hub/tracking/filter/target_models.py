"""Target models by kind: motion, size, and the position of the detected points on the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class TargetModel:
    """Motion and size model of one kind of target.

    upright: whether it stands along the world's vertical, so that head and foot give its height. size_m: typical size
    [m] (a person's height); log_size_std: std of its logarithm. speed_std_m_s: std of one velocity component.
    acceleration_psd: power spectral density of the white acceleration [m²/s³], and velocity_psd, of the white velocity
    [m²/s] (steps, sway), for an upright kind at size ``size_m``.
    In fractions of the size: point_offset, height of the representative point above the centre; point_std, head_std,
    foot_std, std of these points' positions on the target, per axis, and common_std, of what they have in common.
    manoeuvre_std_m_s: std of one component of an
    abrupt velocity change [m/s]; manoeuvres_per_s: its rate, 0 = never.
    """

    kind: str
    upright: bool
    size_m: float
    log_size_std: float
    speed_std_m_s: float
    acceleration_psd: float
    point_offset: float = 0.0
    point_std: float = 0.0
    head_std: float = 0.0
    foot_std: float = 0.0
    common_std: float = 0.0
    manoeuvre_std_m_s: float = 0.0
    manoeuvres_per_s: float = 0.0
    velocity_psd: float = 0.0


PERSON = TargetModel("person", True, 1.70, 0.07, 1.0, 0.15, 0.12, 0.035, 0.02, 0.035, 0.03, 1.0, 0.2, 0.02)
VEHICLE = TargetModel("vehicle", False, 1.8, 0.5, 6.0, 3.0, 0.0, 0.05)
MARKER = TargetModel("marker", False, 0.1, 1.5, 1.5, 2.0, manoeuvre_std_m_s=4.0, manoeuvres_per_s=0.3)
TARGET_MODELS = (PERSON, VEHICLE, MARKER)
KIND_INDEX = {model.kind: index for index, model in enumerate(TARGET_MODELS)}
UPRIGHT = np.array([model.upright for model in TARGET_MODELS])
CLUTTER_COLOUR_STD = 60.0  # of a channel of false detections and of other people
