"""Covariances of a fit, flat bodies, and intervals of named quantities."""
