"""Map the free numbers of a fit to the scene of each recording, by a model."""

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, NumbersLike, Scalar
from rigidjax.body import validation
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.identify.data import stacking
from rigidjax.identify.data.full_scale import with_limits
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import (
    ReferenceStates,
    first_rates,
    references,
)
from rigidjax.identify.data.windows import (
    Windows,
    outside_delays,
    require_windows,
    window_starts,
)
from rigidjax.identify.model.charts import (
    AbstractBodyChart,
    Bodies,
    body_places,
    chart_list,
    has_mass,
    marked_body,
)
from rigidjax.identify.model.first_order import FirstOrder, value_and_jacfwd
from rigidjax.identify.model.free import (
    Free,
    Slot,
    checked_labels,
    entries_at,
    find_slots,
    group_recordings,
    split_path,
)
from rigidjax.identify.model.index import Index, build_index
from rigidjax.identify.model.predict import AbstractIntegrator, HeldSteps, integrator_for
from rigidjax.identify.model.priors import AbstractLoss, Entropic
from rigidjax.identify.model.scene import (
    Process,
    Scene,
    require_known_torque,
    require_unknown_torque,
)
from rigidjax.identify.model.terms import (
    all_errors,
    map_recordings,
    motion_in,
    scene_at,
    starting_scene,
)
from rigidjax.identify.model.walks import Drift, Walk, find_drifts
from rigidjax.identify.sensors import AbstractSensor
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import motion_of
from rigidjax.motion.manifold import dimension
from rigidjax.motion.torques.base import AbstractForce, Torque, require_torque
from rigidjax.motion.torques.composite import parts_of
from rigidjax.motion.torques.inputs import delays_of, input_names_of

# In one integration step of a Kalman filter the body turns by at most this angle, rad. For this
# angle the error of the classical Runge–Kutta method of order 4 is 5e-8 of the angle.
TURN_OF_A_FILTER_STEP = 0.05
# Times count as evenly spaced if no step differs from the first step by more than this fraction of
# the first step.
EVEN = 1e-3


class AbstractPull(eqx.Module):
    """Compute residuals that pull parameters, or quantities that depend on them, towards chosen
    values.

    A fit adds these residuals to the residuals of the readings and priors.
    """

    @abc.abstractmethod
    def __call__(self, model: "Model", x: Float[Array, " n"]) -> Float[Array, " j"]:
        """Return residuals in standard deviations; half the sum of their squares is added to the
        cost.
        """


class Unpacked(eqx.Module):
    """Hold the quantities that the free numbers of a model represent, such as the body and the
    initial state.

    **Fields:**

    - `x`: (n,) the free numbers.
    - `body`: the body; several bodies as a dict by name.
    - `state0`: the initial state; the initial states of several recordings have a leading axis.
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
    """Hold the recordings of one body or of several bodies, and describe by n free numbers x
    everything that their readings depend on.

    **Arguments:**

    - `recording`: one `Recording`, or a sequence of recordings with the same sensors: each
      recording has its own initial state, and all recordings share the body. `Windows` of a record
      of measured states may be given instead: each window is then a short recording whose initial
      state is known, or free about the measured state.
    - `chart`: the chart of the body: `Ratios()` (the full tensor up to scale), `PrincipalRatios()`
      (if the body axes are known to be principal), `Tensor()` or `Principal()` (the full or the
      principal tensor with its scale), `Mass(guess)` (all ten numbers), or `Known(body)`. For
      several bodies give recordings and charts by the names of the bodies, as in `Model({"proof":
      [a, b], "box": [c]}, {"proof": Known(body), "box": Tensor(1e-3)})`.
    - `torque`: the torque on the body in every recording, or `None`. It reads the inputs of a
      recording by name: `rigidjax.torques.Input("speed")`.
    - `process`: an unknown torque as noise, a `RandomTorque`, a `CorrelatedTorque` or a `Sum` of
      such torques. `filter`, `smooth` and `LogDensity` integrate over this torque; `fit` sets it to
      its mean, zero.
    - `walks`: sensor errors that drift, a sequence of `Walk(where, deviation, density)`. `filter`,
      `smooth` and `LogDensity` follow the drift; `fit` takes the errors as constant.
    - `free`: other free numbers, a sequence of `Free(where, name, …)`: one value for all, or one
      for each body, group or recording.
    - `loss`: a robust loss, `SoftL1()` or `Huber()`; `None` for plain least squares.
    - `prior`: `Entropic(guess, weight)`, a prior about a roughly known body, or `None`.
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

    The model finds channels that were cut off at full scale. A reading at full scale then says only
    that the true value is at least this large, as with a sensor's `limit`.

    The motion starts at the first time of each recording. The state of the motion is the smallest
    type of state that sensors and torque need: a `Spin` (body rate), an `Attitude` (attitude and
    rate), or a `Rigid` (with position and velocity as well). **Raises:** `TypeError` for arguments
    of another type; `ValueError` if they do not fit together.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> model = rj.identify.Model(record, rj.identify.Ratios())
    >>> model.size, model.typical_rate  # five numbers of the body, three of the initial rate
    (8, Array(1., dtype=float64))
    """

    records: Recording
    counts: Int[np.ndarray, " records"]
    chart: AbstractBodyChart | Bodies
    body_names: tuple[str, ...] = eqx.field(static=True)
    body_indices: Int[Array, " records"] | None
    torque: Torque | None
    process: Process | None
    walks: tuple[Drift, ...]
    slots: tuple[Slot, ...]
    index: Index
    noise_groups: Int[Array, " records"]
    loss: AbstractLoss | None
    prior: Entropic | None
    pull: AbstractPull | None
    start_weight: Float[Array, "records n"] | None
    clusters: Int[Array, " records"] | None
    integrator: AbstractIntegrator | None
    state_kind: type = eqx.field(static=True)
    filter_steps: int = eqx.field(static=True)
    reference: ReferenceStates

    def __init__(
        self,
        recording: Recording
        | Sequence[Recording]
        | Mapping[str, Recording | Sequence[Recording]]
        | Windows,
        chart: AbstractBodyChart | Mapping[str, AbstractBodyChart],
        *,
        torque: Torque | None = None,
        process: Process | None = None,
        walks: Walk | Sequence[Walk] = (),
        free: Sequence[Free] = (),
        loss: AbstractLoss | None = None,
        prior: Entropic | None = None,
        integrator: AbstractIntegrator | None = None,
        noise_each: bool | str | Sequence[Any] = False,
        stretches: int = 12,
    ):
        windows = recording if isinstance(recording, Windows) else None
        if windows is None:
            recordings, charts, names = _members(recording, chart)
        else:
            require_windows(windows)
            recordings, names = [], ("",) * windows.count
            charts: Any = Bodies(chart) if isinstance(chart, Mapping) else chart
        free = (free,) if isinstance(free, str) else free  # pyright: ignore[reportAssignmentType]
        for one in chart_list(charts):
            known = isinstance(one, Inertia | MassProperties)
            hint = "give a known body as Known(body)" if known else ""
            hint = "was () forgotten?" if isinstance(one, type) else hint
            wanted = "what of the body is free, such as Ratios() or PrincipalRatios()"
            _checks.require_instance(one, AbstractBodyChart, "Model", requirement=wanted, hint=hint)
        wanted = "a sequence of Free(where, name)"
        _checks.require_instance(free, Sequence, "free", requirement=wanted)
        for name, value, kind in (
            ("loss", loss, AbstractLoss),
            ("prior", prior, Entropic),
            ("integrator", integrator, AbstractIntegrator),
        ):
            if value is not None:
                _checks.require_instance(value, kind, name)
        if torque is not None:
            require_torque(torque)
            require_known_torque(torque)
        if process is not None:
            require_unknown_torque(process)
        if windows is None:
            data = _recorded(recordings, torque, charts)
        else:
            data = _windowed(windows, torque, charts, stretches)
        self.records, self.counts, self.reference = data.records, data.counts, data.reference
        self.state_kind = data.state_kind
        self.start_weight, self.clusters = data.start_weight, data.clusters
        self.chart, self.torque, self.process = charts, torque, process
        self.loss, self.prior = loss, prior
        self.body_names, self.body_indices, self.pull = names, None, None
        if isinstance(charts, Bodies):
            self.body_indices = jnp.asarray([charts.names.index(name) for name in names], jnp.int32)
            if prior is not None:
                raise ValueError("Model: a prior is about one body, got several; give None")
        apart = checked_labels(noise_each, "noise_each")
        if isinstance(apart, bool):
            apart = tuple(range(len(names))) if apart else ("",) * len(names)
        self.noise_groups = group_recordings(apart, names, "noise_each").indices
        scene = Scene(None, torque, process, data.sensors, None)
        self.walks = find_drifts(walks, scene)
        slots = find_slots(free, scene, names)
        taken = {"Ωx", "Ωy", "Ωz"}
        for one in chart_list(charts):
            taken |= {*one.log_names, *one.plain_names}
        for slot in slots:
            if slot.name in taken:
                words = "a quantity of the body has this name; give another"
                raise ValueError(f"Free {slot.name!r}: {words}")
        bodies = body_places(charts, self.body_indices, len(names))
        self.index, self.slots = build_index(bodies, charts.size, slots, data.vectors_in_state)
        if windows is not None and process is not None:
            raise ValueError(
                "process: a filter follows one record from its beginning; give a Recording instead "
                "of windows"
            )
        if windows is not None or _sampled(torque, self.records):
            if integrator is not None and not isinstance(integrator, HeldSteps):
                raise ValueError(
                    "integrator: samples as inputs are held through one step from each time to the "
                    "next; give None, or a function of time such as rigidjax.torques.Linear(t, "
                    "samples) as the input"
                )
            integrator = HeldSteps()
        elif integrator is None and torque is not None:
            rate = float(np.max(np.asarray(self.reference.rate)))
            integrator = integrator_for(1.5 * data.widest * rate)
        self.integrator = integrator
        # A model without a random torque or drift needs no Kalman filter, and not the number of the
        # filter's steps. The number would only force a new compilation for a recording whose
        # longest interval between times is longer or shorter.
        filtered = process is not None or self.walks
        self.filter_steps = interval_steps(self) if filtered else 1

    @property
    def size(self) -> int:
        """Return n, how many free numbers this model has."""
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

        The free numbers of the initial rate of this recording are in units of the typical rate.
        """
        return self.reference.rate[0]

    def start(self, body: PyTree = None, omega: NumbersLike | None = None) -> Float[Array, " n"]:
        """Return free numbers (n,) with which a fit of this model may start, or which describe a
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
        if isinstance(self.chart, Bodies):
            by_name = dict(body) if isinstance(body, Mapping) else {}
            names, charts = self.chart.names, self.chart.charts
            if not isinstance(body, Mapping | None) or set(by_name) - set(names):
                raise ValueError(f"body: wanted bodies by name, of {', '.join(names)}, or None")
            vector = jnp.concatenate(
                [
                    _chart_vector(chart, by_name.get(n))
                    for n, chart in zip(names, charts, strict=True)
                ]
            )
        else:
            vector = _chart_vector(self.chart, body)
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
        spin = spin if self.index.start.size else spin[:, :0]
        rest = self.size - vector.size - spin.size
        own = sum(s.own.size for s in self.slots if s.own is not None)
        zeros = xp.zeros(rest - own, kind), xp.zeros(own, kind)
        # `Index` describes the order of the free numbers: first the numbers of the bodies, and of
        # the `Free`s that recordings share; then the initial states, whose rates come last; then
        # the numbers of the `Free`s that one recording has alone.
        parts = [xp.asarray(vector, kind), zeros[0], spin.reshape(-1), zeros[1]]
        return jnp.asarray(xp.concatenate(parts))

    def unpack(self, x: Float[Array, " n"]) -> Unpacked:
        """Return the quantities that the free numbers x (n,) represent: body, initial state, values
        of the `Free`s.

        For several recordings the states have a leading axis.
        """
        x = checked_x(self, x)
        if _checks.is_known((self, x)):
            # Outside of `jit` each operation would be compiled as a program of its own.
            return eqx.filter_jit(unpack_at)(shortened(self), x)
        return unpack_at(self, x)

    def bodies(self, x: Float[Array, " n"]) -> Any:
        """Return the body that the free numbers x (n,) represent, or for several bodies a dict of
        name → body.
        """
        numbers = x[: self.index.bodies]
        if isinstance(self.chart, Bodies):
            return self.chart.by_name(numbers)
        return marked_body(self.chart, numbers)

    def scenes(self, x: Float[Array, " n"]) -> Scene:
        """Return the scene (body, torques, sensors, initial state) of each recording at the free
        numbers x (n,), with a leading axis of recordings.
        """
        return scenes_of(self, checked_x(self, x))

    def values(self, x: Float[Array, " n"]) -> dict[str, Array]:
        """Return the values of all `Free`s at the free numbers x (n,), as a dict of name → array,
        in their units.

        The shape is (R, …) if each recording has a value, and (groups, …) if each group of
        recordings has a value. For a `Free` named "drag" with a `spread` the shared value is under
        "drag", and the values of the R recordings are under "drag, own".
        """
        return values_of(self, checked_x(self, x))

    def motion(self, x: Float[Array, " n"]) -> Any:
        """Return the states at the times of the recording for the free numbers x (n,), with a
        leading time axis.

        For several recordings an axis of recordings comes before the time axis.
        """
        x = checked_x(self, x)

        def motion_of_recording(row: Array, record: Recording, *others: PyTree) -> Any:
            scene = scene_at(self, row, record, *others)
            return motion_of(motion_in(self, scene, record).states)

        states = map_recordings(motion_of_recording, self, self.index.rows(x))
        return stacking.pick(states, 0) if self.count == 1 else states

    def errors(self, x: Float[Array, " n"]) -> tuple[Float[Array, "*records times _"], ...]:
        """Return reading minus prediction for each sensor at the free numbers x, in the sensor's
        unit.

        The difference is zero for a masked reading.
        """
        x = checked_x(self, x)
        out = all_errors(self, x)
        return tuple(e[0] for e in out) if self.count == 1 else out


class _Recorded(NamedTuple):
    """Hold the parts of a `Model` that come from R recordings or windows, which are then treated as
    recordings.
    """

    # All recordings as one, whose arrays have a leading axis.
    records: Recording
    # How many sample times each recording has without padding.
    counts: Int[np.ndarray, " records"]
    sensors: tuple[AbstractSensor, ...]
    state_kind: type
    # The parameters of an initial state are changes of the reference state.
    reference: ReferenceStates
    # For windows whose initial states have a prior about the measured states: one over the standard
    # deviation of each parameter of an initial state.
    start_weight: Float[Array, "records n"] | None
    # The index of the stretch of each window; `None` for recordings.
    clusters: Int[Array, " records"] | None
    # The number of three-vectors of a free initial state, 0 if the initial state is known.
    vectors_in_state: int
    # The longest time between two successive times of a recording, s; 0 for windows.
    widest: float


def _recorded(
    recordings: list[Any], torque: Torque | None, charts: AbstractBodyChart | Bodies
) -> _Recorded:
    """Return the parts of a `Model` that come from recordings, after checks."""
    if not recordings:
        raise ValueError("Model: wanted at least one Recording, got an empty sequence")
    for item in recordings:
        _checks.require_instance(item, Recording, "Model", requirement="a Recording")
        if not _checks.is_known((item.t, [reading.values for reading in item.readings])):
            raise TypeError(
                "recording: wanted known readings, got traced ones; make the Model outside "
                "of jax.jit, jax.grad and jax.vmap, and give it to them as an argument"
            )
        lengths = {item.t.shape, *(reading.mask.shape for reading in item.readings)}
        if len(lengths) > 1 or item.t.ndim != 1:
            raise ValueError(
                "recording: wanted a single recording, as Recording(t, …) makes it, got times and "
                f"masks of shapes {sorted(lengths)}; give several recordings as a sequence"
            )
        _checks.numeric_array(item.t, "recording")
    recordings = with_limits(recordings)
    for number, one in enumerate(recordings):
        missing = [name for name in input_names_of(torque) if name not in one.inputs]
        if missing:
            raise ValueError(
                f"torque: it reads {', '.join(map(repr, missing))}, and recording {number} has "
                f"{', '.join(map(repr, one.inputs)) or 'no inputs'}; give "
                "Recording(…, inputs={name: samples or a function of time})"
            )
    for number, one in enumerate(recordings):
        # Each sample is held over one step, and all steps are equal.
        names, steps = _sampled(torque, one), np.diff(np.asarray(one.t, float))
        if names and not (np.abs(steps - steps[0]) <= EVEN * steps[0]).all():
            raise ValueError(
                f"inputs[{names[0]!r}]: samples are held through even steps, and the times of "
                f"recording {number} have steps from {steps.min():.6g} to {steps.max():.6g} "
                "s; resample them, or give a function of time such as rigidjax.torques.Linear(t, "
                "samples)"
            )
    records, counts = stacking.stack(recordings)
    sensors = recordings[0].sensors
    state_kind = _state_type(sensors, torque, charts)
    # The readings are concrete arrays even if the torque is traced by JAX. The reference states are
    # computed at compile time, so that they are concrete arrays, too.
    with jax.ensure_compile_time_eval():
        reference = references(recordings, state_kind)
    vectors_in_state = dimension(stacking.pick(reference.state, 0)) // 3
    widest = max(float(np.diff(r.t).max()) for r in recordings)
    return _Recorded(
        records, counts, sensors, state_kind, reference, None, None, vectors_in_state, widest
    )


def _windowed(
    windows: Windows, torque: Torque | None, charts: AbstractBodyChart | Bodies, stretches: int
) -> _Recorded:
    """Return the parts of a `Model` that come from windows, after checks."""
    require_inputs(torque, windows)
    records = windows.records()
    sensors, counts = records.sensors, np.full(windows.count, windows.length + 1, np.int32)
    state_kind = _state_type(sensors, torque, charts)
    stretches = _checks.integer(stretches, "stretches", 2)
    reference, weight, clusters = window_starts(windows, stretches)
    if not isinstance(windows.starts, state_kind):
        raise TypeError(
            f"windows: wanted measured states of type {state_kind.__name__}, which the torque "
            f"needs, got {type(windows.starts).__name__}"
        )
    free = weight is not None
    vectors_in_state = dimension(stacking.pick(reference.state, 0)) // 3 if free else 0
    return _Recorded(
        records, counts, sensors, state_kind, reference, weight, clusters, vectors_in_state, 0.0
    )


def unpack_at(model: Model, x: Float[Array, " n"]) -> Unpacked:
    """Return what `Model.unpack` returns, without a check of x."""
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
    records = jax.tree.map(lambda a: np.asarray(a) if eqx.is_array(a) else a, model.records)
    return replaced(model, records=stacking.take_rows(records, 1, axis=1))


def scenes_of(model: Model, x: Float[Array, " n"]) -> Scene:
    """Return what `Model.scenes` returns, without a check of x."""
    return eqx.filter_vmap(lambda row, *rest: scene_at(model, row, *rest))(
        model.index.rows(x), model.records, model.reference, model.body_indices
    )


def values_of(model: Model, x: Float[Array, " n"]) -> dict[str, Array]:
    """Return what `Model.values` returns, without a check of x."""
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


def interval_steps(model: Model) -> int:
    """Return how many steps a Kalman filter takes between two successive times of a recording.

    In a step a body at 1.5 times its typical rate turns by at most `TURN_OF_A_FILTER_STEP`.
    """
    widest = np.max(np.diff(np.asarray(model.records.t), axis=1), initial=0.0)
    turn = 1.5 * float(widest) * float(np.max(np.asarray(model.reference.rate)))
    # A NaN in a recording gives no number of steps. One step is taken in this case, and later
    # checks refuse the NaN.
    steps = turn / TURN_OF_A_FILTER_STEP
    return math.ceil(steps) if 1.0 < steps < math.inf else 1


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
    """Return the parameters x of a `model` as an array, after a check of shape, type and
    finiteness.
    """
    require_single(model)
    hint = "model.start(body) makes them"
    numbers = _checks.numeric_array(x, "x")
    if numbers.ndim == 1 and numbers.size > model.size:
        hint += "; the x of a LogDensity, such as refit(density).x, goes with density.model"
    if numbers.shape != (model.size,):
        raise ValueError(
            f"x: wanted the {model.size} free numbers of this model, got shape {numbers.shape}; "
            f"{hint}"
        )
    if numbers.dtype != model.records.t.dtype:
        raise TypeError(
            f"x: wanted {model.records.t.dtype}, as the recordings have, got {numbers.dtype}"
        )
    if _checks.is_known(numbers):
        _checks.require_finite(numbers, "x")
    return numbers


def replaced(model: Model, **values: Any) -> Model:
    """Return the model with other `values` of some fields, by name, without checks.

    `dataclasses.replace` would call `Model(…)`, and `equinox.tree_at` cannot replace a tuple that
    has no leaves.
    """
    new = object.__new__(Model)
    for field in dataclasses.fields(Model):
        object.__setattr__(new, field.name, values.get(field.name, getattr(model, field.name)))
    return new


def require_inputs(torque: Torque | None, windows: Windows) -> None:
    """Raise `ValueError` if `windows` lack an input that the `torque` reads, or samples for its
    delays.
    """
    missing = [name for name in input_names_of(torque) if name not in windows.inputs]
    if missing:
        have = ", ".join(map(repr, windows.inputs)) or "none"
        raise ValueError(
            f"inputs: the torque reads {', '.join(map(repr, missing))}, got {have}; give "
            "windows(t, states, {name: samples}, …)"
        )
    known, length = windows.before * windows.step, windows.length * windows.step
    if wrong := outside_delays(torque, known, length):
        raise ValueError("; ".join(wrong))


def late_delays(model: Model, x: Float[Array, " n"]) -> list[str]:
    """Return a text for each delay at x that needs samples outside of the windows of a `model`."""
    if model.clusters is None or not delays_of(model.torque):
        return []
    t, rows = np.asarray(model.records.t)[0], max(len(a[0]) for a in model.records.inputs.values())
    step = float(t[1] - t[0])
    known, length = (rows - t.size) * step, (t.size - 1) * step
    torque = eqx.filter_jit(scenes_of)(model, x).torque
    return outside_delays(torque, known, length)


def _sampled(torque: Torque | None, recording: Recording) -> list[str]:
    """Return the names of the inputs that the `torque` reads as samples, not as functions."""
    return [name for name in input_names_of(torque) if not callable(recording.inputs[name])]


class _Members(NamedTuple):
    """Hold all recordings, with the chart of one body or the charts of several."""

    recordings: list[Any]
    charts: Any
    # The name of the body of each recording, empty if there is only one body.
    names: tuple[str, ...]


def _members(recording: Any, chart: Any) -> _Members:
    """Return the recordings, charts and names that the arguments of a `Model` give."""
    if isinstance(recording, Mapping) or isinstance(chart, Mapping):
        if not (isinstance(recording, Mapping) and isinstance(chart, Mapping)):
            raise TypeError(
                "Model: of several bodies wanted both recordings and charts by name, got "
                f"{type(recording).__name__} and {type(chart).__name__}"
            )
        if set(recording) != set(chart) or not chart:
            raise ValueError(
                f"Model: wanted a chart for each body, got recordings of {sorted(recording)} and "
                f"charts of {sorted(chart)}"
            )
        for one in chart.values():
            _checks.require_instance(
                one, AbstractBodyChart, "body", requirement="a chart such as Tensor()"
            )
        rows, names = [], []
        for name in chart:
            of_body = recording[name]
            of_body = [of_body] if isinstance(of_body, Recording) else list(of_body)
            if not of_body:
                raise ValueError(f"Model: wanted a recording of {name!r}, got none")
            rows += of_body
            names += [name] * len(of_body)
        return _Members(rows, Bodies(chart), tuple(names))
    if isinstance(recording, Recording):
        return _Members([recording], chart, ("",))
    rows = list(recording) if isinstance(recording, Sequence) else [recording]
    return _Members(rows, chart, ("",) * len(rows))


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


def _state_type(
    sensors: Sequence[AbstractSensor], torque: Torque | None, charts: AbstractBodyChart | Bodies
) -> type:
    """Return the smallest type of state that the sensors and the torque need.

    `ValueError` is raised if that is `Rigid`, whose equations of motion need the mass, and a chart
    describes an inertia without a mass.
    """
    needed = [sensor.feels for sensor in sensors]
    if torque is not None:
        needed.append(getattr(torque, "feels", HasAttitude))
    movers = [type(sensor).__name__ for sensor in sensors if sensor.feels is HasPose]
    movers += [type(part).__name__ for part in parts_of(torque) if isinstance(part, AbstractForce)]
    if HasPose in needed or movers:
        for chart in chart_list(charts):
            if not has_mass(chart):
                pivot = "; of a body on a pivot give Marker(origin=…)" if "Marker" in movers else ""
                raise ValueError(
                    f"Model: {movers[0] if movers else 'the torque'} needs a body that moves, "
                    "whose mass is known or free: wanted Mass(guess) or Known(MassProperties), got "
                    f"{type(chart).__name__}. Without forces take Mass(guess, ['inertia']), or "
                    f"['inertia', 'com']: the motion shows no mass{pivot}"
                )
        return Rigid
    return Attitude if HasAttitude in needed else Spin
