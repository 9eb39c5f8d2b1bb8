"""Posterior densities, profiles, comparison of models, and design of experiments."""
