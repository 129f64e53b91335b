"""When the vehicle is commanded: the state of target, link and operator decides whether ``Guidance`` may send."""

from __future__ import annotations

import math

import numpy as np

from edge.mavlink.dialect import AUTOPILOT
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.roles.camera import ArmFollow, CameraComponent
from edge.mavlink.roles.guidance import Guidance, GuidanceTarget
from edge.mavlink.roles.vehicle import Vehicle
from edge.uav.base import Estimate, TrackState
from protocols.core.clocks import NANOSECONDS

LINK_STALE_S = 1.5  # without messages from the vehicle no command is sent
FRAME_TIMEOUT_S = 2.0  # without a frame for longer, nothing is commanded
_STOPPED = "stopped by the operator"


class GuidanceControl:
    """Feeds ``guidance`` with the target estimate, and holds it with a reason where it must not send."""

    def __init__(self, guidance: Guidance, link: Link, vehicle: Vehicle, camera: CameraComponent) -> None:
        self._guidance, self._link, self._vehicle, self._camera = guidance, link, vehicle, camera
        self._last_visible_s = -math.inf

    def begin(self, now_s: float) -> None:
        """A target was selected."""
        motion = self._vehicle.motion_at(now_s)
        self._guidance.begin(None if motion is None else motion[0])
        self._last_visible_s = now_s

    def handle(self, received: ReceivedMessage, now_s: float) -> None:
        """Take a GIMBAL_MANAGER_STATUS. Stations are told when the gimbal is left to another one, and free again."""
        guidance = self._guidance
        if received.component != AUTOPILOT or not guidance.limits.gimbal:
            return
        before = guidance.gimbal_taken_by
        guidance.handle_gimbal_status(received.message, now_s)
        if guidance.gimbal_taken_by != before:
            taken = f"gimbal left to {guidance.gimbal_taken_by}" if guidance.gimbal_taken_by else "gimbal is free again"
            self._camera.say(f"Syncline: {taken}")

    def stop(self) -> None:
        """The operator has stopped tracking."""
        self._guidance.disarm()
        self._guidance.hold(_STOPPED)

    def arm(self, command: ArmFollow, *, has_target: bool) -> bool:
        """Let the vehicle follow the present target, or end that; whether it was accepted. Stations are informed."""
        guidance, say = self._guidance, self._camera.say
        if not command.follow:
            guidance.disarm()
            say("Syncline: follow ended")
            return True
        if not has_target or not self._vehicle.armed:
            say(f"Syncline: no follow, {'vehicle disarmed' if has_target else 'no target'}")
            return False
        accepted = guidance.arm(command.by)
        fence_m, height = guidance.limits.fence_m, guidance.limits.height_m
        within = f"fence {fence_m:.0f} m, {height[0]:.0f}-{height[1]:.0f} m"
        say(f"Syncline: follow by {command.by}, {within}" if accepted else "Syncline: no follow, it is off")
        return accepted

    def update(self, now_ns: int, estimate: Estimate | None, frame_s: float, sample_s: float) -> None:
        """Send what is due. frame_s, sample_s: when the last frame and the last attitude arrived."""
        now_s, guidance = now_ns / NANOSECONDS, self._guidance
        station = guidance.armed_by
        if station is not None and not self._camera.is_present(station, now_s):
            guidance.disarm(f"station {station} is silent")
            guidance.hold(f"station {station} is silent")
        self._send(now_s, estimate, frame_s, sample_s)
        if station is not None and guidance.armed_by is None and guidance.hold_reason:
            self._camera.say(f"Syncline: follow ended, {guidance.hold_reason}")

    def _send(self, now_s: float, estimate: Estimate | None, frame_s: float, sample_s: float) -> None:
        guidance, vehicle = self._guidance, self._vehicle
        if estimate is None:
            if guidance.hold_reason != _STOPPED:
                guidance.hold("no target")
            return
        if estimate.state is TrackState.VISIBLE:
            self._last_visible_s = now_s
        motion = vehicle.motion_at(now_s)
        heard_s = min(self._link.last_received_ns / NANOSECONDS, sample_s)
        if estimate.state is TrackState.LOST:
            guidance.hold("the target is lost")
            guidance.disarm()
        elif now_s - heard_s > LINK_STALE_S:
            guidance.hold("the link is stale")
        elif now_s - frame_s > FRAME_TIMEOUT_S:
            guidance.hold("no frames")
        elif motion is None:
            guidance.hold("the vehicle's position is not known")
        elif not (math.isfinite(estimate.north) and math.isfinite(estimate.std_m)):
            guidance.hold("no metric ground")
        else:
            speed = estimate.speed if math.isfinite(estimate.speed) and math.isfinite(estimate.course) else 0.0
            course = estimate.course if math.isfinite(estimate.course) else 0.0
            target = GuidanceTarget(
                frame_s,
                np.array([estimate.north, estimate.east]),
                speed * np.array([math.cos(course), math.sin(course)]),
                estimate.std_m,
                now_s - self._last_visible_s,
            )
            guidance.tick(now_s, target, *motion, vehicle.origin)
