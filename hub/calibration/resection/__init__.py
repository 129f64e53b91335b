"""Cameras found by resection against a path that others have solved: unconnected ones, and ones that were moved."""
