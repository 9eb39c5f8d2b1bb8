"""Describe the result of a fit, in numbers and in words."""
