"""Normal equations; the numbers of one recording alone go out of them by their Schur complement."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Alone(eqx.Module):
    """The part of a normal matrix with numbers that one recording alone has, at the places `at` of
    all: `own` among themselves, `sides` with those in the core.
    """

    own: Float[Array, "records k k"]
    sides: Float[Array, "records k s"]
    at: Int[Array, "records k"]


class Normal(eqx.Module):
    """A normal matrix of n numbers: `core` (s, s) of the first ones, which recordings share, and
    what is `alone`; for `None` all n numbers are in the core.
    """

    core: Float[Array, "s s"]
    alone: Alone | None = None

    @property
    def diagonal(self) -> Float[Array, " n"]:
        """Its diagonal."""
        own = self.alone and jnp.diagonal(self.alone.own, axis1=1, axis2=2)
        return self._joined(jnp.diagonal(self.core), own)

    def plus(self, diagonal: Float[Array, " n"]) -> "Normal":
        """The matrix with these numbers added to its diagonal."""
        shared, own = self._split(diagonal)
        core, alone = self.core + jnp.diag(shared), self.alone
        if alone is None:
            return Normal(core)
        return Normal(core, Alone(alone.own + jax.vmap(jnp.diag)(own), alone.sides, alone.at))

    def wider(self, rows: Float[Array, "m n"]) -> "Normal":
        """The matrix of these residuals, too, that only numbers in the core change."""
        rows = rows[:, : self.core.shape[0]]
        return Normal(self.core + rows.T @ rows, self.alone)

    def scaled(self, unit: Float[Array, " n"]) -> "Normal":
        """The matrix of numbers in these units."""
        shared, own = self._split(unit)
        core, alone = self.core * (shared[:, None] * shared[None, :]), self.alone
        if alone is None:
            return Normal(core)
        rows = own[:, :, None]
        sides = alone.sides * rows * shared[None, None, :]
        return Normal(core, Alone(alone.own * rows * own[:, None, :], sides, alone.at))

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        shared, own = self._split(x)
        first, alone = self.core @ shared, self.alone
        if alone is None:
            return first
        first = first + jnp.einsum("rks,rk->s", alone.sides, own)
        beside = jnp.einsum("rks,s->rk", alone.sides, shared)
        return self._joined(first, jnp.einsum("rkl,rl->rk", alone.own, own) + beside)

    def solve(self, side: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
        """The x with `matrix @ x = side`; NaN unless the matrix is positive definite."""
        alone, count = self.alone, self.core.shape[0]
        if alone is None:
            return _solve(self.core, side)
        shared, own = self._split(side.reshape(side.shape[0], -1))
        taken = jax.vmap(_solve)(alone.own, jnp.concatenate([alone.sides, own], axis=2))
        rest = jnp.einsum("rks,rkt->st", alone.sides, taken)
        first = _solve(self.core - rest[:, :count], shared - rest[:, count:])
        last = taken[:, :, count:] - jnp.einsum("rks,st->rkt", taken[:, :, :count], first)
        return self._joined(first, last).reshape(side.shape)

    def _split(self, x: Array) -> tuple[Array, Array]:
        return (x, x) if self.alone is None else (x[: self.core.shape[0]], x[self.alone.at])

    def _joined(self, shared: Array, own: Array | None) -> Array:
        if self.alone is None:
            return shared
        first, at = shared.shape[0], self.alone.at
        whole = jnp.zeros((first + at.size, *shared.shape[1:]), shared.dtype)
        return whole.at[:first].set(shared).at[at].set(own)


def _solve(matrix: Array, side: Array) -> Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), side)


def normal_of(
    blocks: Sequence[Array], where: Array, size: int, own: np.ndarray | None = None
) -> Normal:
    """Σ JᵀJ of blocks (R, T, j, m), their columns at the places `where` (R, m) of `size` numbers.

    The columns `own` are of one recording alone, and go out of the core; for `None` all are in it.
    """
    count, columns = where.shape
    alone = np.zeros(0, int) if own is None else own
    rest = np.setdiff1d(np.arange(columns), alone)
    squares = jnp.zeros((count, columns, columns), blocks[0].dtype)
    for rows in blocks:
        squares = squares + jnp.einsum("rtki,rtkj->rij", rows, rows)
    # A column of no number has the last place.
    last = size - count * alone.size
    at = jnp.minimum(where[:, rest], last)
    core = jnp.zeros((last + 1, last + 1), squares.dtype)
    core = core.at[at[:, :, None], at[:, None, :]].add(squares[:, rest[:, None], rest])[:-1, :-1]
    if own is None:
        return Normal(core)
    mine = squares[:, own]
    index = jnp.arange(count)[:, None, None], np.arange(own.size)[:, None], at[:, None, :]
    sides = jnp.zeros((count, own.size, last + 1), squares.dtype).at[index].add(mine[:, :, rest])
    return Normal(core, Alone(mine[:, :, own], sides[:, :, :-1], where[:, own]))
