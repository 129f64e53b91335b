"""Scenes with one moving marker."""
