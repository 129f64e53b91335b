"""MAVLink: the link (transports, framing, signing) and the roles of camera, autopilot and ground station."""
