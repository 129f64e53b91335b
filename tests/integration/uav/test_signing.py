"""With a signing key the UAV agent rejects everything that is unsigned."""

from __future__ import annotations

from edge.uav.world.patrol import patrol_world
from tests.support.uav_flights import Flight, mavlink


def test_with_a_signing_key_unsigned_commands_are_ignored() -> None:
    key = bytes(range(32))
    flight = Flight(patrol_world(3, 3.0, (320, 240)), key=key)
    flight.run(1.5)
    flight.station.codec.signing.sign_outgoing = False
    unsigned_command = mavlink.MAVLink_command_long_message(
        1, 100, mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0, 0.5, 0.5, 0, 0, 0, 0, 0
    )
    # Directly to the agent's link, not by the autopilot.
    assert flight.agent_pipe.other is not None
    flight.agent_pipe.other.send(bytes(unsigned_command.pack(flight.station.codec)), None)
    flight.run(1.7)
    assert flight.link.counters["refused.unsigned"] == 1
    assert not flight.agent.estimator.has_target
    flight.station.codec.signing.sign_outgoing = True
    assert flight.select()
    assert flight.agent.estimator.has_target
