"""The MAVLink dialect. The environment is set before pymavlink is loaded, which would otherwise use MAVLink 1."""

from __future__ import annotations

import math
import os
from typing import Any

from protocols.core.errors import InputError

os.environ["MAVLINK20"] = "1"
os.environ.setdefault("MAVLINK_DIALECT", "common")

try:
    from pymavlink.dialects.v20 import common as _common
except ImportError:
    raise InputError(
        "MAVLink needs the package pymavlink", remedy='install the extra: pip install "syncline[uav]"'
    ) from None

mavlink: Any = _common
"""pymavlink's module of the common dialect: one class per message, one constant per enumeration entry."""

AUTOPILOT = 1
"""Component id of an autopilot."""
CAMERA = 100
"""Component id of the first camera."""
GIMBAL = 154
"""Component id of the first gimbal."""
STATION = 190
"""Component id of a ground station's mission planner."""


def message_name(number: float) -> str:
    """The name of a message id, which commands carry as a float; "" for one that the dialect lacks."""
    kind = mavlink.mavlink_map.get(int(number)) if math.isfinite(number) and number == int(number) else None
    return "" if kind is None else str(kind.msgname)


def camera_heartbeat() -> Any:
    """The heartbeat of a camera component."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )
