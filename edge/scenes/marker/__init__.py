"""Scenes of one moving marker: scene, renderer, simulated detections."""
