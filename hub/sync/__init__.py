"""Synchronisation of a camera pair: lag search, refinement, acceptance tests."""
