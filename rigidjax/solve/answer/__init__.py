"""Compute a motion, its error, its crossings and its exponents."""
