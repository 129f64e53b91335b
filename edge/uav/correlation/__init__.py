"""Appearance of any target in the image: correlation filter, scale, template memory, search."""
