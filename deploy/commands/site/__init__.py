"""Commands that set up and examine machines and sites."""
