"""Compute the brightness of tumbling bodies, and fit the motion of a body to one light curve."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.tumblers import brightness as brightness, plot as plot
from rigidjax.tumblers.light_curve import (
    LightCurve as LightCurve,
    fit_light_curve as fit_light_curve,
)
from rigidjax.tumblers.sensor import Brightness as Brightness
from rigidjax.tumblers.two_frequencies import two_frequencies as two_frequencies

__all__ = ["Brightness", "LightCurve", "brightness", "fit_light_curve", "plot", "two_frequencies"]

define_dir_and_getattr(__name__)
