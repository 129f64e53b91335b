"""Puts agents into systemd's hands: units, users, device rules, configuration. No agent imports it."""
