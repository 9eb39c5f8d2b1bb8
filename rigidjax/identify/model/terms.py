"""Compute the errors of all readings, and their derivatives recording by recording."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, input_functions
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model.charts import Bodies, body_at
from rigidjax.identify.model.first_order import FirstOrder, value_and_jacfwd
from rigidjax.identify.model.free import with_steps
from rigidjax.identify.model.predict import (
    HeldSteps,
    errors_along,
    needed_body,
    sensor_inputs,
    states_at,
)
from rigidjax.identify.model.scene import Scene
from rigidjax.identify.sensors.base import extras
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import Input, bind
from rigidjax.rotation.barrier import match_batch_axes, platform

if TYPE_CHECKING:
    from rigidjax.identify.model.model import Model

# A `Row` holds the parameters of one recording, as `Index` describes. A `BodyIndex` is the index of
# the body of a recording among several bodies, or `None` for one body.
Row = Float[Array, " columns"]
BodyIndex = Array | None
# `SensorErrors` holds one array for each sensor, such as its errors (R, T, k), for R recordings, T
# times and k components.
SensorErrors = tuple[Array | np.ndarray, ...]
# `Noise` holds the standard deviations (R, k) of each sensor.
Noise = tuple[Float[Array, "records _"], ...]


# `Blocks` holds for each sensor the errors (R, T, k), and their Jacobian (R, T, k, m) with respect
# to the m columns of a row.
Blocks = FirstOrder


class Motion(NamedTuple):
    """Hold the states at the times of a recording, and the torque with its inputs."""

    # The states have a leading time axis.
    states: Any
    torque: Torque | None


class White(NamedTuple):
    """Hold independent errors of variance one."""

    errors: Float[Array, "*rows k"]
    # The variance of each component if all before it are given: the squares of the diagonal of L.
    log_variances: Float[Array, "*rows k"]


class Standardised(NamedTuple):
    """Hold the errors of one sensor in standard deviations."""

    errors: Float[Array, "times k"]
    # True for a channel at full scale.
    saturated: Bool[Array, "times k"]
    # The logarithm of the factor by which jitter multiplies each variance; `None` without jitter.
    widening: Float[Array, "times k"] | None


def starting_scene(model: "Model", record: Recording) -> Scene:
    """Return the scene of a recording at the starting values, without body and initial state."""
    return Scene(None, model.torque, model.process, record.sensors, None)


def scene_at(
    model: "Model", row: Row, record: Recording, reference: ReferenceStates, body_index: BodyIndex
) -> Scene:
    """Return the scene of one recording at its parameters, which its `row` holds."""
    scene = with_steps(starting_scene(model, record), model.slots, row)
    body = body_at(model.chart, row, body_index)
    start = reference.initial(row[model.index.first :])
    return Scene(body, scene.torque, scene.process, scene.sensors, start)


def motion_in(model: "Model", scene: Scene, record: Recording) -> Motion:
    """Return the states at the times of a recording, and the torque that reads its inputs."""
    assert scene.body is not None and scene.start is not None
    body: Any = needed_body(scene.body, model.state_kind)
    functions = {name: source for name, source in record.inputs.items() if callable(source)}
    if isinstance(model.integrator, HeldSteps) and scene.torque is not None:
        samples = {n: rows for n, rows in record.inputs.items() if n not in functions}
        unbound = {name: Input(name) for name in samples}
        torque = bind(scene.torque, functions | unbound)
        states = model.integrator.driven_states(body, scene.start, record.t, torque, samples)
        return Motion(states, bound_torque(scene, record))
    torque = bound_torque(scene, record)
    states = states_at(model.integrator, body, scene.start, record.t, torque)
    return Motion(states, torque)


def bound_torque(scene: Scene, record: Recording) -> Torque | None:
    return bind(scene.torque, input_functions(record))


def sensor_errors(
    model: "Model",
    row: Row,
    record: Recording,
    reference: ReferenceStates,
    body_index: BodyIndex,
    delay: Array | None = None,
) -> tuple[Array, ...]:
    """Return the errors of each sensor in one recording, in the unit of the sensor.

    The error is reading minus prediction, and zero for a masked reading. `delay`, s, is added to
    the clock offset of each sensor.
    """
    scene = scene_at(model, row, record, reference, body_index)
    return scene_errors(model, scene, record, delay)


def scene_errors(
    model: "Model", scene: Scene, record: Recording, delay: Array | None = None
) -> tuple[Array, ...]:
    """Return the errors of each sensor in a `scene` of the recording `record`, as `sensor_errors`
    does.
    """
    states, torque = motion_in(model, scene, record)
    assert scene.body is not None and scene.start is not None
    out, motion = [], (scene.body, torque, record.t, scene.start, states)
    for reading, sensor in zip(record.readings, scene.sensors, strict=True):
        errors = errors_along(sensor, reading.values, sensor_inputs(sensor, *motion, delay))
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out)


def map_recordings(function: Callable[..., PyTree], model: "Model", *arguments: PyTree) -> Any:
    """Return `function(*arguments, record, reference, body_index)` of every recording.

    The arguments and the result have a leading axis of recordings. On a CPU the recordings are
    computed one after another: XLA compiles the loop over the times of one recording, which changes
    a few dozen numbers in each step, to one kernel. Batched over recordings this loop runs at half
    the speed.
    """
    trees = *arguments, model.records, model.reference, model.body_indices
    arrays, rest = eqx.partition(trees, eqx.is_array)

    def function_of_recording(part: PyTree[Array]) -> PyTree:
        return function(*eqx.combine(part, rest))

    if model.count == 1:
        # For a single recording the function is called directly: a loop over recordings would only
        # make the compiled program larger.
        return jax.tree.map(
            lambda leaf: leaf[None], function_of_recording(stacking.pick(arrays, 0))
        )
    if platform() == "cpu":
        return lax.map(function_of_recording, arrays, batch_size=1)
    return jax.vmap(function_of_recording)(arrays)


def all_errors(model: "Model", x: Float[Array, " n"]) -> tuple[Array, ...]:
    """Return the errors of each sensor of a `model` in the sensor's unit, reading minus prediction.

    Derivatives are computed as by `map_rows`.
    """
    return map_rows(model.index.rows(x), model, sensor_errors)


@eqx.filter_custom_jvp
def map_rows(
    rows: Float[Array, "records columns"], model: "Model", function: Callable[..., PyTree]
) -> Any:
    """Return `function(model, row, record, reference, body_index)` of every recording.

    Only derivatives with respect to the rows are defined; they are computed recording by recording,
    in forward mode.
    """

    def function_of_row(row: Row, *rest: PyTree) -> Any:
        return function(model, row, *rest)

    return match_batch_axes(map_recordings(function_of_row, model, rows), rows)


@map_rows.def_jvp
def _map_rows_jvp(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> tuple[PyTree, PyTree]:
    (rows, model, function), (step, *rest) = primals, tangents
    if jax.tree.leaves(rest):
        raise TypeError(
            "model: wanted derivatives in the free numbers x alone, not in the numbers of the "
            "model; make them free by a Free(where, name)"
        )
    out, slopes = _row_jacobians(model, rows, function)
    along = jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, step), slopes)
    return match_batch_axes(out, rows), along


def error_jacobians(
    model: "Model", x: Float[Array, " n"], function: Callable[..., PyTree] = sensor_errors
) -> FirstOrder:
    """Return the value of `function` for each recording, and its Jacobian with respect to the row.

    The last axis (m) of the Jacobian is that of `model.index.places`.
    """
    out, slopes = _row_jacobians(model, model.index.rows(x), function)
    columns = jnp.asarray(model.index.columns, jnp.int32)
    if columns.size > model.index.width:
        slopes = jax.tree.map(lambda block: block[..., columns], slopes)
    return FirstOrder(out, slopes)


def _row_jacobians(
    model: "Model", rows: Float[Array, "records columns"], function: Callable[..., PyTree[Array]]
) -> FirstOrder:
    """Return the value of a `function` for `map_rows`, and its Jacobian in the rows."""

    def linear(row: Row, *rest: PyTree) -> FirstOrder:
        # Forward mode is cheaper than reverse mode, to compile and to run, for a dozen numbers and
        # one long loop over time.
        return value_and_jacfwd(lambda row: function(model, row, *rest), row)

    return map_recordings(linear, model, rows)


@eqx.filter_jit
def delay_slopes(model: "Model", x: Float[Array, " n"]) -> tuple[Float[Array, "..."], ...]:
    """Return the derivative of each sensor's errors with respect to a delay of its clock, per
    second.
    """

    def derivative_of_recording(row: Row, *rest: PyTree) -> Any:
        now = jnp.zeros((), model.records.t.dtype)
        return jax.jvp(lambda s: sensor_errors(model, row, *rest, delay=s), (now,), (now + 1,))[1]

    return map_recordings(derivative_of_recording, model, model.index.rows(x))


def whiten(model: "Model", errors: SensorErrors, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Return the errors of each sensor in standard deviations, as `standardise` computes them."""
    out = []
    for reading, error, sigma in zip(model.records.readings, errors, noise, strict=True):
        limit = extras(reading.sensor).limit
        parts: Any = reading.values, reading.mask, error, sigma, limit, reading.jitter_error
        out.append(jax.vmap(standardise)(*parts).errors)
    return tuple(out)


def decorrelate(errors: Float[Array, "*rows k"], jitter_error: Float[Array, "*rows k"]) -> White:
    """Return independent errors of variance one from errors e whose covariance is `1 + v vᵀ`.

    Here v is the `jitter_error`, the error due to a time stamp that is one standard deviation late;
    e and v are in standard deviations of the noise. The result is `L⁻¹ e` with the Cholesky factor
    L of the covariance.
    """
    e, v = errors, jitter_error
    along, total = jnp.cumsum(v * e, axis=-1), 1.0 + jnp.cumsum(v * v, axis=-1)
    none = jnp.zeros_like(total[..., :1])
    along = jnp.concatenate([none, along[..., :-1]], axis=-1)
    before = jnp.concatenate([none + 1.0, total[..., :-1]], axis=-1)
    return White((e - v * along / before) * jnp.sqrt(before / total), jnp.log(total / before))


def scaled_slopes(
    tangents: Array | np.ndarray, sigma: Array | np.ndarray, jitter_error: Array | None
) -> Float[Array, "..."] | Float[np.ndarray, "..."]:
    """Return tangents of a sensor's errors in standard deviations, made independent as by
    `decorrelate`.

    The tangents and the `jitter_error` are in the unit of the sensor.
    """
    scaled = tangents / sigma[:, None, :, None]
    if jitter_error is None:
        return scaled
    return jax.vmap(lambda e: decorrelate(e, jitter_error / sigma[:, None]).errors, -1, -1)(scaled)


def standardise(
    values: Float[Array, "times *components"],
    mask: Bool[Array, " times"],
    error: Float[Array, "times k"],
    sigma: Float[Array, " k"],
    limit: Float[Array, " k"] | None,
    jitter_error: Float[Array, "times k"] | None,
) -> Standardised:
    """Return the errors of one sensor in standard deviations.

    `error` and `jitter_error`, the error of a time stamp that is one standard deviation late, are
    in the unit of the sensor. The reading of a channel at full scale (`limit`) says only that the
    true value is at least as large. Its error is `√(−2 log Φ(z))` in magnitude, where z is the
    excess of the prediction over the limit in standard deviations (Tobin 1958,
    doi:10.2307/1907382).
    """
    scaled, wider = error / sigma[None], None
    full = jnp.zeros(scaled.shape, bool)
    if limit is not None:
        full = (jnp.abs(values) >= limit[None] * (1 - 1e-6)) & mask[:, None]
    if jitter_error is not None:
        v = jitter_error / sigma[None]
        # The reading of a channel at full scale carries no information about the error of its time
        # stamp. Its part of the jitter error is therefore set to zero.
        white, wider = decorrelate(scaled, jnp.where(full, 0.0, v))
        scaled = jnp.where(full, scaled / jnp.sqrt(1.0 + v * v), white)
    if limit is None:
        return Standardised(scaled, full, wider)
    side = jnp.sign(values)
    z = jnp.where(full, -side * scaled, 0.0)
    # Here z is the excess of the prediction over the limit in standard deviations. For a large z
    # the argument of the root underflows to zero, where a square root has no derivative. The error
    # is therefore set to zero beyond z = 5.
    root = jnp.sqrt(-2.0 * jax.scipy.special.log_ndtr(jnp.minimum(z, 5.0)))
    errors = jnp.where(full, -side * jnp.where(z < 5.0, root, 0.0), scaled)
    return Standardised(errors, full, wider)


def reading_residuals(
    model: "Model", errors: SensorErrors, noise: Noise, weights: Float[Array, "records times"]
) -> tuple[Array, ...]:
    """Return the residuals of the readings of each sensor, shrunk by the robust loss.

    The factor `weights` of a reading is zero if the reading is not fitted.
    """
    out = []
    for scaled in whiten(model, errors, noise):
        if model.loss is not None:
            scaled = jax.vmap(jax.vmap(model.loss.shrink))(scaled)
        out.append(scaled * weights[..., None])
    return tuple(out)


def residual_jacobians(
    function: Callable[[tuple[Array, ...]], tuple[Array, ...]],
    errors: SensorErrors,
    slopes: SensorErrors,
) -> FirstOrder:
    """Return the residuals `function(errors)` and their Jacobians.

    Each residual may depend only on the errors of its own reading.
    """
    # The product of the derivative of `function` with the slopes is cheap, since each residual
    # depends only on the errors of the same reading: no matrix of all residuals by all errors is
    # made.
    value, push = jax.linearize(function, errors)
    return FirstOrder(value, jax.vmap(push, in_axes=-1, out_axes=-1)(slopes))


def prior_weights(model: "Model") -> Float[Array, " n"]:
    """Return one over the standard deviation of the prior of each parameter, or zero without a
    prior.
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


def joint_residuals(model: "Model", x: Float[Array, " n"]) -> Float[Array, " j"]:
    """Return the residuals of the prior of the body and of the `AbstractPull`, if the model has
    them.

    Such a residual depends on several parameters at once.
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
    """Return all residuals that belong to no reading: of each parameter's prior, and
    `joint_residuals`.
    """
    return jnp.concatenate([prior_weights(model) * x, joint_residuals(model, x)])


def reading_weights(
    model: "Model", errors: SensorErrors, noise: Noise
) -> tuple[Float[Array, "..."], ...]:
    """Return the weights of each sensor's readings in the normal equations, zero for a masked one.

    With a robust loss ρ(s) the weight is dρ/ds, else 1.
    """
    masks = [reading.mask for reading in model.records.readings]
    if model.loss is None:
        return tuple(mask.astype(e.dtype) for mask, e in zip(masks, errors, strict=True))
    weight = jax.vmap(jax.vmap(model.loss.weight))
    scaled = whiten(model, errors, noise)
    return tuple(jnp.where(mask, weight(e), 0.0) for mask, e in zip(masks, scaled, strict=True))


def half_squares(tree: PyTree) -> Float[Array, ""]:
    """Return half the sum of the squares of all numbers in a pytree."""
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
