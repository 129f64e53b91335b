"""Several people seen as keypoints: tracklets in each camera, and their association across cameras."""

END_STD = {"head": 0.012, "foot": 0.045}
"""Std of the ends of a person's silhouette over its size: of one walker in five rendered rooms 0.009 to 0.014 of the
head, and 0.04 to 0.05 of the foot, which swings with the gait."""

MIN_INTERVAL_NS = 90_000_000
"""Of the frames that are used, at least: with half as many, paths that turn bias clocks by 20 ms."""
