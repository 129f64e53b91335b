"""The papers' own methods, kept for comparison (``--solver paper``)."""
