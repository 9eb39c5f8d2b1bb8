"""Tumbling bodies seen as points of light: brightness, light curves, the body from one alone."""

from typing import TYPE_CHECKING

from rigidjax._names import own_names, suggests
from rigidjax.tumblers import brightness as brightness, plot as plot
from rigidjax.tumblers.light_curve import (
    Alias as Alias,
    LightCurve as LightCurve,
    fit_light_curve as fit_light_curve,
)
from rigidjax.tumblers.sensor import Brightness as Brightness
from rigidjax.tumblers.two_frequencies import (
    TwoFrequencies as TwoFrequencies,
    two_frequencies as two_frequencies,
)

if not TYPE_CHECKING:
    __getattr__ = suggests(__name__)
__dir__ = own_names(__name__)
