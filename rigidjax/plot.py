"""Pictures. matplotlib is imported when called (extra `view`)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.motion import Attitude
from rigidjax.rotation import quaternion
from rigidjax.solve import simulate

# Okabe and Ito's colours, told apart by everyone.
COLOURS = ("#0072B2", "#D55E00", "#009E73")


def fit(found: Any, *, time_unit: str = "s", rate_unit: str = "rad/s", title: str = "") -> Any:
    """Data and fit of each sensor above, what is left over below.

    **Arguments:** `found` a `rigidjax.identify.Fit`; `time_unit` `s` or `day`; `rate_unit`
    `rad/s`, `deg/s` or `deg/day`; `title`. **Returns** the matplotlib figure.

    **Raises** `ModuleNotFoundError` where matplotlib is missing (install the extra `view`).
    """
    plt = _pyplot()
    seconds = {"s": 1.0, "day": 86400.0}[time_unit]
    rate = {"rad/s": 1.0, "deg/s": 180 / np.pi, "deg/day": 86400 * 180 / np.pi}[rate_unit]
    record = found.problem.recording
    t = np.asarray(record.t)
    dense = jnp.linspace(record.t[0], record.t[-1], 800)
    motion = simulate(found.body, found.state0, dense, found.problem.torque).ys
    count = len(record.readings)
    figure, axes = plt.subplots(
        2,
        count,
        figsize=(6.2 * count, 6),
        sharex=True,
        squeeze=False,
        height_ratios=(2, 1),
        layout="constrained",
    )
    for column, (reading, errors) in enumerate(zip(record.readings, found.residuals, strict=True)):
        upper, lower = axes[:, column]
        seen = reading.seen
        if reading.sensor.reading_shape == (4,):
            assert isinstance(motion, Attitude)
            read, line = _long_axis(reading.values), _long_axis(motion.q)
            names = [f"{axis} of body z" for axis in "xyz"]
            upper.set_ylabel("body z axis in world axes")
            left = np.degrees(np.asarray(errors))
            lower.set_ylabel("error, deg (body axes)")
        else:
            read, line = np.asarray(reading.values) * rate, np.asarray(motion.omega) * rate
            names = [f"Ω{axis}" for axis in "xyz"]
            upper.set_ylabel(f"body rate, {rate_unit}")
            left = np.asarray(errors) * rate
            lower.set_ylabel(f"error, {rate_unit}")
        many = seen.sum() > 100
        for axis, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
            upper.plot(np.asarray(dense) / seconds, line[:, axis], color=colour, lw=1.2, label=name)
            mark = {"marker": "." if many else "o", "ls": "", "ms": 2 if many else 5}
            upper.plot(t[seen] / seconds, read[seen, axis], color=colour, alpha=0.7, **mark)
            lower.plot(t[seen] / seconds, left[seen, axis], color=colour, alpha=0.7, **mark)
        lower.axhline(0, color="0.6", lw=0.8)
        lower.set_xlabel(f"time, {time_unit}")
        upper.margins(x=0.02, y=0.2)
        upper.legend(loc="upper right", ncols=3, fontsize="small")
        upper.set_title(f"{type(reading.sensor).__name__}: points read, lines fitted", fontsize=10)
    if title:
        figure.suptitle(title)
    return figure


def _long_axis(q: Any) -> np.ndarray:
    return np.asarray(jax.vmap(lambda one: quaternion.rotate(one, jnp.eye(3)[2]))(jnp.asarray(q)))


def _pyplot() -> Any:
    try:
        import matplotlib.pyplot as plt
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "rigidjax.plot needs matplotlib: pip install 'rigidjax[view]'"
        ) from error
    return plt
