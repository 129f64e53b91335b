"""The demos: simulated cameras and flights, run as separate agent processes."""
