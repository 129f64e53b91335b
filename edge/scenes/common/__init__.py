"""Common parts of simulated scenes: cameras, placement, background, sensor noise."""
