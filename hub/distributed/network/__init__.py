"""The network of pose nodes: association, localisation, block solver, moved cameras."""
