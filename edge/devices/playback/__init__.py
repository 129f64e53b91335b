"""Sources that play recordings: video files, image folders, logs."""
