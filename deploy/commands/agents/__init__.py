"""Commands that run agents or the live view."""
