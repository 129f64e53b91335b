"""Simulated sessions and flights written to disk."""
