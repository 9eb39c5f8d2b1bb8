"""Compute the prediction errors of a fitted model on windows, as functions of the horizon.

The horizon is the number of steps from the measured start of a window to the predicted state.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax.identify.answer.result import Fit, require_one_fit
from rigidjax.identify.data.windows import (
    Horizons,
    Windows,
    by_horizon,
    require_windows,
    window_starts,
)
from rigidjax.identify.model.build import require_inputs
from rigidjax.identify.model.charts import body_places
from rigidjax.identify.model.index import build_index
from rigidjax.identify.model.model import all_errors


def predict_windows(fit: Fit, windows: Windows) -> Horizons:
    """Return the open-loop prediction errors of a fitted model, as functions of the horizon.

    A window is a short part of a record of measured states, and the horizon is the number of steps
    from its measured start to the predicted state. The model predicts from the measured start of
    each window, with the fitted body and the fitted numbers that all windows share.

    **Arguments:**

    - `fit`: the fit of a `Model` of windows.
    - `windows`: the windows of the fit, or other windows with the same kind of state and inputs.

    **Returns** a `Horizons` with `steps`, `mean_absolute`, `mean_norm` and `rms`. A good model has
    smaller errors than `windows.held_horizons()`, which predicts that the state stays constant.
    **Raises:** `TypeError` for a fit of other recordings than windows; `ValueError` for a `Free`
    with a value for each window, and for missing inputs.

    >>> t = np.linspace(0.0, 1.0, 11)
    >>> spin = rj.Spin(np.stack([0 * t, 0 * t, np.exp(-0.5 * t)], 1))
    >>> cut = rj.identify.windows(t, spin, length=5)
    >>> body = rj.identify.Known(rj.Inertia.from_principal(1.0, 1.0, 1.0))
    >>> drag = rj.identify.Free(lambda s: s.torque.coefficient, "drag")
    >>> law = rj.torques.Damping(0.1 * jnp.ones(3))
    >>> result = rj.identify.fit(rj.identify.Model(cut, body, torque=law, free=[drag]))
    >>> bool(predict_windows(result, cut).rms["omega"].max() < 1e-6)
    True
    """
    require_one_fit(fit)
    require_windows(windows)
    model = fit.model
    if model.clusters is None:
        raise TypeError("predict_windows: wanted a fit of windows, got one of recordings")
    if any(slot.own is not None for slot in model.slots):
        raise ValueError(
            "predict_windows: wanted a fit whose numbers all windows share, got a Free with a "
            "value for each window, which other windows do not have"
        )
    _checks.require_instance(windows.starts, type(model.reference.state), "windows.starts")
    require_inputs(model.torque, windows)
    # The states at the starts are known, so that the parameters are those that all windows share.
    reference, _, clusters = window_starts(windows, 1)
    bodies = body_places(model.charts, None, windows.count)
    index, slots = build_index(bodies, model.slots, 0)
    parts = dict(
        records=windows.records(),
        counts=np.full(windows.count, windows.length + 1, np.int32),
        body_indices=None,
        reference=reference,
        index=index,
        slots=slots,
        start_weight=None,
        clusters=clusters,
        noise_groups=jnp.zeros(windows.count, jnp.int32),
    )
    errors = _errors(dataclasses.replace(model, **parts), fit.x[: index.size])[0]
    return by_horizon(windows.starts, errors[:, 1:])


_errors = eqx.filter_jit(all_errors)
