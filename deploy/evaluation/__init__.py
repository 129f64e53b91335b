"""Evaluation of calibrations and tracks against ground truth."""
