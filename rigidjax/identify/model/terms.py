"""Compute the errors of all readings, and their derivatives recording by recording."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, inputs_as_functions
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model.charts import Bodies, body_of_recording
from rigidjax.identify.model.free import with_steps
from rigidjax.identify.model.predict import (
    HeldSteps,
    drop_unneeded_mass,
    errors_along,
    sensor_inputs,
    states_at,
)
from rigidjax.identify.model.scene import Scene
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import Input, bind
from rigidjax.rotation.barrier import match_batch_axes, platform

if TYPE_CHECKING:
    from rigidjax.identify.model.model import Model

# A `Row` holds the free numbers of one recording. A `BodyIndex` is the index of the body of a
# recording among several bodies, or `None` for one body.
Row = Float[Array, " columns"]
BodyIndex = Array | None
# `Blocks` are two tuples with one array for each sensor, for R recordings, T times and k
# components: the errors (R, T, k); and the derivatives (R, T, k, m) of these errors with respect to
# the m free numbers on which a recording depends (its row).
Blocks = tuple[tuple[Array, ...], tuple[Array, ...]]
# `SensorErrors` holds one array for each sensor, such as its errors (R, T, k).
SensorErrors = tuple[Array | np.ndarray, ...]
# `Noise` holds the standard deviations (R, k) of each sensor, for R recordings and k components.
Noise = tuple[Float[Array, "records _"], ...]


def scene_at_starting_values(model: "Model", record: Recording) -> Scene:
    """Return the scene (torques and sensors) of a recording, in which all free numbers have their
    starting values. Its body and initial state are still `None`.

    `model` has the torques, and `record` the sensors.
    """
    return Scene(None, model.torque, model.process, record.sensors, None)


def scene_from_row(
    model: "Model", row: Row, record: Recording, reference: ReferenceStates, body_index: BodyIndex
) -> Scene:
    """Return the scene (body, torques, sensors, initial state) of one recording at given free
    numbers.

    - `row`: the free numbers of the recording: those of its body, of the `Free`s (other numbers
      that a fit may move), and of its initial state, as `Index` describes.
    - `record`: the recording.
    - `reference`: a known state of the recording; the free numbers of its initial state are changes
      of this state.
    - `body_index`: the index of the body of the recording among several bodies, or `None` for one
      body.
    """
    scene = with_steps(scene_at_starting_values(model, record), model.slots, row)
    body = body_of_recording(model.chart, row, body_index)
    start = reference.initial_state_at(row[model.index.first :])
    return Scene(body, scene.torque, scene.process, scene.sensors, start)


def states_and_torque_of_scene(
    model: "Model", scene: Scene, record: Recording
) -> tuple[PyTree, Torque | None]:
    """Return two things: the states at the times of a recording, with a leading time axis; and the
    torque of the scene, with the inputs (logged quantities) of the recording bound to it.

    - `model`: the model, whose integrator is used.
    - `scene`: the body, the torque and the initial state.
    - `record`: the recording, with the times and the inputs.
    """
    assert scene.body is not None and scene.start is not None
    body: Any = drop_unneeded_mass(scene.body, model.state_kind)
    functions = {name: source for name, source in record.inputs.items() if callable(source)}
    if isinstance(model.integrator, HeldSteps) and scene.torque is not None:
        samples = {n: rows for n, rows in record.inputs.items() if n not in functions}
        unbound = {name: Input(name) for name in samples}
        torque = bind(scene.torque, functions | unbound)
        states = model.integrator.states_with_inputs(body, scene.start, record.t, torque, samples)
        return states, torque_with_inputs(scene, record)
    torque = torque_with_inputs(scene, record)
    return states_at(model.integrator, body, scene.start, record.t, torque), torque


def torque_with_inputs(scene: Scene, record: Recording) -> Torque | None:
    """Return the torque of a `scene` that reads the inputs (logged quantities such as a motor
    command) of the recording `record`, or `None` without a torque.
    """
    return bind(scene.torque, inputs_as_functions(record))


def errors_in_sensor_units(
    model: "Model",
    row: Row,
    record: Recording,
    reference: ReferenceStates,
    body_index: BodyIndex,
    delay: Array | None = None,
) -> tuple[Array, ...]:
    """Return the errors (T, k) of each sensor in one recording, in the unit of the sensor.

    The error is reading minus prediction; it is zero for a masked reading.

    **Arguments:**

    - `row`: the free numbers of the recording.
    - `record`: the readings of the recording.
    - `reference`: a known state of the recording; the free numbers of its initial state are changes
      of this state.
    - `body_index`: the index of the body of the recording, or `None` for one body.
    - `delay`: a time, s, that is added to the clock offset of each sensor; `None` for none.
    """
    scene = scene_from_row(model, row, record, reference, body_index)
    return errors_of_scene(model, scene, record, delay)


def errors_of_scene(
    model: "Model", scene: Scene, record: Recording, delay: Array | None = None
) -> tuple[Array, ...]:
    """Return the errors (T, k) of each sensor in its unit, for a given `scene` (body, torques,
    sensors, initial state) of the recording `record`.

    The error is reading minus prediction; it is zero for a masked reading. `delay` is a time, s,
    that is added to the clock offset of each sensor; `None` for none.
    """
    states, torque = states_and_torque_of_scene(model, scene, record)
    assert scene.body is not None and scene.start is not None
    out, motion = [], (scene.body, torque, record.t, scene.start, states)
    for reading, sensor in zip(record.readings, scene.sensors, strict=True):
        errors = errors_along(sensor, reading.values, *sensor_inputs(sensor, *motion, delay))
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out)


def map_over_recordings(function: Callable[..., PyTree], model: "Model", *arguments: PyTree) -> Any:
    """Return `function(*arguments, record, reference, body_index)` of every recording, with a
    leading axis of recordings.

    On a CPU the recordings are computed one after another. XLA compiles the loop over the times of
    one recording, which changes a few dozen numbers in each step, to one kernel. Batched over
    recordings, this loop runs at half the speed. On other devices all recordings are computed
    together.

    - `function`: a function of one recording.
    - `model`: the model, which has the R recordings, their reference states, and the index of the
      body of each recording.
    - `arguments`: trees of arrays with a leading axis (R,), such as the free numbers of each
      recording; `function` is called with the parts of one recording.
    """
    trees = *arguments, model.records, model.reference, model.body_indices
    arrays, rest = eqx.partition(trees, eqx.is_array)

    def function_of_recording(part: PyTree[Array]) -> PyTree:
        return function(*eqx.combine(part, rest))

    if model.count == 1:
        # For a single recording the function is called directly: a loop over recordings would only
        # make the compiled program larger.
        return jax.tree.map(
            lambda leaf: leaf[None], function_of_recording(stacking.pick_records(arrays, 0))
        )
    if platform() == "cpu":
        return lax.map(function_of_recording, arrays, batch_size=1)
    return jax.vmap(function_of_recording)(arrays)


def all_errors(model: "Model", x: Float[Array, " n"]) -> tuple[Array, ...]:
    """Return the errors (R, T, k), reading minus prediction, of each sensor at the free numbers x
    (n,) of a `model`, in the unit of the sensor.

    Derivatives with respect to x are computed recording by recording, in forward mode.
    """
    return differentiable_map_over_recordings(
        model.index.rows_of_recordings(x), model, errors_in_sensor_units
    )


@eqx.filter_custom_jvp
def differentiable_map_over_recordings(
    rows: Float[Array, "records columns"], model: "Model", function: Callable[..., PyTree]
) -> Any:
    """Return `function(model, row, record, reference, body_index)` of every recording, with a
    leading axis of recordings.

    The last four arguments are the free numbers, the readings, the reference state and the index of
    the body of one recording. Only derivatives with respect to the rows are defined. They are
    computed recording by recording, in forward mode.

    - `rows`: (R, columns) the free numbers of each of R recordings, one row for each recording.
    - `function`: a function such as `errors_in_sensor_units`, which returns an array or a tree of
      arrays for one recording.
    """

    def function_of_row(row: Row, *rest: PyTree) -> Any:
        return function(model, row, *rest)

    return match_batch_axes(map_over_recordings(function_of_row, model, rows), rows)


@differentiable_map_over_recordings.def_jvp
def _jvp_of_map_over_recordings(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> tuple[PyTree, PyTree]:
    """Return two things: the values of a function for each of R recordings, with a leading axis
    (R,); and the derivatives of these values along a change of the free numbers.

    It is the rule by which JAX differentiates `differentiable_map_over_recordings`. An error is
    raised if anything but the free numbers changes.

    - `primals`: the three arguments of `differentiable_map_over_recordings`: the free numbers (R,
      columns) of each of R recordings; the model; and the function.
    - `tangents`: the changes of these three arguments.
    """
    (rows, model, function), (step, *rest) = primals, tangents
    if jax.tree.leaves(rest):
        raise TypeError(
            "model: wanted derivatives in the free numbers x alone, not in the numbers of the "
            "model; make them free by a Free(where, name)"
        )
    out, slopes = _values_and_jacobians(model, rows, function)
    along = jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, step), slopes)
    return match_batch_axes(out, rows), along


def errors_and_jacobians(
    model: "Model", x: Float[Array, " n"], function: Callable[..., PyTree] = errors_in_sensor_units
) -> tuple[Any, Any]:
    """Return two things: the value of `function` for each of R recordings (R, …); and its
    derivatives (R, …, m) with respect to the m free numbers of the recording.

    The indices of these m free numbers among all free numbers are the row of the recording in
    `model.index.places` (R, m).

    - `x`: (n,) the free numbers of the `model`.
    - `function`: a function such as `errors_in_sensor_units`, with the same arguments, of one
      recording.
    """
    out, slopes = _values_and_jacobians(model, model.index.rows_of_recordings(x), function)
    columns = jnp.asarray(model.index.columns, jnp.int32)
    if columns.size > model.index.width:
        slopes = jax.tree.map(lambda block: block[..., columns], slopes)
    return out, slopes


def _values_and_jacobians(
    model: "Model", rows: Array, function: Callable[..., PyTree[Array]]
) -> tuple[PyTree[Array], PyTree[Array]]:
    """Return two things: the value of `function` for every recording, with a leading axis (R,) of
    recordings; and the derivatives of these values with respect to the free numbers of the
    recording, along a new last axis.

    - `model`: the model, which has the R recordings.
    - `rows`: (R, columns) the free numbers of each recording.
    - `function`: a function of one recording, called as `function(model, row, record, reference,
      body_index)` with the free numbers, the readings, the reference state and the index of the
      body of the recording. It returns an array or a tree of arrays, such as the errors of the
      readings.
    """

    def value_and_jacobian(row: Row, *rest: PyTree) -> tuple[PyTree, PyTree]:
        # Forward mode is cheaper than reverse mode, to compile and to run, for a dozen numbers and
        # one long loop over time.
        slopes, out = jacobian_and_value(lambda row: function(model, row, *rest), row)
        return out, slopes

    return map_over_recordings(value_and_jacobian, model, rows)


@eqx.filter_jit
def error_derivatives_by_delay(
    model: "Model", x: Float[Array, " n"]
) -> tuple[Float[Array, "..."], ...]:
    """Return, for each sensor, the derivative (R, T, k) of its errors with respect to a delay of
    its clock, in the sensor's unit per second, at the free numbers x (n,) of the `model`.
    """

    def derivative_of_recording(row: Row, *rest: PyTree) -> Any:
        now = jnp.zeros((), model.records.t.dtype)
        return jax.jvp(
            lambda s: errors_in_sensor_units(model, row, *rest, delay=s), (now,), (now + 1,)
        )[1]

    return map_over_recordings(derivative_of_recording, model, model.index.rows_of_recordings(x))


def jacobian_and_value(function: Callable[[Array], Any], x: Float[Array, " n"]) -> tuple[Any, Any]:
    """Return two things, computed in forward mode: the derivatives (…, n) of a function at x with
    respect to x; and the value (…) of the function.
    """

    def value_and_aux(x: Array) -> tuple[PyTree, PyTree]:
        value = function(x)
        return value, value

    return jax.jacfwd(value_and_aux, has_aux=True)(x)


def whiten(model: "Model", errors: SensorErrors, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Return the errors (R, T, k) of each sensor in standard deviations.

    Jitter, which is the random error of time stamps, correlates the errors of the k components of a
    reading; these errors are made independent. A reading at full scale is treated as a limit of the
    true value. Both are done by `standardised_errors_and_saturation`.

    - `model`: the model, which has the readings of R recordings.
    - `errors`: for each sensor the errors (R, T, k) in its unit.
    - `noise`: for each sensor the standard deviations (R, k) of its noise.
    """
    out = []
    for reading, error, sigma in zip(model.records.readings, errors, noise, strict=True):
        limit = getattr(reading.sensor, "limit", None)
        parts: Any = reading.values, reading.mask, error, sigma, limit, reading.jitter_error
        out.append(jax.vmap(standardised_errors_and_saturation)(*parts)[0])
    return tuple(out)


def white_errors_and_log_variances(
    errors: Float[Array, "*rows k"], jitter_error: Float[Array, "*rows k"]
) -> tuple[Float[Array, "*rows k"], Float[Array, "*rows k"]]:
    """Return two arrays (…, k), from errors e (…, k) whose covariance is `1 + v vᵀ`: independent
    errors of variance one (white errors); and the logarithms of conditional variances.

    Here 1 is the unit matrix, and v (…, k) is the `jitter_error`, the error due to a time stamp
    that is one standard deviation late. Both e and v are in standard deviations of the noise. The
    independent errors are `L⁻¹ e`, where L is the Cholesky factor of the covariance. The
    conditional variance of a component is its variance if all components before it are given. It is
    the square of the diagonal element of L.
    """
    e, v = errors, jitter_error
    along, total = jnp.cumsum(v * e, axis=-1), 1.0 + jnp.cumsum(v * v, axis=-1)
    none = jnp.zeros_like(total[..., :1])
    along = jnp.concatenate([none, along[..., :-1]], axis=-1)
    before = jnp.concatenate([none + 1.0, total[..., :-1]], axis=-1)
    return (e - v * along / before) * jnp.sqrt(before / total), jnp.log(total / before)


def standardised_error_changes(
    error_changes: Array | np.ndarray, sigma: Array | np.ndarray, jitter_error: Array | None
) -> Float[Array, "..."] | Float[np.ndarray, "..."]:
    """Return n changes (R, T, k, n) of a sensor's errors, converted to standard deviations.

    The `error_changes` are in the unit of the sensor, such as derivatives of the errors with
    respect to n numbers. They are divided by the standard deviations `sigma` (R, k) of the noise. A
    `jitter_error` (R, T, k) is the error due to a time stamp that is one standard deviation late,
    in the unit of the sensor. If it is given, the changes are also transformed as
    `white_errors_and_log_variances` transforms errors to independent ones.
    """
    scaled = error_changes / sigma[:, None, :, None]
    if jitter_error is None:
        return scaled
    return jax.vmap(
        lambda e: white_errors_and_log_variances(e, jitter_error / sigma[:, None])[0], -1, -1
    )(scaled)


def standardised_errors_and_saturation(
    values: Float[Array, "times *components"],
    mask: Bool[Array, " times"],
    error: Float[Array, "times k"],
    sigma: Float[Array, " k"],
    limit: Float[Array, " k"] | None,
    jitter_error: Float[Array, "times k"] | None,
) -> tuple[Float[Array, "times k"], Bool[Array, "times k"], Float[Array, "times k"] | None]:
    """Return three things: the errors of one sensor in standard deviations; a mask of saturated
    channels; and the effect of jitter.

    The effect of jitter is the logarithm of the factor by which jitter multiplies each variance, or
    `None` without jitter. The reading of a saturated channel says only that the true value is at
    least as large as the limit. Its error is `√(−2 log Φ(z))` in magnitude, where z is the excess
    of the prediction over the limit in standard deviations and Φ is the normal distribution
    function (Tobin 1958, doi:10.2307/1907382).

    **Arguments:**

    - `values`: the readings at T times.
    - `mask`: (T,) true where there is a reading.
    - `error`: (T, k) reading minus prediction, in the unit of the sensor.
    - `sigma`: (k,) the standard deviations of the noise, in the unit of the sensor.
    - `limit`: (k,) the full scale, or `None`.
    - `jitter_error`: (T, k) the error, in the unit of the sensor, that a time stamp makes if it is
      one standard deviation late, or `None`.
    """
    scaled, wider = error / sigma[None], None
    full = jnp.zeros(scaled.shape, bool)
    if limit is not None:
        full = (jnp.abs(values) >= limit[None] * (1 - 1e-6)) & mask[:, None]
    if jitter_error is not None:
        v = jitter_error / sigma[None]
        # The reading of a channel at full scale carries no information about the error of its time
        # stamp. Its part of the jitter error is therefore set to zero.
        white, wider = white_errors_and_log_variances(scaled, jnp.where(full, 0.0, v))
        scaled = jnp.where(full, scaled / jnp.sqrt(1.0 + v * v), white)
    if limit is None:
        return scaled, full, wider
    side = jnp.sign(values)
    z = jnp.where(full, -side * scaled, 0.0)
    # Here z is the excess of the prediction over the limit in standard deviations. For a large z
    # the argument of the root underflows to zero, where a square root has no derivative. The error
    # is therefore set to zero beyond z = 5.
    root = jnp.sqrt(-2.0 * jax.scipy.special.log_ndtr(jnp.minimum(z, 5.0)))
    return jnp.where(full, -side * jnp.where(z < 5.0, root, 0.0), scaled), full, wider


def reading_residuals(
    model: "Model", errors: SensorErrors, noise: Noise, weights: Float[Array, "records times"]
) -> tuple[Array, ...]:
    """Return the residuals (R, T, k) of the readings of each sensor, for least squares.

    The errors are divided by their standard deviations, shrunk by the robust loss of the `model`,
    and multiplied by the weights.

    - `errors`: for each sensor the errors (R, T, k) in its unit.
    - `noise`: for each sensor the standard deviations (R, k) of its noise.
    - `weights`: (R, T) a factor of each reading, such as zero for a reading that is not fitted.
    """
    out = []
    for scaled in whiten(model, errors, noise):
        if model.loss is not None:
            scaled = jax.vmap(jax.vmap(model.loss.shrink))(scaled)
        out.append(scaled * weights[..., None])
    return tuple(out)


def residuals_and_jacobians(
    function: Callable[[tuple[Array, ...]], tuple[Array, ...]],
    errors: SensorErrors,
    slopes: SensorErrors,
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return two things: the residuals `function(errors)`; and their derivatives (R, T, k, n) with
    respect to n numbers.

    - `function`: a function of the errors of all sensors; each of its residuals depends only on the
      errors of the same reading.
    - `errors`: for each sensor the errors (R, T, k).
    - `slopes`: for each sensor the derivatives (R, T, k, n) of its errors with respect to the n
      numbers.
    """
    # The product of the derivative of `function` with the slopes is cheap, since each residual
    # depends only on the errors of the same reading: no matrix of all residuals by all errors is
    # made.
    value, push = jax.linearize(function, errors)
    return value, jax.vmap(push, in_axes=-1, out_axes=-1)(slopes)


def prior_weights(model: "Model") -> Float[Array, " n"]:
    """Return the weight (n,) of each free number of a `model`: one over the standard deviation of
    its prior, whose mean is zero.

    The weight is zero for a number without a prior.
    """
    weights = jnp.zeros(model.index.size, model.records.t.dtype)
    for slot in model.slots:
        about = (slot.shared, slot.prior), (slot.own, slot.prior if slot.each else slot.spread)
        for places, deviation in about:
            if places is not None and deviation is not None:
                weights = weights.at[places].set((1.0 / deviation).astype(weights.dtype))
    if model.start_weight is not None:
        weights = weights.at[model.index.start].set(model.start_weight)
    return weights


def body_prior_and_pull_residuals(model: "Model", x: Float[Array, " n"]) -> Float[Array, " j"]:
    """Return the residuals (j,) of the prior of the body and of the `AbstractPull` of a `model`, at
    the free numbers x (n,) of the model.

    Such a residual may depend on several free numbers; the priors of single numbers are not
    included. An `AbstractPull` is an addition to the misfit that pulls free numbers, or quantities
    that depend on them, towards chosen values. A `model` need not have a prior of the body or a
    pull, so that j may be zero.
    """
    out = [jnp.zeros(0, x.dtype)]
    if model.prior is not None:
        assert not isinstance(model.chart, Bodies)
        body = model.chart.body(x[: model.index.bodies])
        out.append(model.prior.residuals(body, to_scale=model.chart.unit != "").reshape(-1))
    if model.pull is not None:
        out.append(model.pull(model, x))
    return jnp.concatenate(out)


def prior_residuals(model: "Model", x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Return all residuals of a `model` that do not belong to readings, at the free numbers x (n,).

    The first n residuals belong to the priors of the single free numbers. Then come the residuals
    of the prior of the body, and of an `AbstractPull`, an addition to the misfit that pulls free
    numbers towards chosen values.
    """
    return jnp.concatenate([prior_weights(model) * x, body_prior_and_pull_residuals(model, x)])


def reading_weights(
    model: "Model", errors: SensorErrors, noise: Noise
) -> tuple[Float[Array, "..."], ...]:
    """Return, for each sensor, the weights (R, T) of its readings in the normal equations, for R
    recordings of T times.

    With a robust loss ρ(s), the weight is dρ/ds, where s is the squared length of the error in
    standard deviations. Without a loss the weight is 1. It is zero for a masked reading.

    - `errors`: for each sensor the errors (R, T, k) in its unit.
    - `noise`: for each sensor the standard deviations (R, k) of its noise.
    """
    masks = [reading.mask for reading in model.records.readings]
    if model.loss is None:
        return tuple(mask.astype(e.dtype) for mask, e in zip(masks, errors, strict=True))
    weight = jax.vmap(jax.vmap(model.loss.weight))
    scaled = whiten(model, errors, noise)
    return tuple(jnp.where(mask, weight(e), 0.0) for mask, e in zip(masks, scaled, strict=True))


def half_sum_of_squares(tree: PyTree) -> Float[Array, ""]:
    """Return half the sum of the squares of all numbers in a `tree` of arrays, such as the misfit
    of a tree of residuals.
    """
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
