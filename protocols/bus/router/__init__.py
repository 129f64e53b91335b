"""A Zenoh router in this process, and the watch over its data path."""
