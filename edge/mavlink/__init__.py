"""The only place that speaks MAVLink bytes: links, signing, and what a camera, an autopilot and a station say."""
