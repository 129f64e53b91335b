"""Agents as processes: assembly from configuration, health, systemd, recorder."""
