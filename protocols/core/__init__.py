"""Foundations that every other package imports: errors, names, atomic files, clock maps, version."""
