"""Target model of the UAV tracker: appearance, footprint, motion, measurement likelihood, re-detection."""
