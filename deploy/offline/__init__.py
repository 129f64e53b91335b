"""Offline work on videos, sessions and logs."""
