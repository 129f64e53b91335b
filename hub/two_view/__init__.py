"""Two-view geometry: relative pose, fundamental matrix, Sampson refinement."""
