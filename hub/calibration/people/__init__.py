"""Several people seen as keypoints: tracklets in each camera, and their association across cameras."""
