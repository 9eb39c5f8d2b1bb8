"""Differentiable rigid-body and rotating-frame mechanics for JAX."""

__version__ = "0.1.0"
