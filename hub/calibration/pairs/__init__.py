"""Timing of all pairs of cameras: which overlap, and what each pair says."""
