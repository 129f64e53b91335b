"""Detection of moving objects: background subtraction, shadows, short-term tracking, vehicles."""
