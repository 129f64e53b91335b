"""Live view of a site in a browser: cameras, trajectories and drones from bus messages or a recording."""
