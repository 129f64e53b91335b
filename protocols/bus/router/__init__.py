"""A Zenoh router in this process, the monitoring of its data path, and the test of its access rules."""
