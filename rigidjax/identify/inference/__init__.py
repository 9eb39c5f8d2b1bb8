"""Compute posterior densities, compare models, and design experiments."""
