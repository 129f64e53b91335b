"""With a signing key the UAV agent believes nothing that is unsigned."""

from __future__ import annotations

from edge.uav.world.patrol import patrol
from tests.uav_flights import Flight, mavlink


def test_with_a_key_an_unsigned_station_commands_nothing() -> None:
    key = bytes(range(32))
    flight = Flight(patrol(3, 3.0, (320, 240)), key=key)
    flight.run(1.5)
    flight.station.codec.signing.sign_outgoing = False
    stranger = mavlink.MAVLink_command_long_message(
        1, 100, mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0, 0.5, 0.5, 0, 0, 0, 0, 0
    )
    # Past the autopilot, straight onto the agent's wire.
    assert flight.agent_pipe.other is not None
    flight.agent_pipe.other.send(bytes(stranger.pack(flight.station.codec)), None)
    flight.run(1.7)
    assert flight.link.counters["refused.unsigned"] == 1
    assert not flight.agent.follower.following
    flight.station.codec.signing.sign_outgoing = True
    assert flight.select()
    assert flight.agent.follower.following
