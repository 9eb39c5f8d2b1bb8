"""Map the parameters of a fit to the scene of each recording, by a model."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._types import NumbersLike, Scalar
from rigidjax.body import validation
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, input_functions
from rigidjax.identify.data.reference_states import ReferenceStates, first_rates
from rigidjax.identify.data.windows import Windows, outside_delays
from rigidjax.identify.model.build import fields_of_model
from rigidjax.identify.model.charts import (
    AbstractBodyChart,
    Charts,
    body_at,
    split_numbers,
)
from rigidjax.identify.model.first_order import FirstOrder, value_and_jacfwd
from rigidjax.identify.model.free import (
    Free,
    Slot,
    entries_at,
    leaves_at,
    split_path,
    with_leaves,
)
from rigidjax.identify.model.index import Index
from rigidjax.identify.model.predict import (
    AbstractIntegrator,
    HeldSteps,
    errors_along,
    known_motion,
    needed_body,
    sensor_inputs,
)
from rigidjax.identify.model.priors import AbstractLoss, Entropic, Measured
from rigidjax.identify.model.scene import Process, Scene
from rigidjax.identify.model.several import Part, fields_of_several
from rigidjax.identify.model.walks import Drift, Walk
from rigidjax.motion import Turn
from rigidjax.motion.coupled import motion_of
from rigidjax.motion.suspension import Law
from rigidjax.motion.torques.inputs import Input, bind, delays_of
from rigidjax.rotation.barrier import match_batch_axes, platform

# A `Row` holds the parameters of one recording, as `Index` describes. A `BodyIndex` is the index of
# the body of a recording among several bodies, or `None` for one body.
Row = Float[Array, " columns"]
BodyIndex = Array | None


class Unpacked(eqx.Module):
    """Hold the quantities that the parameters of a model represent, such as the body and the
    initial state.

    **Fields:**

    - `x`: (n,) the parameters.
    - `body`: the body; several bodies as a dict by name.
    - `state0`: the initial state; the initial states of several recordings have a leading axis; of
      several kinds of recordings a dict by kind.
    - `values`: the values of the `Free`s (other numbers that a fit may move) by name, in their
      units.
    - `noise`: if x belongs to a `LogDensity` (posterior density of a fitted model), for each sensor
      the standard deviations (R, k) of its noise, in its unit, for R recordings and k components;
      else `None`.
    - `process`: if x belongs to a `LogDensity` with a random torque, this torque; else `None`.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> low, high = result.interval_of(lambda point: point.state0.omega)  # a function of `Unpacked`
    >>> bool((low < high).all())
    True
    """

    x: Float[Array, " n"]
    body: Any
    state0: Any
    values: dict[str, Array]
    noise: tuple[Array, ...] | None = None
    process: Any = None


class Model(eqx.Module):
    """Hold the recordings of one body or of several bodies, and describe by n parameters x
    everything that their readings depend on.

    **Arguments:**

    - `recording`: one `Recording`, or a sequence of recordings with the same sensors: each
      recording has its own initial state, and all recordings share the body. `Windows` of a record
      of measured states may be given instead: each window is then a short recording whose initial
      state is known, or free about the measured state.
      For recordings of several kinds (other sensors, torques, integrators) give a model of each
      kind by name, and nothing else but `measured`: `Model({"throw": Model(a, chart), "hand":
      Model(b, chart, torque=Carried())})`. The kinds share the bodies, and each `Free` whose name
      they have in common.
    - `chart`: the chart of the body: `Ratios()` (the full tensor up to scale), `PrincipalRatios()`
      (if the body axes are known to be principal), `Tensor()` or `Principal()` (the full or the
      principal tensor with its scale), `Mass(guess)` (all ten numbers), `Moment(guess, suspension)`
      (the moment about one axis), or `Known(body)`. For several bodies give recordings and charts
      by the names of the bodies, as in `Model({"proof": [a, b], "box": [c]}, {"proof": Known(body),
      "box": Tensor(1e-3)})`.
    - `torque`: the torque on the body in every recording, or `None`. It reads the inputs of a
      recording by name: `rigidjax.torques.Input("speed")`. Of a body on one axis it is a suspension
      (`rigidjax.suspensions`).
    - `process`: an unknown torque as noise, a `RandomTorque`, a `CorrelatedTorque` or a `Sum` of
      such torques. `filter`, `smooth` and `LogDensity` integrate over this torque; `fit` sets it to
      its mean, zero.
    - `walks`: sensor errors that drift, a sequence of `Walk(where, deviation, density)`. `filter`,
      `smooth` and `LogDensity` follow the drift; `fit` takes the errors as constant.
    - `free`: other parameters, a sequence of `Free(where, name, …)`: one value for all, or one
      for each body, group or recording.
    - `loss`: a robust loss, `SoftL1()` or `Huber()`; `None` for plain least squares.
    - `prior`: `Entropic(guess, weight)`, a prior about a roughly known body, or `None`.
    - `measured`: numbers measured beside the recordings, a sequence of `Measured(of, value, sigma,
      name)`: a weight, a period, a length.
    - `integrator`: the integrator of a forced motion, `FixedSteps(n)` or `Adaptive(rtol, atol)`.
      With `None` it is chosen by the sampling. `Adaptive()` is quicker than fixed steps if the
      torque is smooth and the body turns by 0.1 rad or more between readings, but slow if the
      torque reads a noisy log. The motion of a free body is computed by the closed form. For
      windows, and for recordings whose inputs are samples, one step of order 4 is taken from each
      time to the next, and the samples are held constant during this step.
    - `stretches`: the number of stretches (groups of neighbouring windows) into which windows are
      divided. Standard deviations are computed by leaving out one stretch after the other. A
      stretch should be longer than the time for which an error of the model lasts.
    - `noise_each`: whether an estimated noise is one number for all recordings (`False`), one for
      each recording (`True`), one for each body (`"body"`), or one for all recordings with the same
      label (a sequence of labels, one for each recording).
    - `fields`: the values of all fields by name, which only `dataclasses.replace` gives.

    The model finds channels that were cut off at full scale. A reading at full scale then says only
    that the true value is at least this large, as with a sensor's `limit`.

    The motion starts at the first time of each recording. The state of the motion is the smallest
    type of state that sensors and torque need: a `Spin` (body rate), an `Attitude` (attitude and
    rate), or a `Rigid` (with position and velocity as well); on a suspension a `Turn` (angle and
    rate). **Raises:** `TypeError` for arguments
    of another type; `ValueError` if they do not fit together.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> model = rj.identify.Model(record, rj.identify.Ratios())
    >>> model.size, model.typical_rate  # five numbers of the body, three of the initial rate
    (8, Array(1., dtype=float64))
    """

    # The models of several kinds of recordings; empty if all recordings are of one kind.
    parts: tuple[Part, ...]
    records: Recording
    counts: Int[np.ndarray, " records"]
    charts: Charts
    body_names: tuple[str, ...] = eqx.field(static=True)
    body_indices: Int[Array, " records"] | None
    torque: Any  # of several kinds a dict by kind, or `None` if no kind has one
    process: Process | None
    walks: tuple[Drift, ...]
    beside: tuple[Array, ...]
    slots: tuple[Slot, ...]
    index: Index
    noise_groups: Int[Array, " records"]
    loss: AbstractLoss | None
    prior: Entropic | None
    measured: tuple[Measured, ...]
    start_weight: Float[Array, "records n"] | None
    clusters: Int[Array, " records"] | None
    integrator: AbstractIntegrator | None
    state_kind: type = eqx.field(static=True)
    filter_steps: int = eqx.field(static=True)
    reference: ReferenceStates

    def __init__(
        self,
        recording: Recording | Sequence[Recording] | Mapping[str, Any] | Windows | None = None,
        chart: AbstractBodyChart | Mapping[str, AbstractBodyChart] | None = None,
        *,
        torque: Law | None = None,
        process: Process | None = None,
        walks: Walk | Sequence[Walk] | tuple[Drift, ...] = (),
        free: Sequence[Free] = (),
        loss: AbstractLoss | None = None,
        prior: Entropic | None = None,
        measured: Sequence[Measured] = (),
        integrator: AbstractIntegrator | None = None,
        noise_each: bool | str | Sequence[Any] = False,
        stretches: int = 12,
        **fields: Any,
    ):
        given: dict[str, Any] = dict(torque=torque, process=process, walks=walks)
        given |= dict(loss=loss, prior=prior, integrator=integrator)
        for one in measured:
            _checks.require_instance(one, Measured, "measured", requirement="Measured(of, …)")
        named = recording if isinstance(recording, Mapping) else {}
        if any(isinstance(one, Model) for one in named.values()) and not fields:
            own: Any = dict(chart=chart, free=free, noise_each=noise_each or None)
            given, fields = {}, fields_of_several(named, **given, **own)
        elif not fields:
            rest: Any = dict(free=free, noise_each=noise_each, stretches=stretches)
            fields = fields_of_model(recording, chart, **given, **rest)
        elif recording is not None or chart is not None:
            # All fields together come from `dataclasses.replace`, without recording and chart.
            raise TypeError(f"Model: {next(iter(fields))!r} is no argument of a Model")
        for name, value in (given | fields | {"measured": tuple(measured)}).items():
            setattr(self, name, value)

    @property
    def size(self) -> int:
        """Return n, how many parameters this model has."""
        return self.index.size

    @property
    def count(self) -> int:
        """Return how many recordings this model has."""
        return int(self.records.t.shape[0])

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """Return the recordings of this model as a tuple.

        The model stores them with equally many times, where masked readings fill up the shorter
        recordings. These readings are left out here.
        """
        if self.parts:
            return tuple(one for part in self.parts for one in part.model.recordings)
        return tuple(
            stacking.take_rows(stacking.pick(self.records, index), count)
            for index, count in enumerate(np.asarray(self.counts).tolist())
        )

    @property
    def recording(self) -> Recording:
        """Return the only recording of this model, or the first one of several."""
        return self.recordings[0]

    @property
    def typical_rate(self) -> Scalar:
        """Return the typical body rate of the first recording of this model, rad/s, as its readings
        show it (1 if they show no rate).

        The parameters of the initial rate of this recording are in units of the typical rate.
        """
        return self.reference.rate[0]

    def start(self, body: PyTree = None, omega: NumbersLike | None = None) -> Float[Array, " n"]:
        """Return parameters (n,) with which a fit of this model may start, or which describe a
        planned motion of a given body at a given rate.

        Each number of a `Free` has its starting value.

        **Arguments:**

        - `body`: an `Inertia` or `MassProperties`; for several bodies a dict, by name, of the
          bodies that are roughly known. For a body that is not given, the chart chooses: the
          `guess` of a `Mass`, the body of a `Known`, and a sphere for the other charts of rigidjax.
        - `omega`: (3,) the initial rate in all recordings, rad/s, body frame. With `None` it is the
          first reading of a gyro, or the rate between measured attitudes (0 if the readings are
          traced).

        **Raises:** `ValueError` for a body that the chart cannot represent, or a wrong shape.
        """
        require_single(self)
        if self.parts:
            x = jnp.zeros(self.size)
            for part in self.parts:
                mine, named = body, dict.fromkeys(part.model.body_names)
                if isinstance(body, Mapping) and not set(body) - set(self.body_names):
                    mine = {name: body[name] for name in named if name in body}
                x = x.at[part.places].set(part.model.start(mine, omega))
            return x
        if self.body_indices is None:
            vector = _chart_vector(self.charts[0], body)
        else:
            by_name = dict(body) if isinstance(body, Mapping) else {}
            named = dict(zip(dict.fromkeys(self.body_names), self.charts, strict=True))
            wrong = [name for name in by_name if name not in named]
            if not isinstance(body, Mapping | None) or wrong:
                names, got = ", ".join(named), wrong or type(body).__name__
                raise ValueError(
                    f"body: wanted a dict such as {{{next(iter(named))!r}: Inertia(…)}}, whose "
                    f"names are among {names}, or None; got {got}"
                )
            parts = (_chart_vector(chart, by_name.get(name)) for name, chart in named.items())
            vector = jnp.concatenate(list(parts))
        kind = jnp.result_type(float)
        if omega is None and not self.index.start.size:
            rates = np.zeros((1, 3))
        elif omega is None:
            rates = first_rates(self.records, self.counts)
        else:
            rates = _checks.array_of_shape(omega, (3,), "omega").astype(kind)[None]
        xp: Any = np if _checks.is_known((vector, rates, self.reference.rate)) else jnp
        spin = xp.asarray(rates) / xp.asarray(self.reference.rate)[:, None]
        spin = xp.broadcast_to(spin, (self.count, 3)).astype(kind)
        if self.state_kind is Turn:
            spin = xp.stack([xp.zeros(self.count), spin @ xp.asarray(self.torque.unit)], -1)
        spin = spin if self.index.start.size else spin[:, :0]
        rest = self.size - vector.size - spin.size
        own = sum(s.own.size for s in self.slots if s.own is not None)
        zeros = xp.zeros(rest - own, kind), xp.zeros(own, kind)
        # `Index` describes the order of the parameters: first the numbers of the bodies, and of
        # the `Free`s that recordings share; then the initial states, whose rates come last; then
        # the numbers of the `Free`s that one recording has alone.
        parts = [xp.asarray(vector, kind), zeros[0], spin.reshape(-1), zeros[1]]
        return jnp.asarray(xp.concatenate(parts))

    def unpack(self, x: Float[Array, " n"]) -> Unpacked:
        """Return the quantities that the parameters x (n,) represent: body, initial state, values
        of the `Free`s.

        For several recordings the states have a leading axis.
        """
        x = checked_x(self, x)
        if _checks.is_known((self, x)):
            # Outside of `jit` each operation would be compiled as a program of its own.
            return eqx.filter_jit(unpack_at)(shortened(self), x)
        return unpack_at(self, x)

    def bodies(self, x: Float[Array, " n"]) -> Any:
        """Return the body that the parameters x (n,) represent, or for several bodies a dict of
        name → body.
        """
        parts = split_numbers(self.charts, x[: self.index.bodies])
        bodies = []
        for chart, part in zip(self.charts, parts, strict=True):
            body = chart.body(part)
            if chart.scale is not None and isinstance(body, Inertia):
                # Inside a fit bodies have no such mark, with which a torque is refused.
                body = Inertia(body.tensor, chart.scale)
            bodies.append(body)
        if self.body_indices is None:
            return bodies[0]
        return dict(zip(dict.fromkeys(self.body_names), bodies, strict=True))

    def scenes(self, x: Float[Array, " n"]) -> Any:
        """Return the scene (body, torques, sensors, initial state) of each recording at the
        parameters x (n,), with a leading axis of recordings; of several kinds a dict by kind.
        """
        return scenes_of(self, checked_x(self, x))

    def values(self, x: Float[Array, " n"]) -> dict[str, Array]:
        """Return the values of all `Free`s at the parameters x (n,), as a dict of name → array,
        in their units.

        The shape is (R, …) if each recording has a value, and (groups, …) if each group of
        recordings has a value. For a `Free` named "drag" with a `spread` the shared value is under
        "drag", and the values of the R recordings are under "drag, own".
        """
        return values_of(self, checked_x(self, x))

    def motion(self, x: Float[Array, " n"]) -> Any:
        """Return the states at the times of the recording for the parameters x (n,), with a
        leading time axis.

        For several recordings an axis of recordings comes before the time axis; of several kinds
        the result is a dict by kind.
        """
        x = checked_x(self, x)
        if self.parts:
            return {part.name: part.model.motion(part.take(x)) for part in self.parts}

        def motion_of_recording(row: Array, record: Recording, *others: PyTree) -> Any:
            scene = scene_at(self, row, record, *others)
            return motion_of(motion_in(self, scene, record).states)

        states = map_recordings(motion_of_recording, self, self.index.rows(x))
        return stacking.pick(states, 0) if self.count == 1 else states

    def errors(self, x: Float[Array, " n"]) -> tuple[Float[Array, "*records times _"], ...]:
        """Return reading minus prediction for each sensor at the parameters x, in the sensor's
        unit.

        The difference is zero for a masked reading.
        """
        x = checked_x(self, x)
        out = all_errors(self, x)
        return tuple(e[0] for e in out) if self.count == 1 else out


def unpack_at(model: Model, x: Float[Array, " n"]) -> Unpacked:
    """Return what `Model.unpack` returns, without a check of x."""
    if model.parts:
        starts = {part.name: unpack_at(part.model, part.take(x)).state0 for part in model.parts}
        return Unpacked(x, model.bodies(x), starts, values_of(model, x))
    starts = jax.vmap(ReferenceStates.initial)(model.reference, x[model.index.start])
    state0 = stacking.pick(starts, 0) if model.count == 1 else starts
    return Unpacked(x, model.bodies(x), state0, values_of(model, x))


@eqx.filter_jit
def unpack_jacobian(model: Model, x: Float[Array, " n"]) -> FirstOrder:
    """Return the quantities that x represents, and their Jacobian."""
    return value_and_jacfwd(lambda x: unpack_at(model, x), x)


def shortened(model: Model) -> Model:
    """Return the model with the first time of each recording only, as NumPy arrays.

    What depends on no reading is then compiled once, not again for recordings of another length.
    """

    def first_time(records: Recording) -> Recording:
        records = jax.tree.map(lambda a: np.asarray(a) if eqx.is_array(a) else a, records)
        return stacking.take_rows(records, 1, axis=1)

    kinds = stacking.kinds_of(model)
    return stacking.with_records(model, [first_time(one.records) for one in kinds])


def parts_of(model: Model) -> tuple[Part, ...]:
    """Return the parts of a `model`: one for each kind of recordings."""
    return model.parts or (Part("", model, None, 0, 0),)


def part_of_sensor(model: Model, index: int) -> Part:
    """Return the part of a `model` with the sensor of this `index` among all."""
    return next(part for part in parts_of(model) if index < part.sensors_slice.stop)


def padded_arrays(model: Model, arrays: Sequence[Array | np.ndarray]) -> tuple[Any, ...]:
    """Return the arrays (R, T, k, …) of each sensor, zero in the places of other kinds."""
    if not model.parts:
        return tuple(arrays)
    (count, times), columns = model.records.t.shape, model.index.places.shape[1]
    out, xp = [], np if _checks.is_known(arrays) else jnp
    for part in model.parts:
        for one in arrays[part.sensors_slice]:
            ends = (count, times, one.shape[2], columns)[: one.ndim]
            before = (part.first, 0, 0, 0)[: one.ndim]
            widths = [(b, e - b - n) for b, e, n in zip(before, ends, one.shape, strict=True)]
            out.append(jnp.asarray(xp.pad(one, widths)))
    return tuple(out)


def scenes_of(model: Model, x: Float[Array, " n"]) -> Any:
    """Return what `Model.scenes` returns, without a check of x."""
    if model.parts:
        return {part.name: scenes_of(part.model, part.take(x)) for part in model.parts}
    return eqx.filter_vmap(lambda row, *rest: scene_at(model, row, *rest))(
        model.index.rows(x), model.records, model.reference, model.body_indices
    )


def values_of(model: Model, x: Float[Array, " n"]) -> dict[str, Array]:
    """Return what `Model.values` returns, without a check of x."""
    if model.parts:
        each = (values_of(part.model, part.take(x)) for part in model.parts)
        return {name: value for values in each for name, value in values.items()}
    rows, out = model.index.rows(x), {}
    leaves = dict(jax.tree.leaves_with_path(starting_scene(model, model.records)))
    for slot in model.slots:
        of_each = slot.path[0].name == "sensors"
        leaf = entries_at(leaves[split_path(slot.path).leaf], slot.path, int(of_each))
        start = leaf if of_each else jnp.broadcast_to(leaf, (model.count, *leaf.shape))
        steps = rows[:, slot.columns].reshape(model.count, *slot.shape)
        own = slot.moved(start, steps)
        if slot.shared is None:
            out[slot.name] = own
            continue
        first: Any = np.zeros(1, int)
        if slot.groups is not None:
            groups = jnp.arange(len(slot.labels), dtype=slot.groups.dtype)
            first = jnp.argmax(slot.groups[None, :] == groups[:, None], axis=1)
        value = slot.moved(start[first], x[slot.shared])
        out[slot.name] = value[0] if slot.groups is None else value
        if slot.spread is not None:
            out[f"{slot.name}, own"] = own
    return out


def require_one_kind(model: Model, name: str) -> None:
    """Raise `ValueError` for a `model` of several kinds of recordings, called `name`."""
    if model.parts:
        kinds = ", ".join(repr(part.name) for part in model.parts)
        raise ValueError(
            f"{name}: wanted a model of one kind of recordings, got several: {kinds}; give one"
        )


def require_single(model: PyTree) -> Model:
    """Return `model`, after a check that it is a single `Model`, not a batch of models."""
    _checks.require_instance(model, Model, "model")
    records, rate = model.records, model.reference.rate
    shapes = {records.t.shape, *(reading.mask.shape for reading in records.readings)}
    if len(shapes) > 1 or records.t.ndim != 2 or rate.shape != records.t.shape[:1]:
        raise ValueError(
            "model: wanted a single model, as Model(recording, …) makes it, got times and masks of "
            f"shapes {sorted(shapes)}; give several models one by one"
        )
    _checks.numeric_array(records.t, "model")
    if _checks.is_known(rate):
        _checks.require_finite(rate, "model: its typical rate")
    return model


def checked_x(model: Model, x: NumbersLike) -> Float[Array, " n"]:
    """Return the parameters x of a `model` as an array of right shape and finite numbers."""
    require_single(model)
    hint = "model.start(body) makes them"
    numbers = _checks.numeric_array(x, "x")
    if numbers.ndim == 1 and numbers.size > model.size:
        hint += "; the x of a LogDensity, such as refit(density).x, goes with density.model"
    if numbers.shape != (model.size,):
        raise ValueError(
            f"x: wanted the {model.size} parameters of this model, got shape {numbers.shape}; "
            f"{hint}"
        )
    if numbers.dtype != model.records.t.dtype:
        raise TypeError(
            f"x: wanted {model.records.t.dtype}, as the recordings have, got {numbers.dtype}"
        )
    if _checks.is_known(numbers):
        _checks.require_finite(numbers, "x")
    return numbers


def late_delays(model: Model, x: Float[Array, " n"]) -> list[str]:
    """Return a text for each delay at x that needs samples outside of the windows of a `model`."""
    if model.clusters is None or not delays_of(model.torque):
        return []
    t, rows = np.asarray(model.records.t)[0], max(len(a[0]) for a in model.records.inputs.values())
    step = float(t[1] - t[0])
    known, length = (rows - t.size) * step, (t.size - 1) * step
    torque = eqx.filter_jit(scenes_of)(model, x).torque
    return outside_delays(torque, known, length)


def _chart_vector(chart: AbstractBodyChart, body: Body | None) -> Float[Array, " chart"]:
    """Return the parameters of a `body` in a `chart`, or zeros for `None`."""
    if body is None:
        # NumPy makes the zeros, since JAX would compile a program for each shape.
        return jnp.asarray(np.zeros(chart.size, jnp.result_type(float)))
    one = validation.require_single_body(body, (Inertia, MassProperties), "body")
    if _checks.is_known(one):
        jax.tree.map(lambda leaf: _checks.require_finite(leaf, "body"), one)
    vector = eqx.filter_jit(chart.vector)(one)
    if _checks.is_known(vector):
        _checks.error_if(
            vector,
            not np.isfinite(vector).all(),
            f"body: {type(chart).__name__} has no finite numbers for it; wanted principal "
            "moments above zero, the largest below the sum of the others",
        )
    return vector


class Motion(NamedTuple):
    """Hold the states at the times of a recording, and the torque with its inputs."""

    # The states have a leading time axis.
    states: Any
    torque: Law | None


def starting_scene(model: Model, record: Recording) -> Scene:
    """Return the scene of a recording at the starting values, without body and initial state."""
    return Scene(None, model.torque, model.process, record.sensors, None, model.beside)


def scene_at(
    model: Model, row: Row, record: Recording, reference: ReferenceStates, body_index: BodyIndex
) -> Scene:
    """Return the scene of one recording at its parameters, which its `row` holds."""
    scene, paths = starting_scene(model, record), [slot.path for slot in model.slots]
    values = []
    for slot, value in zip(model.slots, leaves_at(scene, paths), strict=True):
        moved = slot.moved(value, row[slot.columns].reshape(slot.shape))
        values.append(moved.astype(value.dtype))
    scene = with_leaves(scene, paths, values)
    body = body_at(model.charts, row, body_index)
    start = reference.initial(row[model.index.first :])
    return Scene(body, scene.torque, scene.process, scene.sensors, start, scene.beside)


def motion_in(model: Model, scene: Scene, record: Recording) -> Motion:
    """Return the states at the times of a recording, and the torque that reads its inputs."""
    assert scene.body is not None and scene.start is not None
    body: Any = needed_body(scene.body, model.state_kind)
    start, ts, torque = scene.start, record.t, bound_torque(scene, record)
    if isinstance(model.integrator, HeldSteps) and scene.torque is not None:
        samples = {n: rows for n, rows in record.inputs.items() if not callable(rows)}
        unbound = {n: Input(n) if n in samples else rows for n, rows in record.inputs.items()}
        driven = bind(scene.torque, unbound)
        return Motion(model.integrator.driven_states(body, start, ts, driven, samples), torque)
    known = known_motion(body, start, ts, torque)
    if known is not None:  # no integrator is needed
        return Motion(known(ts), torque)
    assert model.integrator is not None and torque is not None
    return Motion(model.integrator.states(body, start, ts, torque), torque)


def bound_torque(scene: Scene, record: Recording) -> Law | None:
    return bind(scene.torque, input_functions(record))


def sensor_errors(
    model: Model,
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
    model: Model, scene: Scene, record: Recording, delay: Array | None = None
) -> tuple[Array, ...]:
    """Return the errors of each sensor in a `scene` of a recording, as `sensor_errors` does."""
    states, torque = motion_in(model, scene, record)
    assert scene.body is not None and scene.start is not None
    out, motion = [], (scene.body, torque, record.t, scene.start, states)
    for reading, sensor in zip(record.readings, scene.sensors, strict=True):
        errors = errors_along(sensor, reading.values, sensor_inputs(sensor, *motion, delay))
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out)


def map_recordings(function: Callable[..., PyTree], model: Model, *arguments: PyTree) -> Any:
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


def all_errors(model: Model, x: Float[Array, " n"]) -> tuple[Array, ...]:
    """Return the errors of each sensor of a `model` in the sensor's unit, reading minus prediction.

    Derivatives are computed as by `map_rows`.
    """
    if model.parts:
        each = [all_errors(part.model, part.take(x)) for part in model.parts]
        return padded_arrays(model, [error for errors in each for error in errors])
    return map_rows(model.index.rows(x), model, sensor_errors)


@eqx.filter_custom_jvp
def map_rows(
    rows: Float[Array, "records columns"], model: Model, function: Callable[..., PyTree]
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
            "model: wanted derivatives in the parameters x alone, not in the numbers of the "
            "model; make one a parameter by a Free(where, name)"
        )
    out, slopes = _row_jacobians(model, rows, function)
    along = jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, step), slopes)
    return match_batch_axes(out, rows), along


def error_jacobians(
    model: Model, x: Float[Array, " n"], function: Callable[..., PyTree] = sensor_errors
) -> FirstOrder:
    """Return the value of `function` for each recording, and its Jacobian with respect to the row.

    The last axis (m) of the Jacobian is that of `model.index.places`.
    """
    if model.parts:
        each = [error_jacobians(part.model, part.take(x), function) for part in model.parts]
        values, slopes = (
            [one for some in part for one in some] for part in zip(*each, strict=True)
        )
        return FirstOrder(padded_arrays(model, values), padded_arrays(model, slopes))
    out, slopes = _row_jacobians(model, model.index.rows(x), function)
    columns = jnp.asarray(model.index.columns, jnp.int32)
    if columns.size > model.index.width:
        slopes = jax.tree.map(lambda block: block[..., columns], slopes)
    return FirstOrder(out, slopes)


def _row_jacobians(
    model: Model, rows: Float[Array, "records columns"], function: Callable[..., PyTree[Array]]
) -> FirstOrder:
    """Return the value of a `function` for `map_rows`, and its Jacobian in the rows."""

    def linear(row: Row, *rest: PyTree) -> FirstOrder:
        # Forward mode is cheaper than reverse mode, to compile and to run, for a dozen numbers and
        # one long loop over time.
        return value_and_jacfwd(lambda row: function(model, row, *rest), row)

    return map_recordings(linear, model, rows)


@eqx.filter_jit
def error_slopes_by_delay(model: Model, x: Float[Array, " n"]) -> tuple[Float[Array, "..."], ...]:
    """Return the derivative of each sensor's errors by a delay of its clock, per second."""

    def derivative_of_recording(row: Row, *rest: PyTree) -> Any:
        now = jnp.zeros((), model.records.t.dtype)
        return jax.jvp(lambda s: sensor_errors(model, row, *rest, delay=s), (now,), (now + 1,))[1]

    return map_recordings(derivative_of_recording, model, model.index.rows(x))
