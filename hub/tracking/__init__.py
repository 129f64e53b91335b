"""Targets in 3-D from single-camera observations, each at its own time. No sockets, threads, files or clocks."""
