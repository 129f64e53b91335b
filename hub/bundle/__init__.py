"""Continuous-time bundle adjustment: residuals, normal equations, noise models, covariance."""
