"""Multiple shooting: a long or chaotic recording in pieces with joined ends."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model.charts import charts_of
from rigidjax.identify.model.free import Own, Parameters
from rigidjax.identify.model.problem import Problem, Rows, one_problem
from rigidjax.motion.manifold import minus
from rigidjax.motion.torques.states import has_states

# The widths of the gaps, in turn: first the pieces are nearly free, at the end they are joined.
WIDTHS = (1.0, 1e-1, 1e-2, 1e-3)


class Links(Rows):
    """Pieces of a long recording: `on` (R,) one if it continues in the next, else zero; `width` the
    standard deviation of the gap, in order-one numbers.
    """

    on: Float[Array, " records"]
    width: Scalar

    def __call__(self, problem: Problem, parameters: Parameters, ends: Any) -> Array:
        # From a piece's end to the next one's start, in typical units; zero at the last.
        starts = jax.vmap(ReferenceStates.moved)(problem.reference, parameters.own)
        following = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0), starts)
        gaps = jax.vmap(minus)(ends, following) / problem.reference.units
        return gaps * self.on[:, None] / self.width


def pieces(problem: Problem, count: int, *, width: float = WIDTHS[-1]) -> Problem:
    """The problem with its recording cut into `count` pieces, each with its own initial state.

    Over a long record one initial state has many local minima; over a short piece it has not. The
    end of each piece is held to the start of the next by a residual of deviation `width`, in
    typical rates and rad. Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_8.

    >>> record = rj.identify.Recording(range(20), (rj.identify.Gyro(), [[1.0, 0, 0]] * 20))
    >>> pieces(rj.identify.Problem(record, rj.identify.Ratios()), 4).count
    4
    """
    one_problem(problem)
    count, width = _checks.whole(count, "count", 2), _checks.positive(width, "width")
    if problem.count != 1:
        raise ValueError(f"pieces: wanted one recording, got {problem.count}")
    record = problem.recording
    if has_states(record.torque):
        raise ValueError(
            "pieces: the torque has states of its own, whose values at the joints are not unknowns "
            "of the problem; fit the recording in one piece, or its windows (identify.fit_windows)"
        )
    size = int(record.t.shape[0])
    if size < 4 * count:
        raise ValueError(
            f"pieces: wanted at least two pieces of four samples, got {count} of {size} samples"
        )
    edges = np.linspace(0, size - 1, count + 1).round().astype(int)
    parts = [
        _piece(record, int(first), int(last), index == count - 1)
        for index, (first, last) in enumerate(itertools.pairwise(edges))
    ]
    cut = Problem(parts, charts_of(problem.body)[0], loss=problem.loss, prior=problem.prior)
    # One typical rate for all pieces, so that a gap has the same unit at every joint.
    rate = jnp.broadcast_to(problem.reference.rate[0], (count,))
    slots = tuple(slot.alone() for slot in problem.slots)
    links = Links(jnp.ones(count).at[-1].set(0.0), jnp.asarray(float(width)))
    return eqx.tree_at(
        lambda p: (p.reference.rate, p.slots, p.integrator, p.rows),
        cut,
        (rate, slots, problem.integrator, links),
        is_leaf=lambda node: node is None,
    )


def joined(problem: Problem, cut: Problem, found: Parameters) -> Parameters:
    """The parameters of the uncut problem, taken from the first piece."""
    first = jax.tree.map(lambda leaf: leaf[:1], found.own)
    spin = first.spin * cut.reference.rate[0] / problem.reference.rate[0]
    shared, each = [], []
    for slot, value in zip(problem.slots, found.shared, strict=True):
        if slot.each:
            each.append(value[None])
            continue
        shared.append(value if slot.groups is None else value[None])
        if slot.spread is not None:
            each.append(jnp.zeros((1, *value.shape)))
    own = Own(first.place, first.speed, first.turn, spin, tuple(each))
    return Parameters(found.body, tuple(shared), own)


def _piece(record: Recording, first: int, last: int, ends: bool) -> Recording:
    """Samples `first` to `last`; the last is only a time: the next piece has its readings."""
    part = stacking.cut(record, last + 1, first)
    if ends:
        return part
    masks = [reading.mask.at[-1].set(False) for reading in part.readings]
    return eqx.tree_at(lambda r: [reading.mask for reading in r.readings], part, masks)
