"""What is done with logs: replay, summaries, comparison, export to rerun."""
