"""Several people seen as keypoints: tracklets in each camera, and their association across cameras."""

MIN_INTERVAL_NS = 90_000_000
"""Of the frames that are used, at least: with half as many, paths that turn bias clocks by 20 ms."""
