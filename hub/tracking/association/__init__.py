"""Data association: assignment, track initiation, re-identification."""
