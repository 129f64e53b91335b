"""A drone's camera as the view knows it: its last pictures' worth of target, particles and road, frame by frame."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TypeVar

from protocols.messages import syncline_pb2 as pb

_Said = TypeVar("_Said", pb.TargetState, pb.TargetCloud, pb.RoadMap)


@dataclass(slots=True, eq=False)
class FlightView:
    """One UAV agent. pictures: how many came. full: its pictures are those that the tracker saw, from a log."""

    name: str
    info: pb.UavInfo | None = None
    boot: str = ""
    picture: pb.Picture | None = None
    pictures: int = 0
    full: bool = False
    targets: deque[pb.TargetState] = field(default_factory=lambda: deque(maxlen=300))
    clouds: deque[pb.TargetCloud] = field(default_factory=lambda: deque(maxlen=50))
    roads: deque[pb.RoadMap] = field(default_factory=lambda: deque(maxlen=20))
    last_picture: float | None = None
    last_target: float | None = None
    status: pb.AgentStatus | None = None

    def handle(
        self, message: pb.UavInfo | pb.TargetState | pb.TargetCloud | pb.RoadMap | pb.FlightImage, now: float
    ) -> None:
        """Take one message of this agent; another boot begins anew."""
        if message.boot_id != self.boot:
            self.boot = message.boot_id
            for said in (self.targets, self.clouds, self.roads):
                said.clear()
        if isinstance(message, pb.UavInfo):
            self.info = message
        elif isinstance(message, pb.TargetState):
            self.targets.append(message)
            self.last_target = now
        elif isinstance(message, pb.TargetCloud):
            self.clouds.append(message)
        elif isinstance(message, pb.RoadMap):
            self.roads.append(message)
        else:
            self.full = True
            size = {"width": message.width, "height": message.height, "frame": message.frame}
            self._show(pb.Picture(camera=message.agent, boot_id=message.boot_id, jpeg=message.jpeg, **size), now)

    def look(self, picture: pb.Picture, now: float) -> None:
        """Take a small picture."""
        if not self.full:
            self._show(picture, now)

    def at_picture(self) -> tuple[pb.TargetState | None, pb.TargetCloud | None, pb.RoadMap | None]:
        """What was said of the picture's frame, or last before it: pictures are rarer and later than words."""
        frame = None if self.picture is None else self.picture.frame
        return _said(self.targets, frame), _said(self.clouds, frame), _said(self.roads, frame)

    def _show(self, picture: pb.Picture, now: float) -> None:
        self.picture, self.pictures, self.last_picture = picture, self.pictures + 1, now


def _said(messages: deque[_Said], frame: int | None) -> _Said | None:
    """The last message of a frame up to ``frame``; the last of all where there is no picture."""
    for message in reversed(messages):
        if frame is None or message.frame <= frame:
            return message
    return None
