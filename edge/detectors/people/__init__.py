"""Detection of people as silhouettes: shape templates, occupancy, height model, segmentation."""
