"""Detection of moving objects: background subtraction, shadows, gating, vehicles."""
