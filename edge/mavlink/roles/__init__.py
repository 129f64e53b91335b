"""The roles on a MAVLink network: camera component, autopilot, ground station, guidance."""
