"""The multi-target Kalman filter: target models, measurement model, update, manoeuvres."""
