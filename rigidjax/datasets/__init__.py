"""Provide published measurements and ephemerides, ready to be fitted."""

from rigidjax._names import show
from rigidjax.datasets import moon as moon, toutatis as toutatis

__all__ = ["moon", "toutatis"]

show(__name__)
