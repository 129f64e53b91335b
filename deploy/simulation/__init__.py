"""Writers of simulated sessions and flights with ground truth."""
