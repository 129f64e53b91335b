"""The bus itself: Zenoh and in-process sessions, queues, loss recovery."""
