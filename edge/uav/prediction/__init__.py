"""Prediction of a target out of view: particle filter, particle set, road paths, driver model."""
