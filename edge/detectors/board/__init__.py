"""Calibration boards and square tags: their description, their corners in an image, a detector of labelled corners."""
