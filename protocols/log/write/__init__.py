"""Writing MCAP logs: crash-safe, rotated, with Foxglove channels."""
