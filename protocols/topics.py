"""The catalogue of bus topics: key expression, message type, rate, recording, queue length, staleness limit.

Publishing, subscribing, liveness, logging and replay all derive from this table, so that a topic is
added in one place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from protocols.core.names import check_identifier, key_segment

OUTAGE_S = 60.0
"""The longest link outage without message loss, unless configured otherwise."""
_MARGIN = 1.5  # rates vary, and an outage is noticed late


class Delivery(Enum):
    """Delivery guarantee of a topic when the link or the receiver is slow or disconnected."""

    RELIABLE = "reliable"
    """Cached by the publisher, recovered by the subscriber after an outage, in order."""
    LATEST = "latest"
    """Only the newest message matters: late joiners receive the last one, a slow reader skips messages."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic and its settings.

    key: key expression below ``syncline/<site>/``, with ``{id}`` for the key segment of the agent that publishes it
        (``protocols.core.names.key_segment``).
    message: name of the protobuf message in ``syncline.v1``.
    rate_hz: nominal messages a second from one publisher (0 = on change).
    recorded: whether the recorder writes it.
    queue: messages that a subscriber holds before the oldest is dropped (and counted); 64 MiB is the other bound.
    stale_after_s: silence after which a publisher that is alive counts as stale; 0 = never.
    bulky: large images, which are sent at a lower priority than everything else.
    """

    name: str
    key: str
    message: str
    rate_hz: float
    recorded: bool
    delivery: Delivery
    queue: int
    stale_after_s: float
    bulky: bool = False

    def key_for(self, site: str, agent: str) -> str:
        """The concrete key of one publisher, named ``agent``."""
        return f"syncline/{check_identifier(site, 'site')}/{self.key.format(id=key_segment(agent))}"

    def key_expression(self, site: str) -> str:
        """Matches every publisher of this topic on a site."""
        return f"syncline/{check_identifier(site, 'site')}/{self.key.format(id='*')}"


OBSERVATION = Topic("observation", "camera/{id}/observation", "Observation", 30.0, True, Delivery.RELIABLE, 65_536, 2.0)
CAMERA_INFO = Topic("camera_info", "camera/{id}/info", "CameraInfo", 0.5, True, Delivery.LATEST, 2048, 10.0)
RIG_INFO = Topic("rig_info", "hub/{id}/rig", "RigInfo", 0.1, True, Delivery.LATEST, 16, 60.0)
CALIBRATION = Topic("calibration", "hub/{id}/calibration", "Calibration", 0.5, True, Delivery.LATEST, 64, 0.0)
TRACK = Topic("track", "hub/{id}/track", "Track", 30.0, True, Delivery.RELIABLE, 4096, 0.0)
TRACK_SMOOTHED = Topic("track_smoothed", "hub/{id}/track_smoothed", "Track", 30.0, True, Delivery.RELIABLE, 4096, 0.0)
SOLVER_EVENT = Topic("solver_event", "hub/{id}/solver", "SolverEvent", 1.0, True, Delivery.RELIABLE, 256, 0.0)
PART = Topic("part", "hub/{id}/part", "Calibration", 0.5, False, Delivery.LATEST, 64, 0.0)
SHARD = Topic("shard", "hub/{id}/shard", "Shard", 1.0, False, Delivery.LATEST, 64, 5.0)
STATUS = Topic("status", "agent/{id}/status", "AgentStatus", 1.0, True, Delivery.LATEST, 1024, 5.0)
NODE_STATE = Topic("node_state", "node/{id}/state", "NodeState", 10.0, True, Delivery.LATEST, 4096, 2.0)
COMMAND = Topic("command", "view/{id}/command", "Command", 0.1, False, Delivery.RELIABLE, 64, 0.0)
PREDICTION = Topic("prediction", "hub/{id}/prediction", "Prediction", 20.0, True, Delivery.LATEST, 16, 0.0)
PICTURE = Topic("picture", "camera/{id}/picture", "Picture", 4.0, True, Delivery.LATEST, 512, 5.0, bulky=True)
FLIGHT_IMAGE = Topic("flight_image", "uav/{id}/image", "FlightImage", 30.0, True, Delivery.LATEST, 512, 2.0, bulky=True)
TELEMETRY = Topic("telemetry", "uav/{id}/telemetry", "VehicleTelemetry", 50.0, True, Delivery.RELIABLE, 8192, 2.0)
TARGET_COMMAND = Topic("target_command", "uav/{id}/command", "TargetCommand", 0.1, True, Delivery.RELIABLE, 64, 0.0)
TARGET = Topic("target", "uav/{id}/target", "TargetState", 30.0, True, Delivery.RELIABLE, 4096, 0.0)
TARGET_CLOUD = Topic("target_cloud", "uav/{id}/cloud", "TargetCloud", 5.0, True, Delivery.LATEST, 16, 0.0)
UAV_INFO = Topic("uav_info", "uav/{id}/info", "UavInfo", 0.5, True, Delivery.LATEST, 16, 10.0)
ROAD_MAP = Topic("road_map", "uav/{id}/road", "RoadMap", 2.0, True, Delivery.LATEST, 16, 0.0)

TOPICS: tuple[Topic, ...] = (
    OBSERVATION, CAMERA_INFO, RIG_INFO, CALIBRATION, TRACK, TRACK_SMOOTHED, SOLVER_EVENT, STATUS, NODE_STATE, COMMAND,
    PICTURE, PREDICTION, FLIGHT_IMAGE, TELEMETRY, TARGET_COMMAND, TARGET, TARGET_CLOUD, ROAD_MAP, UAV_INFO, PART,
    SHARD,
)  # fmt: skip
TOPICS_BY_NAME: dict[str, Topic] = {topic.name: topic for topic in TOPICS}


def liveliness_key(site: str, role: str, agent: str, boot_id: str) -> str:
    """Key of an agent's liveliness token.

    The boot id is part of it, so that two agents with one id are seen as two instead of
    interleaving undetected.
    """
    return (
        f"syncline/{check_identifier(site, 'site')}/alive/{check_identifier(role, 'role')}/{key_segment(agent)}/"
        f"{check_identifier(boot_id, 'boot id')}"
    )


def cache_size(topic: Topic, rate_hz: float | None = None, outage_s: float = OUTAGE_S) -> int:
    """Messages that a publisher of ``topic`` caches: the last one, or those of an outage plus a margin."""
    if topic.delivery is Delivery.LATEST:
        return 1
    return max(1, math.ceil(max(topic.rate_hz, rate_hz or 0.0) * outage_s * _MARGIN))
