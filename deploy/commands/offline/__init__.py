"""Commands that work on sessions and videos."""
