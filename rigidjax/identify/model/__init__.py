"""Compute bodies, motions and the errors of all readings from parameters."""
