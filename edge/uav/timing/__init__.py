"""Clock alignment between camera, telemetry and vehicle."""
