"""Agents as processes: construction from a configuration, health endpoints, systemd notification, recorder."""
