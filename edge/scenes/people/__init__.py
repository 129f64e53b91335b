"""Scenes with walking people."""
