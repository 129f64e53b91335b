"""Data association: detection-to-track assignment, track initiation, re-identification of lost tracks."""
