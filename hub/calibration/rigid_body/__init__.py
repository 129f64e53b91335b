"""Calibration by a rigid body of known geometry: a board, tags. Poses of the body in each view give lags and poses."""
