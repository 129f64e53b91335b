"""Writing MCAP logs: crash-safe, with rotation and Foxglove channels."""
