"""The datum: gauge, scale, control points and their outlier test."""
