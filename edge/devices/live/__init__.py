"""Drivers of real cameras: USB, OAK, Raspberry Pi, network streams."""
