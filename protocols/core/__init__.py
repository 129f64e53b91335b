"""Errors, atomic files, clocks, versions: what every other module stands on."""
