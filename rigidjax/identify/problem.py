"""A problem: the known and the free numbers, and the errors of a guess."""

import abc
import dataclasses
import operator
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, Scalar
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify import padding
from rigidjax.identify.body_charts import AbstractBodyChart, Bodies, charts_of, has_mass, scaled
from rigidjax.identify.full_scale import with_limits
from rigidjax.identify.loss import AbstractLoss, Entropic
from rigidjax.identify.parameters import (
    Free,
    Own,
    Parameters,
    Slot,
    by_slot,
    find,
    grouped,
    local,
    shares,
)
from rigidjax.identify.propagation import AbstractIntegrator, integrator_for
from rigidjax.identify.recording import Recording
from rigidjax.identify.reference_states import ReferenceStates, first_rates, reference_of
from rigidjax.identify.terms import all_errors, filled, over_records, states_of_one
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import motion_of
from rigidjax.motion.torques.base import AbstractForce, Torque, require_law
from rigidjax.motion.torques.composite import parts_of


class Rows(eqx.Module):
    """Residuals of a fit beside those of readings and priors."""

    @abc.abstractmethod
    def __call__(self, problem: "Problem", parameters: Parameters, ends: Any) -> Array:
        """The residuals, in standard deviations; `ends` the last states of the recordings."""


class Problem(eqx.Module):
    """A recording or several of one body, and the free numbers of their motion.

    **Arguments:**

    - `recording`: one `Recording`, or a sequence of them with the same sensors: each has its own
      initial state, all share the body.
    - `body`: the chart of the body: `Ratios()` (the full tensor up to scale), `PrincipalRatios()`
      (body axes known to be principal), `Tensor()`, `Principal()` (with the scale), `Mass(guess)`
      (all ten numbers), `Known(body)`. For several bodies give recordings and charts by the bodies'
      names, as in
      `Problem({"proof": [a, b], "box": [c]}, {"proof": Known(body), "box": Tensor(1e-3)})`.
    - `free`: what else is free, a sequence of `Free(where, name, …)`: one value for all, for each
      body, group or recording.
    - `torque`: the torque on the body, for the recordings that have none of their own.
    - `loss`: the weight of an outlier: `SoftL1()`, `Huber()`, or `None` for plain least squares.
    - `prior`: `Entropic(guess, weight)`, a prior around a roughly known body, or `None`.
    - `integrator`: `FixedSteps(n)` or `Adaptive(rtol, atol)` for a forced motion; `None` chooses by
      the sampling. `Adaptive()` is quicker if the torque is smooth and the body turns by 0.1 rad or
      more between readings, and slow if the torque reads a noisy log. A free body is followed by
      the closed form.
    - `noise_each`: an estimated noise is one figure for all recordings (`False`), for each
      (`True`), for each body (`"body"`), or for recordings with the same label (a sequence).

    The problem finds channels that were cut off at full scale; their readings there count as "at
    least that much", as with a sensor's `limit`.

    The motion starts at the first time of each recording. Its state is the smallest that sensors
    and torque need: `Spin`, `Attitude`, `Rigid`. **Raises:** `TypeError` for arguments of another
    type; `ValueError` if they do not fit together.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> rj.identify.Problem(record, rj.identify.Ratios()).typical_rate
    Array(1., dtype=float64)
    """

    records: Recording
    counts: Int[np.ndarray, " records"]
    body: AbstractBodyChart | Bodies
    of: tuple[str, ...] = eqx.field(static=True)
    which: Int[Array, " records"] | None
    noise_groups: Int[Array, " records"]
    slots: tuple[Slot, ...]
    loss: AbstractLoss | None
    prior: Entropic | None
    integrator: AbstractIntegrator | None
    rung: type = eqx.field(static=True)
    reference: ReferenceStates
    rows: Rows | None

    def __init__(
        self,
        recording: Recording | Sequence[Recording] | Mapping[str, Recording | Sequence[Recording]],
        body: AbstractBodyChart | Mapping[str, AbstractBodyChart],
        *,
        free: Sequence[Free] = (),
        torque: Torque | None = None,
        loss: AbstractLoss | None = None,
        prior: Entropic | None = None,
        integrator: AbstractIntegrator | None = None,
        noise_each: bool | str | Sequence[Any] = False,
    ):
        recordings, chart, of = _sorted(recording, body)
        _are_recordings(recordings)
        for one in charts_of(chart):
            known = isinstance(one, Inertia | MassProperties)
            hint = "give a known body as Known(body)" if known else ""
            hint = "was () forgotten?" if isinstance(one, type) else hint
            wanted = "what of the body is free, such as Ratios() or PrincipalRatios()"
            _checks.instance(one, AbstractBodyChart, "Problem", wanted=wanted, hint=hint)
        if isinstance(free, str):
            free = (free,)  # pyright: ignore[reportAssignmentType]
        _checks.instance(free, Sequence, "free", wanted="a sequence of Free(where, name)")
        for name, value, kind in (
            ("loss", loss, AbstractLoss),
            ("prior", prior, Entropic),
            ("integrator", integrator, AbstractIntegrator),
        ):
            if value is not None:
                _checks.instance(value, kind, name)
        if torque is not None:
            require_law(torque)
            recordings = [_with(item, torque) for item in recordings]
        recordings = with_limits(recordings)
        self.records, self.counts = padding.stack(recordings)
        self.body, self.loss, self.prior = chart, loss, prior
        self.of, self.which = of, None
        if isinstance(chart, Bodies):
            self.which = jnp.asarray([chart.names.index(name) for name in of], jnp.int32)
            if prior is not None:
                raise ValueError("Problem: a prior is about one body, got several; give None")
        apart = shares(noise_each, "noise_each")
        if isinstance(apart, bool):
            apart = tuple(range(len(of))) if apart else ("",) * len(of)
        self.noise_groups, _ = grouped(apart, of, "noise_each")
        self.slots = find(free, recordings[0], of)
        taken = {name for one in charts_of(chart) for name in (*one.log_names, *one.plain_names)}
        for slot in self.slots:
            if slot.name in taken | {"Ωx", "Ωy", "Ωz"}:
                wanted = "a quantity of the body has this name; give another"
                raise ValueError(f"Free {slot.name!r}: {wanted}")
        self.rung = _rung(recordings[0], chart)
        self.reference = reference_of(recordings, self.rung)
        if integrator is None and self.records.torque is not None:
            widest = max(float(np.diff(r.t).max()) for r in recordings)
            integrator = integrator_for(widest, 1.5 * float(np.max(self.reference.rate)))
        self.integrator = integrator
        self.rows = None

    @property
    def count(self) -> int:
        """The number of recordings."""
        return int(self.records.t.shape[0])

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """The recordings, one by one."""
        return tuple(
            padding.cut(padding.one(self.records, index), count)
            for index, count in enumerate(np.asarray(self.counts).tolist())
        )

    @property
    def recording(self) -> Recording:
        """The only recording, or the first."""
        return self.recordings[0]

    @property
    def torque(self) -> Torque | None:
        """The torque on the body, with a leading axis over recordings."""
        return self.records.torque

    @property
    def typical_rate(self) -> Scalar:
        """The size of the body rate in the first recording, rad/s: the unit of `Own.spin`."""
        return self.reference.rate[0]

    def start(self, body: Any = None, omega: Any = None) -> Parameters:
        """Where a fit may start, or a motion that is planned: this body, this initial rate.

        **Arguments:** `body` an `Inertia` or `MassProperties`, a sphere for `None`; of several
        bodies a dict of those that are known about. `omega` (3,) initial rate, rad/s, body frame,
        of all recordings; for `None` the first readings of a gyro, or the turn between attitudes (0
        where these are traced). What else is free stays as the recordings give it. **Raises:**
        `ValueError` for a body that the chart does not hold, or a wrong shape.
        """
        one_problem(self)
        if isinstance(self.body, Bodies):
            given = dict(body) if isinstance(body, Mapping) else {}
            names, charts = self.body.names, self.body.charts
            if not isinstance(body, Mapping | None) or set(given) - set(names):
                raise ValueError(f"body: wanted bodies by name, of {', '.join(names)}, or None")
            vector = jnp.concatenate(
                [_numbers(chart, given.get(n)) for n, chart in zip(names, charts, strict=True)]
            )
        else:
            vector = _numbers(self.body, body)
        blank, kind = _blank(self), jnp.result_type(float)
        if omega is None:
            rates = first_rates(self.records, self.counts)
        else:
            rates = _checks.floating(omega, (3,), "omega").astype(kind)[None]
        spin = (rates / self.reference.rate[:, None]).astype(kind)
        return eqx.tree_at(lambda p: (p.body, p.own.spin), blank, (vector, spin))

    def unpack(self, parameters: Parameters) -> tuple[Any, Any]:
        """The body and the initial state that the parameters represent.

        With several recordings the states have a leading axis.
        """
        fits(self, parameters)
        body = self.bodies(parameters)
        states = jax.vmap(ReferenceStates.moved)(self.reference, parameters.own)
        return body, padding.one(states, 0) if self.count == 1 else states

    def bodies(self, parameters: Parameters) -> Any:
        """The body that the parameters represent; for several bodies a dict by name."""
        if isinstance(self.body, Bodies):
            return self.body.all(parameters.body)
        return scaled(self.body, parameters.body)

    def scenes(self, parameters: Parameters) -> Recording:
        """The recordings with the parameters' values in the slots, with a leading axis."""
        return _scenes(self, fits(self, parameters))

    def values(self, parameters: Parameters) -> dict[str, Array]:
        """The value of each `Free`, by name, in its unit.

        The shape is (R, …) with one value for each recording, (groups, …) with one for each group.
        A `Free` with a `spread` gives the shared value, and each recording's value under "its name,
        own".
        """
        return values_of(self, fits(self, parameters))

    def motion(self, parameters: Parameters) -> Any:
        """The states at the recording's times, with a leading time axis.

        With several recordings another axis leads.
        """
        fits(self, parameters)

        def of_one(*trees: Any) -> Any:
            return motion_of(states_of_one(self, *trees)[3])

        states = over_records(of_one, self, local(self, parameters))
        return padding.one(states, 0) if self.count == 1 else states

    def errors(self, parameters: Parameters) -> tuple[Float[Array, "*records times _"], ...]:
        """Reading minus prediction for each sensor, in its unit; zero where masked."""
        fits(self, parameters)
        out = all_errors(parameters, self)[0]
        return tuple(e[0] for e in out) if self.count == 1 else out


def _scenes(problem: Problem, parameters: Parameters) -> Recording:
    mine = local(problem, parameters)
    return eqx.filter_vmap(lambda one, record: filled(problem, one, record))(mine, problem.records)


def values_of(problem: Problem, parameters: Parameters) -> dict[str, Array]:
    """`Problem.values` without a check of the parameters."""
    scenes = _scenes(problem, parameters)
    out = {}
    for slot, step, _ in by_slot(problem, parameters):
        value = slot.read(scenes)
        if step is None:
            out[slot.name] = value
            continue
        first: Any = 0
        if slot.groups is not None:
            groups = jnp.arange(len(slot.labels), dtype=slot.groups.dtype)
            first = jnp.argmax(slot.groups[None, :] == groups[:, None], axis=1)
        out[slot.name] = slot.move(slot.read(problem.records)[first], step)
        if slot.spread is not None:
            out[f"{slot.name}, own"] = value
    return out


def one_problem(problem: Any) -> Problem:
    """`problem`, if it is one `Problem`; else `TypeError`, `ValueError`."""
    _checks.instance(problem, Problem, "problem")
    records, rate = problem.records, problem.reference.rate
    shapes = {records.t.shape, *(reading.mask.shape for reading in records.readings)}
    if len(shapes) > 1 or records.t.ndim != 2 or rate.shape != records.t.shape[:1]:
        raise ValueError(
            "problem: wanted one, as Problem(recording, …) makes it, got times and masks of shapes "
            f"{sorted(shapes)}; take many one by one"
        )
    _checks.numbers(records.t, "problem")
    if _checks.known(rate):
        _checks.finite(rate, "problem: its typical rate")
    return problem


def fits(problem: Problem, parameters: Parameters) -> Parameters:
    """`parameters`, if they are of this problem; else `TypeError`, `ValueError`."""
    one_problem(problem)
    hint = "problem.start(body) makes them"
    _checks.instance(parameters, Parameters, "parameters", hint=hint)
    blank = _blank(problem)
    for name in ("body", "shared", *(f"own.{field.name}" for field in dataclasses.fields(Own))):
        wanted, part = (jax.tree.leaves(operator.attrgetter(name)(p)) for p in (blank, parameters))
        numbers = [_checks.numbers(leaf, f"parameters.{name}") for leaf in part]
        found, shapes = ([leaf.shape for leaf in leaves] for leaves in (numbers, wanted))
        if found != shapes:
            raise ValueError(
                f"parameters.{name}: wanted arrays of shapes {shapes}, as this problem has, got "
                f"{found}; {hint}"
            )
        for leaf in numbers:
            if leaf.dtype != problem.records.t.dtype:
                raise TypeError(
                    f"parameters.{name}: wanted {problem.records.t.dtype}, as the recordings have, "
                    f"got {leaf.dtype}"
                )
            if _checks.known(leaf):
                _checks.finite(leaf, f"parameters.{name}")
    return parameters


def _blank(problem: Problem) -> Parameters:
    """Zeros in the shapes of the problem's free numbers."""
    shared, alone = [], []
    for slot in problem.slots:
        size = jnp.shape(slot.read(problem.records))[1:]
        if not slot.each:
            groups = () if slot.groups is None else (len(slot.labels),)
            shared.append(_zeros(*groups, *size))
        if slot.each or slot.spread is not None:
            alone.append(_zeros(problem.count, *size))

    def each(there: bool = True) -> Any:
        return _zeros(problem.count, 3) if there else None

    moves, turns = problem.rung is Rigid, problem.rung is not Spin
    own = Own(each(moves), each(moves), each(turns), each(), tuple(alone))
    return Parameters(_zeros(problem.body.size), tuple(shared), own)


def _sorted(recording: Any, body: Any) -> tuple[list[Recording], Any, tuple[str, ...]]:
    """The recordings in a row, the chart or charts, and the name of each recording's body."""
    if isinstance(recording, Mapping) or isinstance(body, Mapping):
        if not (isinstance(recording, Mapping) and isinstance(body, Mapping)):
            raise TypeError(
                "Problem: of several bodies wanted both recordings and charts by name, got "
                f"{type(recording).__name__} and {type(body).__name__}"
            )
        if set(recording) != set(body) or not body:
            raise ValueError(
                f"Problem: wanted a chart for each body, got recordings of {sorted(recording)} and "
                f"charts of {sorted(body)}"
            )
        for chart in body.values():
            _checks.instance(chart, AbstractBodyChart, "body", wanted="a chart such as Tensor()")
        rows, of = [], []
        for name in body:
            found = recording[name]
            some = [found] if isinstance(found, Recording) else list(found)
            if not some:
                raise ValueError(f"Problem: no recording of {name!r}")
            rows += some
            of += [name] * len(some)
        return rows, Bodies(body), tuple(of)
    if isinstance(recording, Recording):
        return [recording], body, ("",)
    rows = list(recording) if isinstance(recording, Sequence) else [recording]
    return rows, body, ("",) * len(rows)


def _are_recordings(recordings: Sequence[Any]) -> None:
    if not recordings:
        raise ValueError("Problem: wanted at least one Recording, got an empty sequence")
    for item in recordings:
        _checks.instance(item, Recording, "Problem", wanted="a Recording")
        if not _checks.known((item.t, [reading.values for reading in item.readings])):
            raise TypeError(
                "recording: wanted known readings, got traced ones; make the Problem outside "
                "of jax.jit, jax.grad and jax.vmap, and give it to them as an argument"
            )
        lengths = {item.t.shape, *(reading.mask.shape for reading in item.readings)}
        if len(lengths) > 1 or item.t.ndim != 1:
            raise ValueError(
                "recording: wanted one, as Recording(t, …) makes it, got times and masks of "
                f"shapes {sorted(lengths)}; for many give a sequence"
            )
        _checks.numbers(item.t, "recording")


def _numbers(chart: AbstractBodyChart, body: Any) -> Float[Array, " chart"]:
    """The chart's numbers of a guess, or its default start."""
    if body is None:
        return _zeros(chart.size)
    body = validation.single(body, (Inertia, MassProperties), "body")
    if _checks.known(body):
        jax.tree.map(lambda leaf: _checks.finite(leaf, "body"), body)
    vector = eqx.filter_jit(chart.vector)(body)
    if _checks.known(vector):
        _checks.refuse(
            vector,
            not np.isfinite(vector).all(),
            f"body: {type(chart).__name__} has no finite numbers for it; wanted principal "
            "moments above zero, the largest below the sum of the others",
        )
    return vector


def _zeros(*shape: int) -> Array:
    """Zeros by NumPy: JAX compiles a program for each shape."""
    return jnp.asarray(np.zeros(shape, jnp.result_type(float)))


def _with(recording: Recording, torque: Torque) -> Recording:
    if recording.torque is not None:
        raise ValueError(
            "Problem: a recording has a torque of its own; put both in it: Sum(its, this)"
        )
    return eqx.tree_at(lambda r: r.torque, recording, torque, is_leaf=lambda node: node is None)


def _rung(recording: Recording, body: AbstractBodyChart | Bodies) -> type:
    felt = [reading.sensor.feels for reading in recording.readings]
    law: Any = recording.torque
    if law is not None:
        felt.append(getattr(law, "feels", HasAttitude))
    forced = any(isinstance(part, AbstractForce) for part in parts_of(law))
    if HasPose in felt or forced:
        for chart in charts_of(body):
            if not has_mass(chart):
                raise ValueError(
                    "Problem: a sensor or force needs a body that moves, whose mass is known or "
                    "free: wanted Mass(guess) or Known(MassProperties), got "
                    f"{type(chart).__name__}"
                )
        return Rigid
    return Attitude if HasAttitude in felt else Spin
