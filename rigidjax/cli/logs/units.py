"""The units of columns, as factors to SI."""

import math

# All units become SI.
UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "m": 1.0, "mm": 1e-3, "m/s2": 1.0, "g": 9.80665, "1": 1.0,
    "rad": 1.0, "deg": math.pi / 180, "rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30,
}  # fmt: skip
