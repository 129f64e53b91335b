"""Diagnostics of a machine, a camera, the bus and the vehicle, with remedies; the checks are independent."""
