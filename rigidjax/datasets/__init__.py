"""Provide published measurements and ephemerides, ready to be fitted."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.datasets import moon as moon, toutatis as toutatis

__all__ = ["moon", "toutatis"]

define_dir_and_getattr(__name__)
