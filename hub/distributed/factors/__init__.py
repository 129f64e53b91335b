"""Relative-pose factors between two cameras: initialisation, linearisation, accumulation."""
