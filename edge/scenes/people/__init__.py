"""Scenes of walking people: scene, gait, renderer, simulated detections."""
