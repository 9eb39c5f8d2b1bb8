"""What is known, what is free, and how far a guess is from the data."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, Scalar
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify import stacking
from rigidjax.identify.bodies import AbstractBodyChart
from rigidjax.identify.free import Free, Slot, find, put
from rigidjax.identify.loss import AbstractLoss
from rigidjax.identify.prior import Entropic
from rigidjax.identify.propagate import (
    AbstractIntegrator,
    free_states,
    integrator_for,
    shifted,
    states_at,
)
from rigidjax.identify.recording import Recording
from rigidjax.identify.reference import Reference, reference_of
from rigidjax.identify.sensors import Moment
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.torques import AbstractForce, Sum, Torque
from rigidjax.motion.torques.base import require_law
from rigidjax.rotation import quaternion
from rigidjax.solve import equations_of_motion


class Own(eqx.Module):
    """The free numbers that belong to one recording, of order one.

    **Fields:** `spin` (3,) the first body rate over the typical rate; `turn` (3,) the rotation
    vector from the reference attitude to the first one (body frame, rad), or `None` where nothing
    feels the attitude; `place`, `speed` (3,) the first position and velocity from the reference, in
    typical lengths and speeds, or `None`; `each` the steps of the `Free`s with one value for each.
    """

    spin: Float[Array, "*records 3"]
    turn: Float[Array, "*records 3"] | None
    place: Float[Array, "*records 3"] | None
    speed: Float[Array, "*records 3"] | None
    each: tuple[Array, ...]


class Parameters(eqx.Module):
    """The free numbers of a fit, all unconstrained and of order one.

    **Fields:** `body` the chart's numbers; `shared` the steps of the `Free`s with one value for
    all; `own` what belongs to each recording, with a leading axis.
    """

    body: Float[Array, " chart"]
    shared: tuple[Array, ...]
    own: Own


class Problem(eqx.Module):
    """A recording or several of one body, and what of the motion behind them is free.

    **Arguments:**

    - `recording`: one `Recording`, or a sequence of them with the same sensors: each has its own
      first state, all share the body.
    - `body`: the chart of the body: `Ratios()` (the full tensor up to scale), `PrincipalRatios()`
      (body axes known to be principal), `Tensor()`, `Principal()` (with the scale), `Mass(guess)`
      (all ten numbers), `Known(body)`.
    - `free`: what else is free, a sequence of `Free(where, name, …)`.
    - `torque`: what turns the body besides its own spin, for the recordings that have none.
    - `loss`: how an outlier counts: `SoftL1()`, `Huber()`, or `None` for plain least squares.
    - `prior`: `Entropic(guess, weight)`, a pull towards a body that is roughly known, or `None`.
    - `integrator`: `FixedSteps(n)` or `Adaptive(rtol, atol)` for a forced motion; `None` chooses by
      how finely it was sampled. A free body is followed by the closed form.

    The motion starts at the first time of each recording. The state climbs only as far as the
    sensors and the torque need: `Spin`, `Attitude`, `Rigid`.

    **Raises:** `TypeError` for arguments of another kind; `ValueError` where they do not fit.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> rj.identify.Problem(record, rj.identify.Ratios()).typical_rate
    Array(1., dtype=float64)
    """

    records: Recording
    counts: tuple[int, ...] = eqx.field(static=True)
    body: AbstractBodyChart
    slots: tuple[Slot, ...]
    loss: AbstractLoss | None
    prior: Entropic | None
    integrator: AbstractIntegrator | None
    rung: type = eqx.field(static=True)
    reference: Reference
    links: "Links | None"

    def __init__(
        self,
        recording: Recording | Sequence[Recording],
        body: AbstractBodyChart,
        *,
        free: Sequence[Free] = (),
        torque: Torque | None = None,
        loss: AbstractLoss | None = None,
        prior: Entropic | None = None,
        integrator: AbstractIntegrator | None = None,
    ):
        recordings = [recording] if isinstance(recording, Recording) else recording
        recordings = list(recordings) if isinstance(recordings, Sequence) else [recordings]
        if not recordings:
            raise ValueError("Problem: wanted at least one Recording, got an empty sequence")
        for item in recordings:
            if not isinstance(item, Recording):
                raise TypeError(f"Problem: wanted a Recording, got {type(item).__name__}")
            lengths = {item.t.shape, *(reading.mask.shape for reading in item.readings)}
            if len(lengths) > 1 or item.t.ndim != 1:
                raise ValueError(
                    "recording: wanted one, as Recording(t, …) makes it, got times and masks of "
                    f"shapes {sorted(lengths)}; of many give a sequence"
                )
        if not isinstance(body, AbstractBodyChart):
            raise TypeError(
                "Problem: wanted what of the body is free, such as Ratios() or PrincipalRatios(), "
                f"got {type(body).__name__}"
            )
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
        self.records, self.counts = stacking.stack(recordings)
        self.body, self.loss, self.prior = body, loss, prior
        self.slots = find(free, recordings[0])
        self.rung = _rung(recordings[0], body)
        self.reference = reference_of(recordings, self.rung)
        if integrator is None and self.records.torque is not None:
            widest = max(float(jnp.max(jnp.diff(r.t))) for r in recordings)
            integrator = integrator_for(widest, 1.5 * float(jnp.max(self.reference.rate)))
        self.integrator = integrator
        self.links = None

    @property
    def count(self) -> int:
        """How many recordings there are."""
        return int(self.records.t.shape[0])

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """The recordings, one by one."""
        return tuple(
            stacking.cut(stacking.one(self.records, index), count)
            for index, count in enumerate(self.counts)
        )

    @property
    def recording(self) -> Recording:
        """The only recording, or the first."""
        return self.recordings[0]

    @property
    def torque(self) -> Torque | None:
        """What turns the body besides its own spin, with a leading axis over recordings."""
        return self.records.torque

    @property
    def typical_rate(self) -> Scalar:
        """The size of the body rate in the first recording, rad/s: the unit of `Own.spin`."""
        return self.reference.rate[0]

    def start(self, body: Inertia | None = None) -> Parameters:
        """The parameters of the recordings as they are given, with this body or a sphere.

        **Raises:** `ValueError` for a body that the chart does not hold.
        """
        if body is not None:
            _checks.single(body, (Inertia, MassProperties), "body")
        matter = Inertia(jnp.eye(3)) if body is None else body
        vector = self.body.vector(matter) if body is not None else jnp.zeros(self.body.size)
        if _checks.known(vector):
            _checks.refuse(
                vector,
                ~jnp.isfinite(vector).all(),
                f"body: {type(self.body).__name__} has no finite numbers for it; wanted principal "
                "moments above zero, the largest below the sum of the others",
            )
        moved = [jnp.zeros(jnp.shape(slot.read(self.recording))) for slot in self.slots]
        shared = tuple(v for v, slot in zip(moved, self.slots, strict=True) if not slot.each)
        each = tuple(
            jnp.zeros((self.count, *v.shape))
            for v, slot in zip(moved, self.slots, strict=True)
            if slot.each
        )
        nothing = jnp.zeros((self.count, 3))
        return Parameters(
            vector,
            shared,
            Own(
                nothing,
                None if self.rung is Spin else nothing,
                nothing if self.rung is Rigid else None,
                nothing if self.rung is Rigid else None,
                each,
            ),
        )

    def unpack(self, parameters: Parameters) -> tuple[Any, Any]:
        """The body and the first state that the parameters stand for.

        With several recordings the states have a leading axis.
        """
        fits(self, parameters)
        body = self.body.body(parameters.body)
        states = jax.vmap(lambda own, ref: first_state(self.rung, own, ref))(
            parameters.own, self.reference
        )
        return body, stacking.one(states, 0) if self.count == 1 else states

    def scenes(self, parameters: Parameters) -> Recording:
        """The recordings with the parameters' values in the slots, with a leading axis."""
        fits(self, parameters)
        return jax.vmap(lambda own, record: filled(self, parameters.shared, own, record))(
            parameters.own, self.records
        )

    def values(self, parameters: Parameters) -> dict[str, Array]:
        """The value of each `Free`, by name, in its unit; (R, …) for those with one for each."""
        scenes = self.scenes(parameters)
        out = {}
        for slot in self.slots:
            value = slot.read(scenes)
            out[slot.name] = value if slot.each else value[0]
        return out

    def motion(self, parameters: Parameters) -> Any:
        """The states at the recording's times, with a leading time axis.

        With several recordings another axis leads.
        """
        fits(self, parameters)

        def of_one(own: Own, record: Recording, ref: Reference) -> Any:
            body = self.body.body(parameters.body)
            return _states(self, body, parameters.shared, own, record, ref)[2]

        states = over_records(of_one, self, parameters.own, self.records, self.reference)
        return stacking.one(states, 0) if self.count == 1 else states

    def errors(self, parameters: Parameters) -> tuple[Float[Array, "*records times _"], ...]:
        """Reading minus prediction for each sensor, in its unit; zero where masked."""
        fits(self, parameters)
        out = all_errors(parameters, self)[0]
        return tuple(e[0] for e in out) if self.count == 1 else out


def one_problem(problem: Any) -> Problem:
    """`problem`, if it is one as its constructor makes it.

    **Raises:** `TypeError` for another kind of thing, `ValueError` for arrays of other shapes.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> one_problem(Problem(record, rj.identify.Ratios())).count
    1
    """
    _checks.instance(problem, Problem, "problem")
    records, rate = problem.records, problem.reference.rate
    shapes = {records.t.shape, *(reading.mask.shape for reading in records.readings)}
    if len(shapes) > 1 or records.t.ndim != 2 or rate.shape != records.t.shape[:1]:
        raise ValueError(
            "problem: wanted one, as Problem(recording, …) makes it, got times and masks of shapes "
            f"{sorted(shapes)}; of many take them one by one"
        )
    if _checks.known(rate):
        _checks.finite(rate, "problem: its typical rate")
    return problem


def fits(problem: Problem, parameters: Parameters) -> Parameters:
    """`parameters`, if they are of this problem.

    **Raises:** `TypeError` for another kind of thing or another dtype, `ValueError` for other
    shapes, and for NaN where it is known.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> problem = Problem(record, rj.identify.Ratios())
    >>> fits(problem, problem.start()).body.shape
    (5,)
    """
    one_problem(problem)
    hint = "problem.start(body) makes them"
    _checks.instance(parameters, Parameters, "parameters", hint=hint)
    own, each = parameters.own, (problem.count, 3)
    sizes = [jnp.shape(slot.read(problem.records))[1:] for slot in problem.slots]
    apart = [slot.each for slot in problem.slots]
    shared = [size for size, alone in zip(sizes, apart, strict=True) if not alone]
    alone = [(problem.count, *size) for size, alone in zip(sizes, apart, strict=True) if alone]
    wanted = {
        "body": [(problem.body.size,)],
        "shared": shared,
        "own.spin": [each],
        "own.turn": [] if problem.rung is Spin else [each],
        "own.place": [each] if problem.rung is Rigid else [],
        "own.speed": [each] if problem.rung is Rigid else [],
        "own.each": alone,
    }
    found = (parameters.body, parameters.shared, own.spin, own.turn, own.place, own.speed, own.each)
    for (name, shapes), part in zip(wanted.items(), found, strict=True):
        numbers = [_checks.numbers(leaf, f"parameters.{name}") for leaf in jax.tree.leaves(part)]
        if [leaf.shape for leaf in numbers] != shapes:
            raise ValueError(
                f"parameters.{name}: wanted arrays of shapes {shapes}, as this problem has, got "
                f"{[leaf.shape for leaf in numbers]}; {hint}"
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


class Links(eqx.Module):
    """That each recording goes on where the one before it ended: the pieces of a long one.

    **Fields:** `on` (R,) one where the recording goes on into the next, else zero; `width` the gap
    between them that counts as one standard deviation, of order-one numbers.
    """

    on: Float[Array, " records"]
    width: Scalar


def first_state(rung: type, own: Own, ref: Reference) -> Any:
    """The first state of one recording."""
    omega = own.spin * ref.rate
    if rung is Spin:
        return Spin(omega)
    assert ref.q is not None and own.turn is not None
    q = quaternion.multiply(ref.q, quaternion.exp(own.turn))
    if rung is Attitude:
        return Attitude(q, omega)
    assert ref.x is not None and ref.v is not None
    assert own.place is not None and own.speed is not None
    x = ref.x + ref.length * own.place
    return Rigid(x, ref.v + ref.length * ref.rate * own.speed, q, omega)


def filled(problem: Problem, shared: tuple, own: Own, record: Recording) -> Recording:
    """One recording with the values of the free numbers in it."""
    of_all, of_each = iter(shared), iter(own.each)
    values = [
        slot.move(slot.read(record), next(of_each if slot.each else of_all))
        for slot in problem.slots
    ]
    return put(record, problem.slots, values)


def _states(
    problem: Problem, body: Any, shared: tuple, own: Own, record: Recording, ref: Reference
) -> tuple[Recording, Any, Any]:
    """One recording with its values filled in, its first state and its states."""
    record = filled(problem, shared, own, record)
    state0 = first_state(problem.rung, own, ref)
    matter = body
    if problem.rung is not Rigid and isinstance(body, MassProperties):
        matter = body.inertia
    states = states_at(problem.integrator, matter, state0, record.t, record.torque)
    return record, state0, states


def errors_of_one(
    problem: Problem, vector: Array, shared: tuple, own: Own, record: Recording, ref: Reference
) -> tuple[tuple[Array, ...], Any]:
    """The errors (T, k) of each sensor in one recording, and the last state."""
    body = problem.body.body(vector)
    record, state0, states = _states(problem, body, shared, own, record, ref)
    matter = (
        body.inertia if isinstance(body, MassProperties) and problem.rung is not Rigid else body
    )
    field = equations_of_motion(matter, state0, record.torque)
    out = []
    for reading in record.readings:
        sensor = reading.sensor
        offset = getattr(sensor, "offset", None)
        seen, times = states, record.t
        if offset is not None:
            times = record.t + offset
            if record.torque is None:
                seen = free_states(body, state0, times - record.t[0])
            else:
                seen = jax.vmap(lambda t, s, by=offset: shifted(field, t, s, by))(record.t, states)

        def error(t: Array, state: Any, value: Array, sensor: Any = sensor) -> Array:
            return sensor.error(Moment(t, state, body, field), value)

        errors = jax.vmap(error)(times, seen, reading.values)
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out), jax.tree.map(lambda leaf: leaf[-1], states)


def _all(parameters: Parameters, problem: Problem) -> tuple[tuple[Array, ...], Any]:
    def of_one(own: Own, record: Recording, ref: Reference) -> Any:
        return errors_of_one(problem, parameters.body, parameters.shared, own, record, ref)

    return over_records(of_one, problem, parameters.own, problem.records, problem.reference)


def over_records(function: Any, problem: Problem, *trees: Any) -> Any:
    """`vmap` over the recordings; a single one is left alone, its loop compiles to less."""
    if problem.count > 1:
        return jax.vmap(function)(*trees)
    out = function(*(stacking.one(tree, 0) for tree in trees))
    return jax.tree.map(lambda leaf: leaf[None], out)


@eqx.filter_custom_jvp
def all_errors(parameters: Parameters, problem: Problem) -> tuple[tuple[Array, ...], Any]:
    """The errors (R, T, k) of each sensor, and the last states (R, …).

    Its derivative is taken recording by recording: the Jacobian has a block for what all share and
    one for what each has of its own, and no zeros are carried through the motion.
    """
    return _all(parameters, problem)


@all_errors.def_jvp
def _all_errors_jvp(primals: Any, tangents: Any) -> Any:
    parameters, problem = primals
    step, beside = tangents
    if jax.tree.leaves(beside):
        raise TypeError(
            "all_errors: only derivatives in the parameters are taken block by block; use "
            "errors_of_one for those in the problem"
        )
    out, blocks = with_blocks(parameters, problem)
    zeros = jax.tree.map(
        lambda p, s: jnp.zeros_like(p) if s is None and p is not None else s,
        parameters,
        step,
        is_leaf=lambda node: node is None,
    )
    return out, along(problem, blocks, zeros)


def along(problem: Problem, blocks: Any, step: Parameters) -> Any:
    """The derivatives of `with_blocks` along a step of all parameters."""

    def flat(tree: Any, axes: int) -> Array:
        leaves = [leaf.reshape(*leaf.shape[:axes], -1) for leaf in jax.tree.leaves(tree)]
        return jnp.concatenate(leaves, axis=-1)

    common = flat((step.body, step.shared), 0)
    common = jnp.broadcast_to(common, (problem.count, common.shape[0]))
    moved = jnp.concatenate([common, flat(step.own, 1)], axis=1)
    return jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, moved), blocks)


def with_blocks(parameters: Parameters, problem: Problem) -> tuple[Any, Any]:
    """The errors and last states, and their derivatives (…, n) in what each recording depends on.

    The n numbers are the body's, the shared ones, then the recording's own, each flattened.
    """

    def of_one(own: Own, record: Recording, ref: Reference) -> Any:
        flat, restore = ravel_pytree((parameters.body, parameters.shared, own))

        def value(vector: Array) -> Any:
            body, shared, mine = restore(vector)
            out = errors_of_one(problem, body, shared, mine, record, ref)
            return out, out

        blocks, out = jax.jacfwd(value, has_aux=True)(flat)
        return out, blocks

    return over_records(of_one, problem, parameters.own, problem.records, problem.reference)


def _with(recording: Recording, torque: Torque) -> Recording:
    if recording.torque is not None:
        raise ValueError(
            "Problem: a recording has a torque of its own; put both in it: Sum(its, this)"
        )
    return eqx.tree_at(lambda r: r.torque, recording, torque, is_leaf=lambda node: node is None)


def _rung(recording: Recording, body: AbstractBodyChart) -> type:
    felt = [reading.sensor.feels for reading in recording.readings]
    law: Any = recording.torque
    if law is not None:
        felt.append(getattr(law, "feels", HasAttitude))
    parts = law.parts if isinstance(law, Sum) else (law,)
    forced = any(isinstance(part, AbstractForce) for part in parts)
    if HasPose in felt or forced:
        sample: Any = eqx.filter_eval_shape(body.body, jnp.zeros(body.size))
        if not isinstance(sample, MassProperties):
            raise ValueError(
                "Problem: a sensor or force needs a body that moves, whose mass is known or free: "
                f"wanted Mass(guess) or Known(MassProperties), got {type(body).__name__}"
            )
        return Rigid
    return Attitude if HasAttitude in felt else Spin
