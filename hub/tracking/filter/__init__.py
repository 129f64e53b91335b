"""Multi-target Kalman filter: target models, measurement model, manoeuvre model, per-frame update."""
