"""Simulated town seen from a drone: images, telemetry and ground truth, also while the target is out of view."""
