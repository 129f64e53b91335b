"""Tools for recorded logs: replay, summary, comparison, export to rerun."""
