"""The hub's view of clocks that step or drift while cameras run: epochs of observations, moved time maps, alarms."""

from __future__ import annotations

import math
from dataclasses import replace

from hub.clocks.change_detector import ClockEvent, ClockWatch
from protocols.core.clocks import TimeMap
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration

EPOCH_ROWS = 600
"""Detections after a step from which on a clock is solved for by itself: until then the step is known better."""
_ALARMS = 32


class ClockEpochs:
    """Puts a clock watch between messages and the solver."""

    def __init__(self) -> None:
        self._watch = ClockWatch()
        self._runs: dict[str, str] = {}
        self.alarms: dict[str, str] = {}

    def sort(self, message: pb.Observation, arrival: float | None) -> tuple[pb.Observation, ClockEvent | None]:
        """The observation under the name of its clock's epoch, as if that were a boot; and what began with it."""
        epoch, event = self._watch.handle(
            message.camera, message.boot_id, message.sequence, message.frame, message.device_time_ns, arrival
        )
        self._runs[message.camera] = message.boot_id
        if event is not None and len(self.alarms) < _ALARMS:
            step, ppm = f"stepped by {event.step_s:+.3f} s", f"drifts {1e6 * event.rate:+.0f} ppm"
            told = step if event.kind == "step" else ppm
            self.alarms[event.camera] = f"the clock of {event.camera} {told}"
        if epoch == message.boot_id:
            return message, event
        apart = pb.Observation()
        apart.CopyFrom(message)
        apart.boot_id = epoch
        return apart, event

    def present(self, calibration: Calibration, boots: dict[str, str]) -> tuple[Calibration, dict[str, str]]:
        """The calibration with every time map moved to the epoch in which its camera's clock is now.

        t_old = t_new - step - drift * (t_new - at), from the event's moment ``at`` on; the std grows by the step's.
        """
        cameras, names = dict(calibration.cameras), dict(boots)
        for name, camera in calibration.cameras.items():
            rate, offset = camera.time_map.clock_rate, camera.time_map.time_offset
            std = camera.time_offset_std
            for event in self._watch.since(name, boots.get(name, "")):
                offset -= rate * (event.step_s - event.rate * event.at_s)
                rate *= 1.0 - event.rate
                std = math.hypot(std, event.std_s)
                names[name] = event.boot
            if names.get(name) != boots.get(name):
                time_map = TimeMap(time_offset=offset, clock_rate=rate)
                cameras[name] = replace(camera, time_map=time_map, time_offset_std=std)
        return replace(calibration, cameras=cameras), names

    def event(self, boot: str) -> ClockEvent | None:
        """The event that began the epoch ``boot``, as it is known by now; None if no event did."""
        return self._watch.event(boot)

    def rates_ppm(self) -> dict[str, float]:
        """How much slower than the hub's clock each camera's runs, over the last seconds."""
        rates = {camera: self._watch.rate(camera, boot) for camera, boot in self._runs.items()}
        return {camera: 1e6 * rate for camera, rate in rates.items() if rate is not None}
