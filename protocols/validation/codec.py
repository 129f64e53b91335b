"""Encoding, decoding and validation of messages: every payload from the bus or a log passes here.

``decode`` and ``admit`` return a message whose fields are all within their limits, or raise Rejected with a reason
that the caller counts. The limits are in ``protocols.validation.rules``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from google.protobuf.message import DecodeError, Message

from protocols.core.names import name_of_segment
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TOPICS, Topic
from protocols.validation.layouts import Layouts
from protocols.validation.rules import Rejected, RejectionReason, check, check_names

MAX_PAYLOAD = 1024 * 1024
"""Bytes. An observation with the most detections that are allowed is about two thirds of it."""

_SITE, _SEGMENT = r"[a-z0-9][a-z0-9_-]{0,62}", r"[A-Za-z0-9_%-]+"
_KEYS: tuple[tuple[Topic, re.Pattern[str]], ...] = tuple(
    (topic, re.compile(rf"syncline/({_SITE})/{re.escape(topic.key).replace(re.escape('{id}'), f'({_SEGMENT})')}\Z"))
    for topic in TOPICS
)
UAV_MESSAGES = (
    pb.FlightImage | pb.VehicleTelemetry | pb.TargetCommand | pb.TargetState | pb.TargetCloud | pb.RoadMap | pb.UavInfo
)
"""The messages of a UAV agent; all have its name in the field ``agent``."""
_CLASSES: Mapping[str, type[Message]] = {topic.message: getattr(pb, topic.message) for topic in TOPICS}
_LAYOUTS = Layouts()
_MAX_SENDERS = 8192
"""Keys, and senders of observations, that are remembered."""


@dataclass(frozen=True, slots=True)
class Address:
    """The content of a bus key: the site, the topic and the name of the publishing agent."""

    site: str
    topic: Topic
    agent: str


_SENDERS: dict[tuple[str, str, str], Address] = {}
"""The address of each key, camera and boot id that were valid together."""


@lru_cache(maxsize=_MAX_SENDERS)
def parse_key(key: str) -> Address | None:
    """The address in a key such as ``syncline/local/camera/cam0/observation``; None for other keys."""
    for topic, pattern in _KEYS:
        found = pattern.match(key)
        if found:
            agent = name_of_segment(found[2])
            return None if agent is None else Address(found[1], topic, agent)
    return None


def unknown_key() -> Rejected:
    """The rejection of a message whose key `parse_key` does not know."""
    return Rejected(RejectionReason.UNKNOWN_KEY, "no topic has this key, or its id is not usable as a name")


def message_class(topic: Topic) -> type[Message]:
    """The protobuf class of a topic's messages."""
    return _CLASSES[topic.message]


def sender(message: Message) -> str | None:
    """The name of the sender in the message itself; None for message types without one."""
    if isinstance(message, pb.Observation | pb.CameraInfo | pb.NodeState | pb.Picture):
        return message.camera
    if isinstance(message, pb.Command):
        return message.sender
    if isinstance(message, pb.AgentStatus | UAV_MESSAGES):
        return message.agent
    return message.hub if isinstance(message, pb.Shard) else None


def encode(message: Message) -> bytes:
    """Serialise; equal messages give equal bytes (maps are sorted). Raises Rejected above MAX_PAYLOAD."""
    payload = message.SerializeToString(deterministic=True)
    if len(payload) > MAX_PAYLOAD:
        raise Rejected(RejectionReason.OVERSIZED, f"{len(payload)} bytes, at most {MAX_PAYLOAD}")
    return payload


def decode(topic: Topic, payload: bytes) -> Message:
    """Parse and validate one payload of ``topic``; raises Rejected."""
    if len(payload) > MAX_PAYLOAD:
        raise Rejected(RejectionReason.OVERSIZED, f"{len(payload)} bytes, at most {MAX_PAYLOAD}")
    try:
        message = _CLASSES[topic.message].FromString(payload)
    except DecodeError as error:
        raise Rejected(RejectionReason.GARBLED, str(error)) from None
    try:
        if isinstance(message, pb.Observation):
            _check_observation(message, payload)
        else:
            check(message)
    except Rejected as error:
        error.sequence = getattr(message, "sequence", None)
        raise
    return message


def _check_observation(message: pb.Observation, payload: bytes) -> None:
    """``check``, by the layout of earlier observations where one matches."""
    if _LAYOUTS.match(payload):
        check_names(message.camera, message.boot_id)
    else:
        check(message)
        _LAYOUTS.learn(payload)


def admit(key: str, payload: bytes) -> tuple[Address, Message]:
    """Parse and validate what arrived under ``key``; raises Rejected.

    A message whose sender differs from the agent in its key is rejected: otherwise an agent that may publish
    only below its own key could publish in another's name.
    """
    if _LAYOUTS.match(payload):  # what else there is to check are the names
        try:
            observation = pb.Observation.FromString(payload)
            return _SENDERS[key, observation.camera, observation.boot_id], observation
        except (DecodeError, KeyError):
            pass
    address = parse_key(key)
    if address is None:
        raise unknown_key()
    message = decode(address.topic, payload)
    claimed = message.camera if isinstance(message, pb.Observation) else sender(message)
    if claimed is not None and claimed != address.agent:
        raise Rejected(RejectionReason.WRONG_SENDER, f"{claimed!r} under the key of {address.agent!r}")
    if isinstance(message, pb.Observation):
        if len(_SENDERS) >= _MAX_SENDERS:
            _SENDERS.clear()
        _SENDERS[key, message.camera, message.boot_id] = address
    return address, message


def admit_all(keys: Sequence[str], payloads: Sequence[bytes]) -> list[tuple[Address, Message] | Rejected]:
    """``admit`` of several messages; what it raises is in its message's place."""
    found: list[tuple[Address, Message] | Rejected] = []
    parse = pb.Observation.FromString
    for key, payload, matches in zip(keys, payloads, _LAYOUTS.match_all(payloads), strict=True):
        try:
            if matches:
                observation = parse(payload)
                found.append((_SENDERS[key, observation.camera, observation.boot_id], observation))
                continue
        except (DecodeError, KeyError):
            pass
        try:
            found.append(admit(key, payload))
        except Rejected as error:
            found.append(error)
    return found
