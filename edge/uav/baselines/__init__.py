"""The parts of the paper's tracker, one module for each of its sections; ``paper_tracker`` puts them together.

Everything is in pixels of the image (x right, y down, (0, 0) the centre of the top left pixel) and per frame; angles
are atan2(dy, dx), so they grow clockwise on the screen. Equation numbers are the paper's own.
"""
