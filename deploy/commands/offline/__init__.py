"""Offline commands for sessions and videos."""
