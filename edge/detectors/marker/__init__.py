"""Marker detectors: coloured ball, point of light, fiducial tags."""
