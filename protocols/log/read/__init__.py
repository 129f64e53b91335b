"""Reading MCAP logs: whole, damaged, in parts, of earlier versions."""
