"""The demos: simulated rigs and flights as real processes."""
