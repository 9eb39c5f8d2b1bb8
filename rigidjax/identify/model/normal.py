"""Solve normal equations after elimination of the numbers that only one recording has (Schur
complement).

A search solves them at each step by Cholesky, the cheapest way within a compiled program, and its
damping keeps them positive definite. Where ranks are decided, `uncertainty.covariance` takes QR.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class OwnBlocks(eqx.Module):
    """Hold the blocks of a normal matrix in the rows of the k own parameters of each recording."""

    own: Float[Array, "records k k"]
    sides: Float[Array, "records k s"]
    # The places of the own parameters among all parameters.
    at: Int[Array, "records k"]


class NormalMatrix(eqx.Module):
    """Hold the normal matrix JᵀJ of a least-squares problem of n parameters with the Jacobian J.

    The first s parameters, the core, are shared; n = s + R k for R recordings with k own
    parameters.
    """

    core: Float[Array, "s s"]
    # `None` if no recording has own parameters; then s = n.
    own_blocks: OwnBlocks | None = None

    @property
    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of this matrix."""
        own = self.own_blocks and jnp.diagonal(self.own_blocks.own, axis1=1, axis2=2)
        return self._join(jnp.diagonal(self.core), own)

    def add_diagonal(self, diagonal: Float[Array, " n"]) -> "NormalMatrix":
        """Return this matrix with `diagonal` added to its diagonal."""
        shared, own = self._split(diagonal)
        core, alone = self.core + jnp.diag(shared), self.own_blocks
        if alone is None:
            return NormalMatrix(core)
        return NormalMatrix(
            core, OwnBlocks(alone.own + jax.vmap(jnp.diag)(own), alone.sides, alone.at)
        )

    def add_rows(self, rows: Float[Array, "m n"]) -> "NormalMatrix":
        """Return the normal matrix with m more residuals, from their Jacobian `rows`.

        These residuals may depend on the core alone.
        """
        rows = rows[:, : self.core.shape[0]]
        return NormalMatrix(self.core + rows.T @ rows, self.own_blocks)

    def scaled(self, unit: Float[Array, " n"]) -> "NormalMatrix":
        """Return D M D for this matrix M and D = diag(`unit`): the normal matrix of x / `unit`."""
        shared, own = self._split(unit)
        core, alone = self.core * (shared[:, None] * shared[None, :]), self.own_blocks
        if alone is None:
            return NormalMatrix(core)
        rows = own[:, :, None]
        sides = alone.sides * rows * shared[None, None, :]
        return NormalMatrix(core, OwnBlocks(alone.own * rows * own[:, None, :], sides, alone.at))

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        shared, own = self._split(x)
        first, alone = self.core @ shared, self.own_blocks
        if alone is None:
            return first
        first = first + jnp.einsum("rks,rk->s", alone.sides, own)
        from_core = jnp.einsum("rks,s->rk", alone.sides, shared)
        return self._join(first, jnp.einsum("rkl,rl->rk", alone.own, own) + from_core)

    def solve(self, rhs: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
        """Return x of `matrix @ x = rhs`, or NaN unless this matrix is positive definite."""
        alone, count = self.own_blocks, self.core.shape[0]
        if alone is None:
            return _cholesky_solve(self.core, rhs)
        shared, own = self._split(rhs.reshape(rhs.shape[0], -1))
        taken = jax.vmap(_cholesky_solve)(alone.own, jnp.concatenate([alone.sides, own], axis=2))
        rest = jnp.einsum("rks,rkt->st", alone.sides, taken)
        first = _cholesky_solve(self.core - rest[:, :count], shared - rest[:, count:])
        last = taken[:, :, count:] - jnp.einsum("rks,st->rkt", taken[:, :, :count], first)
        return self._join(first, last).reshape(rhs.shape)

    def _split(self, x: Array) -> tuple[Array, Array]:
        """Return the core entries (s, …) of x (n, …), and those (R, k, …) of own parameters.

        Without own parameters both are the whole of x.
        """
        return (
            (x, x) if self.own_blocks is None else (x[: self.core.shape[0]], x[self.own_blocks.at])
        )

    def _join(self, shared: Array, own: Array | None) -> Array:
        """Return the array (n, …) that `_split` splits; without own parameters it is `shared`."""
        if self.own_blocks is None:
            return shared
        first, at = shared.shape[0], self.own_blocks.at
        whole = jnp.zeros((first + at.size, *shared.shape[1:]), shared.dtype)
        return whole.at[:first].set(shared).at[at].set(own)


def _cholesky_solve(
    matrix: Float[Array, "n n"], rhs: Float[Array, "n *columns"]
) -> Float[Array, "n *columns"]:
    """Return the solution x of `matrix @ x = rhs`, or NaN unless `matrix` is positive definite."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), rhs)


def normal_matrix(
    jacobians: Sequence[Float[Array, "records ... m"]],
    places: Int[Array, "records m"],
    size: int,
    own_columns: np.ndarray | None = None,
) -> NormalMatrix:
    """Return the normal matrix Σ JᵀJ of the Jacobians of all sensors.

    The `places` of the columns of J among all parameters are `size` for a column that stands for
    none. `own_columns` are the columns of the parameters that one recording has alone; with `None`
    all parameters are in the core.
    """
    count, columns = places.shape
    alone = np.zeros(0, int) if own_columns is None else own_columns
    rest = np.setdiff1d(np.arange(columns), alone)
    squares = jnp.zeros((count, columns, columns), jacobians[0].dtype)
    for rows in jacobians:
        # The axes of times and residuals are joined to one axis, so that JᵀJ is a product of
        # matrices. On a CPU it takes a fifth of the time of an `einsum` that sums over both axes.
        flat = rows.reshape(count, -1, columns)
        squares = squares + flat.swapaxes(1, 2) @ flat
    # The core, which is the dense block of the shared numbers, gets an additional last row and
    # column. The columns of J that stand for no number are added to this row and column, which are
    # dropped below.
    last = size - count * alone.size
    at = jnp.minimum(places[:, rest], last)
    core = jnp.zeros((last + 1, last + 1), squares.dtype)
    core = core.at[at[:, :, None], at[:, None, :]].add(squares[:, rest[:, None], rest])[:-1, :-1]
    if own_columns is None:
        return NormalMatrix(core)
    mine = squares[:, own_columns]
    index = jnp.arange(count)[:, None, None], np.arange(own_columns.size)[:, None], at[:, None, :]
    sides = jnp.zeros((count, own_columns.size, last + 1), squares.dtype)
    sides = sides.at[index].add(mine[:, :, rest])
    return NormalMatrix(
        core, OwnBlocks(mine[:, :, own_columns], sides[:, :, :-1], places[:, own_columns])
    )
