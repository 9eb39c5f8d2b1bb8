"""Compute covariances of a fit, allow for flat bodies, and give intervals of named quantities."""
