"""Prediction of a target out of view: particle set, road paths, driver model."""
