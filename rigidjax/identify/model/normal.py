"""Solve normal equations from which the numbers of one recording alone are eliminated (Schur)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class OwnBlocks(eqx.Module):
    """Hold the part of a normal matrix for the numbers that belong to one recording alone.

    **Fields:** `own` (R, k, k) the blocks of these numbers; `sides` (R, k, s) the blocks between
    these numbers and those of the core; `at` (R, k) the places of these numbers among all numbers.
    """

    own: Float[Array, "records k k"]
    sides: Float[Array, "records k s"]
    at: Int[Array, "records k"]


class NormalMatrix(eqx.Module):
    """Hold a normal matrix of n numbers.

    **Fields:** `core` (s, s) the block of the first s numbers, which recordings share; `own_blocks`
    the rest, or `None` if all n numbers are in the core.
    """

    core: Float[Array, "s s"]
    own_blocks: OwnBlocks | None = None

    @property
    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of the matrix."""
        own = self.own_blocks and jnp.diagonal(self.own_blocks.own, axis1=1, axis2=2)
        return self._join_rows(jnp.diagonal(self.core), own)

    def add_diagonal(self, diagonal: Float[Array, " n"]) -> "NormalMatrix":
        """Return the matrix with the numbers `diagonal` added to its diagonal."""
        shared, own = self._split_rows(diagonal)
        core, alone = self.core + jnp.diag(shared), self.own_blocks
        if alone is None:
            return NormalMatrix(core)
        return NormalMatrix(
            core, OwnBlocks(alone.own + jax.vmap(jnp.diag)(own), alone.sides, alone.at)
        )

    def with_rows(self, rows: Float[Array, "m n"]) -> "NormalMatrix":
        """Return the matrix with residuals added whose derivatives are `rows`.

        These residuals may depend only on numbers of the core.
        """
        rows = rows[:, : self.core.shape[0]]
        return NormalMatrix(self.core + rows.T @ rows, self.own_blocks)

    def in_units(self, unit: Float[Array, " n"]) -> "NormalMatrix":
        """Return the matrix of the numbers if they are counted in the units `unit`."""
        shared, own = self._split_rows(unit)
        core, alone = self.core * (shared[:, None] * shared[None, :]), self.own_blocks
        if alone is None:
            return NormalMatrix(core)
        rows = own[:, :, None]
        sides = alone.sides * rows * shared[None, None, :]
        return NormalMatrix(core, OwnBlocks(alone.own * rows * own[:, None, :], sides, alone.at))

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        shared, own = self._split_rows(x)
        first, alone = self.core @ shared, self.own_blocks
        if alone is None:
            return first
        first = first + jnp.einsum("rks,rk->s", alone.sides, own)
        from_core = jnp.einsum("rks,s->rk", alone.sides, shared)
        return self._join_rows(first, jnp.einsum("rkl,rl->rk", alone.own, own) + from_core)

    def solve(self, rhs: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
        """Return the x with `matrix @ x = rhs`, or NaN unless the matrix is positive definite."""
        alone, count = self.own_blocks, self.core.shape[0]
        if alone is None:
            return _solve_by_cholesky(self.core, rhs)
        shared, own = self._split_rows(rhs.reshape(rhs.shape[0], -1))
        taken = jax.vmap(_solve_by_cholesky)(alone.own, jnp.concatenate([alone.sides, own], axis=2))
        rest = jnp.einsum("rks,rkt->st", alone.sides, taken)
        first = _solve_by_cholesky(self.core - rest[:, :count], shared - rest[:, count:])
        last = taken[:, :, count:] - jnp.einsum("rks,st->rkt", taken[:, :, :count], first)
        return self._join_rows(first, last).reshape(rhs.shape)

    def _split_rows(self, x: Array) -> tuple[Array, Array]:
        """Return the rows of x (n, …) that belong to the core, and those (R, k, …) that belong to
        one recording alone.
        """
        return (
            (x, x) if self.own_blocks is None else (x[: self.core.shape[0]], x[self.own_blocks.at])
        )

    def _join_rows(self, shared: Array, own: Array | None) -> Array:
        """Return all rows (n, …), from those of the core and those of one recording alone."""
        if self.own_blocks is None:
            return shared
        first, at = shared.shape[0], self.own_blocks.at
        whole = jnp.zeros((first + at.size, *shared.shape[1:]), shared.dtype)
        return whole.at[:first].set(shared).at[at].set(own)


def _solve_by_cholesky(matrix: Array, rhs: Array) -> Array:
    """Solve `matrix x = rhs` by Cholesky's decomposition."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), rhs)


def normal_of(
    blocks: Sequence[Array], places: Array, size: int, own: np.ndarray | None = None
) -> NormalMatrix:
    """Return the normal matrix Σ JᵀJ of the blocks J (R, T, j, m) of all sensors.

    **Arguments:**

    - `blocks`: J of each sensor.
    - `places`: (R, m) the places of their columns among all numbers.
    - `size`: the number of all numbers.
    - `own`: the columns of the numbers that one recording has alone; `None` puts all numbers into
      the core.
    """
    count, columns = places.shape
    alone = np.zeros(0, int) if own is None else own
    rest = np.setdiff1d(np.arange(columns), alone)
    squares = jnp.zeros((count, columns, columns), blocks[0].dtype)
    for rows in blocks:
        # On a CPU a product of matrices takes a fifth of the time of an `einsum` over two axes.
        flat = rows.reshape(count, -1, columns)
        squares = squares + flat.swapaxes(1, 2) @ flat
    # A column without a number goes to an additional last row, which is dropped.
    last = size - count * alone.size
    at = jnp.minimum(places[:, rest], last)
    core = jnp.zeros((last + 1, last + 1), squares.dtype)
    core = core.at[at[:, :, None], at[:, None, :]].add(squares[:, rest[:, None], rest])[:-1, :-1]
    if own is None:
        return NormalMatrix(core)
    mine = squares[:, own]
    index = jnp.arange(count)[:, None, None], np.arange(own.size)[:, None], at[:, None, :]
    sides = jnp.zeros((count, own.size, last + 1), squares.dtype).at[index].add(mine[:, :, rest])
    return NormalMatrix(core, OwnBlocks(mine[:, :, own], sides[:, :, :-1], places[:, own]))
