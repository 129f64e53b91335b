"""What is wrong with a machine, a camera or a bus, and what to do about it. Each check stands alone."""
