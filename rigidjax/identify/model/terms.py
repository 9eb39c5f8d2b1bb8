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
from rigidjax.identify.data.recording import Recording, sources_of
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model.charts import Bodies, body_of_recording
from rigidjax.identify.model.free import with_steps
from rigidjax.identify.model.predict import (
    HeldSteps,
    body_of_equations,
    errors_along,
    sensor_inputs,
    states_at,
)
from rigidjax.identify.model.scene import Scene
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import Input, bind
from rigidjax.rotation.barrier import batch_as, platform

if TYPE_CHECKING:
    from rigidjax.identify.model.model import Model

# A `Row` holds the free numbers of a recording; a `BodyIndex` is the index of its body, `None` for
# one body.
Row = Float[Array, " columns"]
BodyIndex = Array | None
# The blocks are the errors (R, T, k) of each sensor, and their derivatives (R, T, k, m) by the m
# numbers of a row.
Blocks = tuple[tuple[Array, ...], tuple[Array, ...]]
# The noise holds the standard deviations (R, k) of each sensor, for R recordings and k components.
Noise = tuple[Float[Array, "records _"], ...]


def scene_template(model: "Model", record: Recording) -> Scene:
    """Return the scene of a recording with the starting values of all free numbers."""
    return Scene(None, model.torque, model.process, record.sensors, None)


def scene_from_row(
    model: "Model", row: Row, record: Recording, reference: ReferenceStates, body_index: BodyIndex
) -> Scene:
    """Return the scene of one recording from the row of its free numbers."""
    scene = with_steps(scene_template(model, record), model.slots, row)
    body = body_of_recording(model.chart, row, body_index)
    start = reference.start_at(row[model.index.first :])
    return Scene(body, scene.torque, scene.process, scene.sensors, start)


def motion_of_scene(model: "Model", scene: Scene, record: Recording) -> tuple[Any, Any]:
    """Return the states at the times of a recording, and the torque with its inputs."""
    assert scene.body is not None and scene.start is not None
    body: Any = body_of_equations(scene.body, model.state_kind)
    functions = {name: source for name, source in record.inputs.items() if callable(source)}
    if isinstance(model.integrator, HeldSteps) and scene.torque is not None:
        samples = {n: rows for n, rows in record.inputs.items() if n not in functions}
        unbound = {name: Input(name) for name in samples}
        torque = bind(scene.torque, functions | unbound)
        states = model.integrator.states_with_inputs(body, scene.start, record.t, torque, samples)
        return states, torque_of_scene(scene, record)
    torque = torque_of_scene(scene, record)
    return states_at(model.integrator, body, scene.start, record.t, torque), torque


def torque_of_scene(scene: Scene, record: Recording) -> Torque | None:
    """Return the torque of a scene, which reads the inputs of a recording."""
    return bind(scene.torque, sources_of(record))


def errors_of_recording(
    model: "Model",
    row: Row,
    record: Recording,
    reference: ReferenceStates,
    body_index: BodyIndex,
    delay: Array | None = None,
) -> tuple[Array, ...]:
    """Return the errors (T, k) of each sensor in one recording, in its unit, with zero for a masked
    reading.

    **Arguments:**

    - `row`: the free numbers of the recording.
    - `record`, `reference`: its readings, and its reference state.
    - `body_index`: the index of its body.
    - `delay`: s, by which all clocks are behind, in addition to their offsets.
    """
    scene = scene_from_row(model, row, record, reference, body_index)
    return errors_of_scene(model, scene, record, delay)


def errors_of_scene(
    model: "Model", scene: Scene, record: Recording, delay: Array | None = None
) -> tuple[Array, ...]:
    """Return the errors of `errors_of_recording` from the scene of the recording."""
    states, torque = motion_of_scene(model, scene, record)
    assert scene.body is not None and scene.start is not None
    out, motion = [], (scene.body, torque, record.t, scene.start, states)
    for reading, sensor in zip(record.readings, scene.sensors, strict=True):
        errors = errors_along(sensor, reading.values, *sensor_inputs(sensor, *motion, delay))
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out)


def over_records(function: Callable[..., PyTree], model: "Model", *rows: PyTree) -> Any:
    """Return `function(*rows, record, reference, body_index)` of every recording.

    On a CPU the recordings follow one after another: XLA makes one kernel of a loop over a few
    dozen numbers, whereas batched scalars in the inner loop run at half the speed.
    """
    trees = *rows, model.records, model.reference, model.body_indices
    arrays, rest = eqx.partition(trees, eqx.is_array)

    def function_of_recording(part: PyTree[Array]) -> PyTree:
        return function(*eqx.combine(part, rest))

    if model.count == 1:
        # One recording needs no loop, and the program is smaller without it.
        return jax.tree.map(
            lambda leaf: leaf[None], function_of_recording(stacking.pick_records(arrays, 0))
        )
    if platform() == "cpu":
        return lax.map(function_of_recording, arrays, batch_size=1)
    return jax.vmap(function_of_recording)(arrays)


def all_errors(model: "Model", x: Float[Array, " n"]) -> tuple[Array, ...]:
    """Return the errors (R, T, k) of each sensor at the free numbers x.

    Derivatives by x are computed recording by recording, in forward mode.
    """
    return by_recording(model.index.rows(x), model, errors_of_recording)


@eqx.filter_custom_jvp
def by_recording(
    rows: Float[Array, "records columns"], model: "Model", function: Callable[..., PyTree]
) -> Any:
    """Return `function(model, row, record, reference, body_index)` of every recording.

    Only derivatives by the rows are defined; they are those of `errors_and_jacobians`.
    """

    def function_of_row(row: Row, *rest: PyTree) -> Any:
        return function(model, row, *rest)

    return batch_as(over_records(function_of_row, model, rows), rows)


@by_recording.def_jvp
def _by_recording_jvp(primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    """Return the value and the tangent of `by_recording`."""
    (rows, model, function), (step, *rest) = primals, tangents
    if jax.tree.leaves(rest):
        raise TypeError(
            "model: wanted derivatives in the free numbers x alone, not in the numbers of the "
            "model; make them free by a Free(where, name)"
        )
    out, slopes = _values_and_jacobians(model, rows, function)
    along = jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, step), slopes)
    return batch_as(out, rows), along


def errors_and_jacobians(
    model: "Model", x: Float[Array, " n"], function: Callable[..., PyTree] = errors_of_recording
) -> tuple[Any, Any]:
    """Return `function` of every recording, and its derivatives (R, …, m) by the free numbers.

    The m derivatives are in the columns of `model.index`. Readings are differentiated by free
    numbers in this function and nowhere else.
    """
    out, slopes = _values_and_jacobians(model, model.index.rows(x), function)
    columns = jnp.asarray(model.index.columns, jnp.int32)
    if columns.size > model.index.width:
        slopes = jax.tree.map(lambda block: block[..., columns], slopes)
    return out, slopes


def _values_and_jacobians(
    model: "Model", rows: Array, function: Callable[..., PyTree[Array]]
) -> tuple[PyTree[Array], PyTree[Array]]:
    """Return `function` of every recording, and its derivatives by the columns of the rows."""

    def value_and_jacobian(row: Row, *rest: PyTree) -> tuple[PyTree, PyTree]:
        # For a dozen numbers and one long loop forward mode is cheaper to compile and to run.
        slopes, out = with_jacobian(lambda row: function(model, row, *rest), row)
        return out, slopes

    return over_records(value_and_jacobian, model, rows)


@eqx.filter_jit
def delay_derivatives(model: "Model", x: Float[Array, " n"]) -> tuple[Float[Array, "..."], ...]:
    """Return the derivative (R, T, k) of the errors of each sensor with respect to a delay of its
    clock.
    """

    def derivative_of_recording(row: Row, *rest: PyTree) -> Any:
        now = jnp.zeros((), model.records.t.dtype)
        return jax.jvp(
            lambda s: errors_of_recording(model, row, *rest, delay=s), (now,), (now + 1,)
        )[1]

    return over_records(derivative_of_recording, model, model.index.rows(x))


def with_jacobian(function: Callable[[Array], Any], x: Float[Array, " n"]) -> tuple[Any, Any]:
    """Return the derivative (…, n) of a function at x, in forward mode, and the value (…) of the
    function.
    """

    def value_and_aux(x: Array) -> tuple[PyTree, PyTree]:
        value = function(x)
        return value, value

    return jax.jacfwd(value_and_aux, has_aux=True)(x)


def whiten(model: "Model", errors: tuple, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Return the errors (R, T, k) of each sensor as `standardised_errors` scales them."""
    out = []
    for reading, error, sigma in zip(model.records.readings, errors, noise, strict=True):
        limit = getattr(reading.sensor, "limit", None)
        parts = reading.values, reading.mask, error, sigma, limit, reading.jitter_error
        out.append(jax.vmap(standardised_errors)(*parts)[0])
    return tuple(out)


def decorrelate(
    e: Float[Array, "*rows k"], v: Float[Array, "*rows k"]
) -> tuple[Float[Array, "*rows k"], Float[Array, "*rows k"]]:
    """Return errors that are independent and of variance one, from errors e (…, k) of covariance
    `1 + v vᵀ`.

    They are `L⁻¹ e`, with L the Cholesky factor of the covariance. The second result is the
    logarithms of the squared diagonal of L, which are those of the variance of each error given the
    errors before it.
    """
    along, total = jnp.cumsum(v * e, axis=-1), 1.0 + jnp.cumsum(v * v, axis=-1)
    none = jnp.zeros_like(total[..., :1])
    along = jnp.concatenate([none, along[..., :-1]], axis=-1)
    before = jnp.concatenate([none + 1.0, total[..., :-1]], axis=-1)
    return (e - v * along / before) * jnp.sqrt(before / total), jnp.log(total / before)


def in_deviations(
    x: Array | np.ndarray, sigma: Array | np.ndarray, jitter_error: Array | None
) -> Float[Array, "..."] | Float[np.ndarray, "..."]:
    """Return changes x (R, T, k, n) of a sensor's errors, in standard deviations.

    They are scaled as `standardised_errors` scales the errors, with the noise `sigma` (R, k) and
    the error `jitter_error` (R, T, k) by a time stamp.
    """
    x = x / sigma[:, None, :, None]
    if jitter_error is None:
        return x
    return jax.vmap(lambda e: decorrelate(e, jitter_error / sigma[:, None])[0], -1, -1)(x)


def standardised_errors(
    values: Float[Array, "times *components"],
    mask: Bool[Array, " times"],
    error: Float[Array, "times k"],
    sigma: Float[Array, " k"],
    limit: Float[Array, " k"] | None,
    jitter_error: Float[Array, "times k"] | None,
) -> tuple[Float[Array, "times k"], Bool[Array, "times k"], Float[Array, "times k"] | None]:
    """Return the errors of one sensor in standard deviations, a mask of saturated channels, and the
    effect of jitter.

    The effect of jitter is the logarithm of the factor by which it multiplies each variance, or
    `None` without jitter. A saturated channel says "at least that much", and counts as
    `√(−2 log Φ(z))`, where z is the excess of the prediction over the limit (Tobin 1958,
    doi:10.2307/1907382).

    **Arguments:**

    - `values`, `mask`: the readings, and where there are any.
    - `error`: (T, k) in the unit of the sensor.
    - `sigma`: (k,) the noise.
    - `limit`: (k,) the full scale, or `None`.
    - `jitter_error`: (T, k) the error that a time stamp makes if it is one standard deviation late,
      or `None`.
    """
    scaled, wider = error / sigma[None], None
    full = jnp.zeros(scaled.shape, bool)
    if limit is not None:
        full = (jnp.abs(values) >= limit[None] * (1 - 1e-6)) & mask[:, None]
    if jitter_error is not None:
        v = jitter_error / sigma[None]
        # The reading of a channel at full scale does not tell the error of its time stamp.
        white, wider = decorrelate(scaled, jnp.where(full, 0.0, v))
        scaled = jnp.where(full, scaled / jnp.sqrt(1.0 + v * v), white)
    if limit is None:
        return scaled, full, wider
    side = jnp.sign(values)
    z = jnp.where(full, -side * scaled, 0.0)
    # Beyond five standard deviations the term is set to zero, since its root has no derivative at
    # zero.
    root = jnp.sqrt(-2.0 * jax.scipy.special.log_ndtr(jnp.minimum(z, 5.0)))
    return jnp.where(full, -side * jnp.where(z < 5.0, root, 0.0), scaled), full, wider


def reading_residuals(
    model: "Model", errors: tuple, noise: Noise, weights: Float[Array, "records times"]
) -> tuple[Array, ...]:
    """Return the residuals (R, T, k) of the readings of each sensor, for least squares.

    They are whitened, shrunk by the robust loss, and multiplied by the `weights`.
    """
    out = []
    for scaled in whiten(model, errors, noise):
        if model.loss is not None:
            scaled = jax.vmap(jax.vmap(model.loss.shrink))(scaled)
        out.append(scaled * weights[..., None])
    return tuple(out)


def residuals_and_jacobians(
    function: Callable[[tuple], tuple], errors: tuple, slopes: tuple
) -> tuple[tuple, tuple]:
    """Return `function(errors)`, and its derivatives (R, T, k, n) from the `slopes` of the
    errors.
    """
    # Each residual depends on the errors of its own reading alone, so that this is cheap.
    value, push = jax.linearize(function, errors)
    return value, jax.vmap(push, in_axes=-1, out_axes=-1)(slopes)


def prior_weights(model: "Model") -> Float[Array, " n"]:
    """Return one over the standard deviation of the prior of each free number, a prior about zero.

    It is zero for a number without a prior.
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


def extra_residuals(model: "Model", x: Float[Array, " n"]) -> Float[Array, " j"]:
    """Return the residuals that depend on several numbers, which are those of the prior of the body
    and of a pull.
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
    """Return all residuals that do not belong to readings: n of the priors, then the
    `extra_residuals`.
    """
    return jnp.concatenate([prior_weights(model) * x, extra_residuals(model, x)])


def reading_weights(model: "Model", errors: tuple, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Return the weight (R, T) of each reading in the normal equations.

    The robust loss gives the weight; it is zero for a masked reading.
    """
    masks = [reading.mask for reading in model.records.readings]
    if model.loss is None:
        return tuple(mask.astype(e.dtype) for mask, e in zip(masks, errors, strict=True))
    weight = jax.vmap(jax.vmap(model.loss.weight))
    scaled = whiten(model, errors, noise)
    return tuple(jnp.where(mask, weight(e), 0.0) for mask, e in zip(masks, scaled, strict=True))


def half_sum(tree: PyTree) -> Float[Array, ""]:
    """Return half the sum of the squares of all leaves."""
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
