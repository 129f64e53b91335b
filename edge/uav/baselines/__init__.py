"""Baseline trackers: colour-only tracker and the background-aware tracking paper, one module per section of it.

``paper_tracker`` combines the parts. Units are image pixels (x right, y down, (0, 0) the centre of the top left
pixel) and frames; angles are atan2(dy, dx), so they grow clockwise on the screen. Equation numbers are the paper's own.
"""
