"""Bus implementations (Zenoh and in-memory): sessions, queues, recovery of lost messages."""
