"""View state of a drone: its last image, and the target, particle and road messages by frame."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TypeVar

from protocols.messages import syncline_pb2 as pb

_FrameMessage = TypeVar("_FrameMessage", pb.TargetState, pb.TargetCloud, pb.RoadMap)


@dataclass(slots=True, eq=False)
class UavView:
    """One UAV agent. pictures: count. full_resolution: its images are those of the tracker, from a log."""

    name: str
    info: pb.UavInfo | None = None
    boot: str = ""
    picture: pb.Picture | None = None
    pictures: int = 0
    full_resolution: bool = False
    targets: deque[pb.TargetState] = field(default_factory=lambda: deque(maxlen=300))
    particle_sets: deque[pb.TargetCloud] = field(default_factory=lambda: deque(maxlen=50))
    roads: deque[pb.RoadMap] = field(default_factory=lambda: deque(maxlen=20))
    last_picture: float | None = None
    status: pb.AgentStatus | None = None

    def handle(
        self, message: pb.UavInfo | pb.TargetState | pb.TargetCloud | pb.RoadMap | pb.FlightImage, now: float
    ) -> None:
        """Process one message of this agent; a new boot id clears the history."""
        if message.boot_id != self.boot:
            self.boot = message.boot_id
            for history in (self.targets, self.particle_sets, self.roads):
                history.clear()
        if isinstance(message, pb.UavInfo):
            self.info = message
        elif isinstance(message, pb.TargetState):
            self.targets.append(message)
        elif isinstance(message, pb.TargetCloud):
            self.particle_sets.append(message)
        elif isinstance(message, pb.RoadMap):
            self.roads.append(message)
        else:
            self.full_resolution = True
            size = {"width": message.width, "height": message.height, "frame": message.frame}
            self._show(pb.Picture(camera=message.agent, boot_id=message.boot_id, jpeg=message.jpeg, **size), now)

    def show_thumbnail(self, picture: pb.Picture, now: float) -> None:
        """Show a thumbnail, unless full-resolution images are available."""
        if not self.full_resolution:
            self._show(picture, now)

    def at_image(self) -> tuple[pb.TargetState | None, pb.TargetCloud | None, pb.RoadMap | None]:
        """The messages of the image's frame, or the last before it: images are rarer and arrive later."""
        frame = None if self.picture is None else self.picture.frame
        return _last_up_to(self.targets, frame), _last_up_to(self.particle_sets, frame), _last_up_to(self.roads, frame)

    def _show(self, picture: pb.Picture, now: float) -> None:
        self.picture, self.pictures, self.last_picture = picture, self.pictures + 1, now


def _last_up_to(messages: deque[_FrameMessage], frame: int | None) -> _FrameMessage | None:
    """The last message of a frame up to ``frame``; the newest if there is no image."""
    for message in reversed(messages):
        if frame is None or message.frame <= frame:
            return message
    return None
