"""Checks of a vehicle's MAVLink connection: what is missing, by what is heard and what is not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from deploy.site.doctor.check_result import CheckResult, misconfigured, ok, unavailable, warn
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError

_PARAMETERS = {
    "PX4": (*(f"MAV_{port}_{name}" for port in range(3) for name in ("CONFIG", "FORWARD")), "MAV_HB_FORW_EN"),
    "ArduPilot": (*(f"{name}_OPTIONS" for port in range(1, 6) for name in (f"SERIAL{port}", f"MAV{port}")),),
}
"""Parameters by which a station and a component are kept apart, by firmware."""
_REMEDIES = {
    "PX4": "set MAV_x_FORWARD = 1 for this port and the station's (x as in MAV_x_CONFIG) and MAV_HB_FORW_EN = 1",
    "ArduPilot": "clear bit 10 of SERIALx_OPTIONS, since 4.7 bit 1 of MAVx_OPTIONS, of this port and the station's "
    "(don't forward MAVLink)",
}
_LEAST_RATE = 0.5  # of the requested rate: one message in two may be lost


@dataclass
class Heard:
    """What was heard on a link. samples: times of attitudes [s]. stations: ids of ground stations' heartbeats.

    second: who else is on it (`Link.second_sender`). gimbal: whether one reports. ignores_unsigned: see ``Vehicle``.
    """

    firmware: str = "the autopilot"
    samples: list[float] = field(default_factory=list)
    synchronised: bool = False
    stations: set[int] = field(default_factory=set)
    parameters: dict[str, float] = field(default_factory=dict)
    refusal: str = ""
    second: str = ""
    gimbal: bool = False
    ignores_unsigned: bool = False


def check(config: Any, patience_s: float = 3.0, listen_s: float = 2.5) -> Iterator[CheckResult]:
    """Wait for a heartbeat, then see what telemetry, gimbal and stations are heard. config: a ``UavConfig``."""
    try:
        from edge.mavlink.dialect import CAMERA, camera_heartbeat
        from edge.mavlink.link.connection import Link
        from edge.mavlink.link.signing import Signing, read_key
        from edge.mavlink.link.transport import parse_url
        from edge.mavlink.roles.telemetry import MESSAGE_TYPES

        settings = config.mavlink
        url = parse_url(settings.url)
        signing = None if settings.key is None else Signing(read_key(settings.key))
    except InputError as error:
        yield misconfigured("mavlink", error.what, error.remedy)
        return
    # It identifies as the vehicle's camera and never as a ground station (255): an autopilot whose ground station falls
    # silent assumes a lost link and returns home.
    link = Link(
        url,
        system=settings.system,
        component=CAMERA,
        allowed=(*MESSAGE_TYPES, "PARAM_VALUE"),
        signing=signing,
        vehicle=settings.vehicle,
    )
    hello = camera_heartbeat()
    try:
        found = wait_for_heartbeat(link, hello if url.kind == "udpout" else None, patience_s)
        yield found
        if found.verdict == "ok":
            gimbal = config.mount == "gimbal"
            heard = listen(link, hello, gimbal=gimbal, rate_hz=settings.rate_hz, seconds=listen_s)
            yield telemetry(heard, gimbal=gimbal, rate_hz=settings.rate_hz)
            yield from unused(heard, link.vehicle, gimbal=gimbal)
            yield ground_station(heard)
    finally:
        link.close()


def wait_for_heartbeat(
    link: Any, hello: Any = None, patience_s: float = 3.0, now: Callable[[], float] = time.monotonic
) -> CheckResult:
    """Wait for an autopilot's heartbeat.

    link: an ``edge.mavlink.link`` connection that accepts HEARTBEAT. hello: a message that is sent each second, for
    autopilots that reply only to known senders; None = only receive. patience_s: timeout [s].
    """
    began = now()
    called = 0.0
    while now() - began < patience_s:
        heartbeats = [received for received in link.poll() if received.kind == "HEARTBEAT"]
        if heartbeats:
            return ok("mavlink", f"heartbeat of system {heartbeats[0].system}")
        if hello is not None and now() - began >= called and link.send(hello):
            called += 1.0
        link.wait(0.1)
    if "in use" in link.problem:
        return unavailable("mavlink", str(link.problem), "stop the agent (or whoever holds that port) and ask again")
    if "key" in link.problem or "sign" in link.problem:
        return unavailable("mavlink", str(link.problem), "the same key in both, and a clock that is set (GPS, NTP)")
    arrive = "arrive" in link.problem
    if link.problem and not arrive:
        return unavailable(
            "mavlink", str(link.problem), "check device, baud rate and rights (group dialout), or the address"
        )
    refused = sum(count for name, count in link.counters.items() if name not in ("received", "bytes", "opened", "sent"))
    if refused or arrive:
        return unavailable(
            "mavlink",
            f"{link.problem or 'bytes arrive, but no acceptable heartbeat'} ({dict(link.counters)})",
            "check the baud rate, MAVLink 2 (SERIALx_PROTOCOL = 2), and the signing key",
        )
    return unavailable(
        "mavlink",
        f"no heartbeat within {patience_s:g} s",
        "check the wiring (TX to RX), port and baud rate, and that the autopilot sends there (SERIALx_PROTOCOL = 2)",
    )


def listen(link: Any, hello: Any, *, gimbal: bool, rate_hz: float, seconds: float) -> Heard:
    """Ask for telemetry and parameters as the agent does, and collect what comes."""
    from edge.mavlink.dialect import AUTOPILOT, mavlink
    from edge.mavlink.roles.vehicle import Vehicle

    heard, vehicle = Heard(), Vehicle(link, gimbal=gimbal, rate_hz=rate_hz)
    began, due = time.monotonic(), 0.0
    while (elapsed := time.monotonic() - began) < seconds:
        if elapsed >= due:
            due += 1.0
            link.send(hello)
            for name in _PARAMETERS.get(heard.firmware, ()):
                if name not in heard.parameters:
                    link.send(mavlink.MAVLink_param_request_read_message(link.vehicle, AUTOPILOT, name.encode(), -1))
        vehicle.tick(time.monotonic_ns())
        for received in link.poll():
            message = received.message
            if received.kind == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS:
                heard.stations.add(received.system)
            elif received.kind == "PARAM_VALUE":
                heard.parameters[str(message.param_id)] = float(message.param_value)  # finite, or the link refuses it
            elif received.system == link.vehicle:
                if received.kind == "HEARTBEAT" and received.component == AUTOPILOT:
                    firmware = {mavlink.MAV_AUTOPILOT_PX4: "PX4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot"}
                    heard.firmware, before = firmware.get(message.autopilot, heard.firmware), heard.firmware
                    due = elapsed if heard.firmware != before else due
                heard.gimbal |= received.kind == "GIMBAL_DEVICE_ATTITUDE_STATUS"
                heard.samples += [sample.host_ns / NANOSECONDS for sample in vehicle.handle(received)]
        link.wait(0.05)
    heard.synchronised = vehicle.clock.answered
    heard.ignores_unsigned = vehicle.ignores_unsigned
    heard.refusal, heard.second = vehicle.problem(time.monotonic_ns()), link.second_sender(time.monotonic_ns())
    return heard


def telemetry(heard: Heard, *, gimbal: bool, rate_hz: float) -> CheckResult:
    """Check the rate of attitudes, and that the autopilot answers."""
    if heard.ignores_unsigned:
        return misconfigured(
            "telemetry", f"{heard.firmware} signs its messages and ignores unsigned ones", "set key in [mavlink]"
        )
    count = len(heard.samples)
    rate = (count - 1) / max(heard.samples[-1] - heard.samples[0], 1e-3) if count > 1 else 0.0
    source = "gimbal attitudes" if gimbal else "attitudes"
    if count == 0 and gimbal:
        return unavailable(
            "telemetry",
            heard.refusal or "no GIMBAL_DEVICE_ATTITUDE_STATUS",
            "ArduPilot: MNT1_TYPE as the gimbal needs; PX4: MNT_MODE_OUT = 2 (MAVLink gimbal protocol v2); or mount = "
            '"fixed"',
        )
    if count == 0:
        return unavailable(
            "telemetry",
            heard.refusal or "no attitude, though it was asked for",
            "connect both directions (TX and RX), and give the port SERIALx_PROTOCOL = 2 (ArduPilot) or MAV_x_MODE = "
            "Onboard (PX4)",
        )
    text = f"{rate:.0f} {source} a second of {rate_hz:g} requested"
    if not heard.synchronised:
        return warn("telemetry", f"{text}; TIMESYNC is not answered", "connect both directions (TX and RX)")
    if rate < _LEAST_RATE * rate_hz:
        return warn("telemetry", text, "a faster port (921600 baud), or a lower rate_hz in [mavlink]")
    return ok("telemetry", text)


def unused(heard: Heard, followed: int | None, *, gimbal: bool) -> Iterator[CheckResult]:
    """Warn of another vehicle, and of a gimbal, where neither is used and the settings may have meant it."""
    if heard.second:
        remedy = "set vehicle in [mavlink] to the system that carries the camera, and system to the camera's own"
        yield warn("vehicle", f"system {followed} is followed; {heard.second}", remedy)
    if heard.gimbal and not gimbal:
        remedy = 'set mount = "gimbal" if the camera hangs on it'
        yield warn("gimbal", 'a gimbal reports its attitude, which mount = "fixed" does not use', remedy)


def ground_station(heard: Heard) -> CheckResult:
    """Check that a ground station's heartbeats come through: then the camera's reach it as well."""
    if heard.stations:
        return ok("ground station", f"system {', '.join(map(str, sorted(heard.stations)))} is heard")
    reason = _not_forwarded(heard)
    remedy = _REMEDIES.get(heard.firmware, "let the autopilot forward between this port and the station's")
    if not reason:
        remedy += "; with MAVProxy the camera goes on a port of the autopilot: two --out do not meet"
    return warn("ground station", f"none is heard{reason}", f"start one, or {remedy} (guide: MAVLink)")


def _not_forwarded(heard: Heard) -> str:
    """The parameters by which the autopilot keeps the camera and a station apart, as text; "" if there are none."""
    found = []
    for name, value in heard.parameters.items():
        if heard.firmware == "PX4":  # integers come as the bits of a float
            port = name.partition("FORWARD")[0] + "CONFIG"
            if value == 0.0 and not name.endswith("CONFIG") and heard.parameters.get(port, 1.0) != 0.0:
                found.append(f"{name} = 0")
        elif heard.firmware == "ArduPilot":
            bit = 10 if name.startswith("SERIAL") else 1
            if int(value) >> bit & 1:
                found.append(f"{name} has bit {bit}")
    return "".join(f"; {one}" for one in sorted(found))
