"""A simulated town seen from a drone: pictures, telemetry and the truth, also while the car is out of the picture."""
