"""Settings of guidance: the table [control] of a UAV agent's configuration."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

Degrees = Annotated[float, Meta(ge=-180.0, le=180.0)]
Metres = Annotated[float, Meta(ge=0.0, le=10_000.0)]


class GuidanceLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[control]: commands that the agent may send. All are off unless they are enabled here.

    gimbal: point the gimbal at the target (GIMBAL_MANAGER_SET_PITCHYAW). follow: send FOLLOW_TARGET once an
    operator has armed it for the target (MAV_CMD_DO_FOLLOW to the camera). The other keys are
    limits beyond which nothing is sent. pitch_deg: lowest and highest commanded pitch; rate_deg_s: largest rate of the
    commanded angles. coast_s: longest time without a detection of the target. std_m: largest position std of the
    target. range_m: largest distance from where it was selected. speed: largest speed that is sent [m/s].
    fence_m: largest distance of vehicle and target from where the vehicle took off; height_m: least and greatest
    height above there of a vehicle that follows; beyond them it has to be armed again. beacon: system id of
    FOLLOW_TARGET, not the vehicle's: ArduPilot ignores its own, and takes FOLL_SYSID's alone if that is set.
    """

    gimbal: bool = False
    follow: bool = False
    pitch_deg: tuple[Degrees, Degrees] = (-90.0, 10.0)
    rate_deg_s: Annotated[float, Meta(gt=0.0, le=180.0)] = 60.0
    coast_s: Annotated[float, Meta(gt=0.0, le=15.0)] = 8.0
    std_m: Annotated[float, Meta(gt=0.0, le=100.0)] = 15.0
    range_m: Annotated[float, Meta(gt=0.0, le=5000.0)] = 300.0
    speed: Annotated[float, Meta(gt=0.0, le=50.0)] = 20.0
    fence_m: Annotated[float, Meta(gt=0.0, le=10_000.0)] = 500.0
    height_m: tuple[Metres, Metres] = (5.0, 120.0)
    beacon: Annotated[int, Meta(ge=1, le=255)] = 200

    def __post_init__(self) -> None:
        if not self.height_m[0] < self.height_m[1]:
            raise ValueError("height_m is least, greatest; correct it")
        if not self.pitch_deg[0] < self.pitch_deg[1]:
            raise ValueError("pitch_deg is lowest, highest; correct it")
