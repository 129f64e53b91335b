"""What simulated scenes share: cameras, placement, background, sensor noise."""
