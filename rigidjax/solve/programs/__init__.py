"""Trace functions, give linear maps a transpose, and run programs with the bodies last."""
