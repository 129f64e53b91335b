"""Video servers: RTSP with H.264 over RTP, and MJPEG over HTTP."""
