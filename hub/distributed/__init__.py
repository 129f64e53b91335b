"""Distributed pose estimation over a network of camera nodes."""
