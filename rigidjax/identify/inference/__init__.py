"""Compute posterior densities and profiles, compare models, and design experiments."""
