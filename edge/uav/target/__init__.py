"""The target: appearance, likelihood, motion history, re-detection, state estimate."""
