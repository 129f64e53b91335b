"""Multi-target tracking in 3-D from asynchronous single-camera detections. No sockets, threads, files or clocks."""
