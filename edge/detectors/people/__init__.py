"""People detection from silhouettes: templates, occupancy, height model, segmentation."""
