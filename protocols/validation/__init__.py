"""Validation of every message from the bus or a log, before other code reads it."""
