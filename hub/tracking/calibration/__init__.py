"""Calibration input from people: labelled points and the vertical direction."""
