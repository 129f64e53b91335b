"""The MAVLink link: transports, framing, signing, receiving, telemetry logs."""
