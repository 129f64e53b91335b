"""Rendered oblique flights with truth: horizon, buildings, trees, water, cars, people, bicycles, boats."""
