"""Noise of the observations: correlated errors, effective sample size, jitter of time stamps, wander of clocks."""
