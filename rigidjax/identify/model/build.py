"""Check the arguments of a `Model`, and build its fields."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.data import stacking
from rigidjax.identify.data.full_scale import with_limits
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import ReferenceStates, references
from rigidjax.identify.data.windows import (
    Windows,
    outside_delays,
    require_windows,
    window_starts,
)
from rigidjax.identify.model.charts import AbstractBodyChart, Charts, body_places, has_mass
from rigidjax.identify.model.free import (
    Free,
    Slot,
    added_slots,
    checked_labels,
    group_recordings,
)
from rigidjax.identify.model.index import build_index
from rigidjax.identify.model.predict import AbstractIntegrator, HeldSteps, integrator_for
from rigidjax.identify.model.priors import AbstractLoss, Entropic
from rigidjax.identify.model.scene import Scene, require_known_torque, require_unknown_torque
from rigidjax.identify.model.walks import find_drifts
from rigidjax.identify.sensors import AbstractSensor
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.manifold import dimension
from rigidjax.motion.suspension import AbstractSuspension, Law
from rigidjax.motion.torques import Carried
from rigidjax.motion.torques.base import require_torque
from rigidjax.motion.torques.composite import parts_of
from rigidjax.motion.torques.inputs import input_names_of

# In one integration step of a Kalman filter the body turns by at most this angle, rad. For this
# angle the error of the classical Runge–Kutta method of order 4 is 5e-8 of the angle.
TURN_OF_A_FILTER_STEP = 0.05
# Times count as evenly spaced if no step differs from the first step by more than this fraction of
# the first step.
EVEN = 1e-3


def fields_of_model(
    recording: Any, chart: Any, *, free: Any, noise_each: Any, stretches: int, **parts: Any
) -> dict[str, Any]:
    """Return the values of all fields of a `Model` by name, from its arguments."""
    torque, process = parts["torque"], parts["process"]
    charts, names, recordings = _members(recording, chart)
    free = (free,) if isinstance(free, str) else free
    wanted = "a sequence of Free(where, name)"
    _checks.require_instance(free, Sequence, "free", requirement=wanted)
    kinds = {"loss": AbstractLoss, "prior": Entropic, "integrator": AbstractIntegrator}
    for name, kind in kinds.items():
        if parts[name] is not None:
            _checks.require_instance(parts[name], kind, name)
    if isinstance(torque, AbstractSuspension):
        if process is not None or parts["walks"]:
            raise ValueError(
                "process, walks: wanted none for a body on a suspension, which a filter does not "
                "follow; give the suspension friction, or a torque"
            )
    elif torque is not None:
        require_torque(torque)
        require_known_torque(torque)
    if process is not None:
        require_unknown_torque(process)
    if isinstance(recordings, Windows):
        data = _windowed_data(recordings, charts, stretches, **parts)
    else:
        data = _recorded_data(recordings, charts, **parts)
    indices = None
    if names[0]:
        order = list(dict.fromkeys(names))
        indices = jnp.asarray([order.index(name) for name in names], jnp.int32)
        if parts["prior"] is not None:
            raise ValueError("Model: a prior is about one body, got several; give None")
    apart = checked_labels(noise_each, "noise_each")
    if isinstance(apart, bool):
        apart = tuple(range(len(names))) if apart else ("",) * len(names)
    numbers = (one.where for one in free if isinstance(one, Free))
    beside = tuple(where for where in numbers if not callable(where))
    scene = Scene(None, torque, process, data.sensors, None, beside)
    walks, slots = find_drifts(parts["walks"], scene), added_slots(free, scene, names)
    taken = {"Ωx", "Ωy", "Ωz", "angle", "rate"}.union(
        *((*one.log_names, *one.plain_names) for one in charts)
    )
    for slot in slots:
        if slot.name in taken:
            words = "a quantity of the body has this name; give another"
            raise ValueError(f"Free {slot.name!r}: {words}")
    bodies = body_places(charts, indices, len(names))
    index, slots = build_index(bodies, slots, data.start_size)
    # A model without a random torque or drift needs no Kalman filter, and not the number of the
    # filter's steps. The number would only force a new compilation for a recording whose longest
    # interval between times is longer or shorter.
    filtered = process is not None or walks
    return parts | {
        "parts": (),
        "records": data.records,
        "counts": data.counts,
        "charts": charts,
        "body_names": names,
        "body_indices": indices,
        "walks": walks,
        "beside": beside,
        "slots": slots,
        "index": index,
        "noise_groups": group_recordings(apart, names, "noise_each").indices,
        "start_weight": data.start_weight,
        "clusters": data.clusters,
        "integrator": data.integrator,
        "state_kind": data.state_kind,
        "filter_steps": interval_steps(data.records, data.reference) if filtered else 1,
        "reference": data.reference,
    }


class Extended(NamedTuple):
    """Hold a model with further slots, and where the parameters of the model before are in it."""

    model: Any
    places: Int[np.ndarray, " n"]


def extended(model: Any, slots: Sequence[Slot]) -> Extended:
    """Return the `model` with the parameters of further `slots`.

    They come before the parameters of one recording alone, which get other indices.
    """
    bodies = body_places(model.charts, model.body_indices, model.count)
    index, placed = build_index(bodies, [*model.slots, *slots], model.index.start.shape[1])
    places = np.arange(model.size)
    places[np.asarray(model.index.start)] = np.asarray(index.start)
    for old, new in zip(model.slots, placed, strict=False):
        for before, after in ((old.shared, new.shared), (old.own, new.own)):
            if before is not None:
                places[np.asarray(before)] = np.asarray(after)
    return Extended(dataclasses.replace(model, index=index, slots=placed), places)


class _Members(NamedTuple):
    """Hold all recordings, and the charts of all bodies."""

    charts: Charts
    # The name of the body of each recording, empty if there is only one body.
    names: tuple[str, ...]
    recordings: list[Any] | Windows


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
        rows, names = [], []
        for name, one in chart.items():
            _checks.require_instance(
                one, AbstractBodyChart, "body", requirement="a chart such as Tensor()"
            )
            of_body = recording[name]
            of_body = [of_body] if isinstance(of_body, Recording) else list(of_body)
            if not of_body:
                raise ValueError(f"Model: wanted a recording of {name!r}, got none")
            rows += of_body
            names += [name] * len(of_body)
        if len({has_mass(one) for one in chart.values()}) > 1:
            raise ValueError(
                "body: wanted a mass for all bodies or for none, got "
                + ", ".join(f"{n}: {type(c).__name__}" for n, c in chart.items())
            )
        return _Members(tuple(chart.values()), tuple(names), rows)
    known = isinstance(chart, Inertia | MassProperties)
    hint = "give a known body as Known(body)" if known else ""
    hint = "was () forgotten?" if isinstance(chart, type) else hint
    wanted = "what of the body is free, such as Ratios() or PrincipalRatios()"
    one: Any = _checks.require_instance(
        chart, AbstractBodyChart, "Model", requirement=wanted, hint=hint
    )
    if isinstance(recording, Windows):
        require_windows(recording)
        return _Members((one,), ("",) * recording.count, recording)
    several = isinstance(recording, Sequence) and not isinstance(recording, Recording)
    rows = list(recording) if several else [recording]
    return _Members((one,), ("",) * len(rows), rows)


class _Data(NamedTuple):
    """Hold the fields of a `Model` that come from R recordings, or from R windows of a record."""

    # All recordings as one, whose arrays have a leading axis.
    records: Recording
    # How many sample times each recording has without padding.
    counts: Int[np.ndarray, " records"]
    # Those of one recording.
    sensors: tuple[AbstractSensor, ...]
    state_kind: type
    # The parameters of an initial state are changes of the reference state.
    reference: ReferenceStates
    # The number of parameters of an initial state, 0 if the initial state is known.
    start_size: int
    integrator: AbstractIntegrator | None
    # For windows whose initial states have a prior about the measured states: one over the standard
    # deviation of each parameter of an initial state.
    start_weight: Float[Array, "records n"] | None = None
    # The index of the stretch of each window; `None` for recordings.
    clusters: Int[Array, " records"] | None = None


def _recorded_data(
    recordings: list[Any], charts: Charts, torque: Law | None, integrator: Any, **_: Any
) -> _Data:
    """Return those fields of a `Model` that come from recordings, after checks."""
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
        names, steps = _sampled_inputs(torque, one), np.diff(np.asarray(one.t, float))
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
    carried = isinstance(torque, Carried)
    solved = isinstance(torque, AbstractSuspension) and torque.closed_form
    if _sampled_inputs(torque, recordings[0]):
        integrator = _held_steps(integrator)
    elif integrator is None and torque is not None and not (carried or solved):
        widest = max(float(np.diff(r.t).max()) for r in recordings)
        integrator = chosen_integrator(widest, reference)
    size = 0 if carried else dimension(stacking.pick(reference.state, 0))
    return _Data(records, counts, sensors, state_kind, reference, size, integrator)


def chosen_integrator(widest: float, reference: ReferenceStates) -> AbstractIntegrator:
    """Return an integrator for times that are at most `widest`, s, apart."""
    return integrator_for(1.5 * widest * float(np.max(np.asarray(reference.rate))))


def _windowed_data(
    windows: Windows,
    charts: Charts,
    stretches: int,
    torque: Law | None,
    process: Any,
    integrator: Any,
    **_: Any,
) -> _Data:
    """Return those fields of a `Model` that come from windows, after checks."""
    require_inputs(torque, windows)
    records = windows.records()
    sensors = records.sensors
    state_kind = _state_type(sensors, torque, charts)
    stretches = _checks.integer(stretches, "stretches", 2)
    reference, weight, clusters = window_starts(windows, stretches)
    if not isinstance(windows.starts, state_kind):
        raise TypeError(
            f"windows: wanted measured states of type {state_kind.__name__}, which the torque "
            f"needs, got {type(windows.starts).__name__}"
        )
    if process is not None:
        raise ValueError(
            "process: a filter follows one record from its beginning; give a Recording instead "
            "of windows"
        )
    counts = np.full(windows.count, windows.length + 1, np.int32)
    size = 0 if weight is None else dimension(stacking.pick(reference.state, 0))
    held = _held_steps(integrator)
    return _Data(records, counts, sensors, state_kind, reference, size, held, weight, clusters)


def _held_steps(integrator: AbstractIntegrator | None) -> HeldSteps:
    """Return `HeldSteps`, the only integrator for inputs given as samples; raise `ValueError` if
    `integrator` is neither `None` nor a `HeldSteps`.
    """
    if integrator is not None and not isinstance(integrator, HeldSteps):
        raise ValueError(
            "integrator: samples as inputs are held through one step from each time to the "
            "next; give None, or a function of time such as rigidjax.torques.Linear(t, "
            "samples) as the input"
        )
    return HeldSteps()


def interval_steps(records: Recording, reference: ReferenceStates) -> int:
    """Return how many steps a Kalman filter takes between two successive times of a recording.

    In a step a body at 1.5 times its typical rate turns by at most `TURN_OF_A_FILTER_STEP`.
    """
    widest = np.max(np.diff(np.asarray(records.t), axis=1), initial=0.0)
    turn = 1.5 * float(widest) * float(np.max(np.asarray(reference.rate)))
    # A NaN in a recording gives no number of steps. One step is taken in this case, and later
    # checks refuse the NaN.
    steps = turn / TURN_OF_A_FILTER_STEP
    return math.ceil(steps) if 1.0 < steps < math.inf else 1


def require_inputs(torque: Law | None, windows: Windows) -> None:
    """Raise `ValueError` if `windows` lack an input of the `torque`, or samples for its delays."""
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


def _sampled_inputs(torque: Law | None, recording: Recording) -> list[str]:
    """Return the names of the inputs that the `torque` reads as samples, not as functions."""
    return [name for name in input_names_of(torque) if not callable(recording.inputs[name])]


def _state_type(sensors: Sequence[AbstractSensor], torque: Law | None, charts: Charts) -> type:
    """Return the smallest type of state that the sensors and the torque need.

    `ValueError` is raised if that is `Rigid`, whose equations of motion need the mass, and a chart
    describes an inertia without a mass.
    """
    needed = [sensor.feels for sensor in sensors]
    if torque is not None:
        needed.append(getattr(torque, "feels", HasAttitude))
    movers = [type(sensor).__name__ for sensor in sensors if sensor.feels is HasPose]
    forces = None if isinstance(torque, AbstractSuspension) else torque
    parts = parts_of(forces)
    movers += [type(part).__name__ for part in parts if getattr(part, "feels", None) is HasPose]
    if HasPose in needed or movers:
        for chart in charts:
            if not has_mass(chart):
                pivot = "; of a body on a pivot give Marker(origin=…)" if "Marker" in movers else ""
                raise ValueError(
                    f"Model: {movers[0] if movers else 'the torque'} needs a body that moves, "
                    "whose mass is known or free: wanted Mass(guess) or Known(MassProperties), got "
                    f"{type(chart).__name__}. Without forces take Mass(guess, ['inertia']), or "
                    f"['inertia', 'com']: the motion shows no mass{pivot}"
                )
    if isinstance(torque, AbstractSuspension):
        for chart in charts:
            eqx.filter_eval_shape(
                lambda one: torque.require_body(one.body(jnp.zeros(one.size))), chart
            )
        return Turn
    if HasPose in needed or movers:
        return Rigid
    return Attitude if HasAttitude in needed else Spin
