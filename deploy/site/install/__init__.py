"""Installation of agents as systemd services: units, users, udev rules, configuration. No agent imports it."""
