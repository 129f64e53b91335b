"""The camera agent and the UAV agent: thin loops around devices, detectors and estimators."""
