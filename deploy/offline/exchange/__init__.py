"""Exchange with other tools: imports, exports, and sessions as logs."""
