"""Motion of the static scene in the image, of a camera without lens and telemetry."""
