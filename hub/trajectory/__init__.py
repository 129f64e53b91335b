"""Trajectories: image tracks, splines, smoothness prior, triangulation."""
