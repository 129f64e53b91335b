"""Validation of everything that comes from the bus or a log, before anything else reads it."""
