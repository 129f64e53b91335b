"""The live view: what the bus says of a rig, in a browser."""
