"""Offline calibration from a session: preprocessing, pair network, reconstruction, result."""
