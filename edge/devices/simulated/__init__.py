"""Simulated devices behind the same interface as real ones."""
