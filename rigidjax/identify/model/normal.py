"""Solve normal equations after elimination of the numbers that only one recording has (Schur
complement).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class OwnBlocks(eqx.Module):
    """Hold some blocks of a normal matrix of n numbers: the blocks in the rows of the own numbers
    of each recording.

    Each of R recordings has k own numbers, which no other recording has. The core is the s numbers
    that recordings share, so that n = s + R k.

    **Fields:**

    - `own`: (R, k, k) the blocks of the own numbers of each recording.
    - `sides`: (R, k, s) the blocks between the own numbers and the numbers of the core.
    - `at`: (R, k) the indices of the own numbers among the n numbers.
    """

    own: Float[Array, "records k k"]
    sides: Float[Array, "records k s"]
    at: Int[Array, "records k"]


class NormalMatrix(eqx.Module):
    """Hold the normal matrix of a least-squares problem of n numbers, such as JᵀJ with the Jacobian
    J of the residuals.

    **Fields:**

    - `core`: (s, s) the block of the first s numbers, which recordings share.
    - `own_blocks`: the blocks of the other numbers, each of which belongs to one recording alone.
      `None` if there are no other numbers; then s = n.
    """

    core: Float[Array, "s s"]
    own_blocks: OwnBlocks | None = None

    @property
    def diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal (n,) of this normal matrix."""
        own = self.own_blocks and jnp.diagonal(self.own_blocks.own, axis1=1, axis2=2)
        return self._join_shared_and_own(jnp.diagonal(self.core), own)

    def add_diagonal(self, diagonal: Float[Array, " n"]) -> "NormalMatrix":
        """Return this normal matrix with `diagonal` (n,) added to its diagonal."""
        shared, own = self._split_shared_and_own(diagonal)
        core, alone = self.core + jnp.diag(shared), self.own_blocks
        if alone is None:
            return NormalMatrix(core)
        return NormalMatrix(
            core, OwnBlocks(alone.own + jax.vmap(jnp.diag)(own), alone.sides, alone.at)
        )

    def add_residual_rows(self, rows: Float[Array, "m n"]) -> "NormalMatrix":
        """Return the normal matrix of a larger least-squares problem, which has m residuals more
        than the problem of this matrix.

        The `rows` (m, n) are the derivatives of the m further residuals with respect to the n
        numbers. These residuals may depend only on numbers of the core, which are the numbers
        that recordings share.
        """
        rows = rows[:, : self.core.shape[0]]
        return NormalMatrix(self.core + rows.T @ rows, self.own_blocks)

    def scale_rows_and_columns(self, unit: Float[Array, " n"]) -> "NormalMatrix":
        """Return the matrix D M D, where M is this normal matrix and D the diagonal matrix of
        `unit` (n,).

        It is the normal matrix with respect to x / `unit` instead of the numbers x.
        """
        shared, own = self._split_shared_and_own(unit)
        core, alone = self.core * (shared[:, None] * shared[None, :]), self.own_blocks
        if alone is None:
            return NormalMatrix(core)
        rows = own[:, :, None]
        sides = alone.sides * rows * shared[None, None, :]
        return NormalMatrix(core, OwnBlocks(alone.own * rows * own[:, None, :], sides, alone.at))

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        shared, own = self._split_shared_and_own(x)
        first, alone = self.core @ shared, self.own_blocks
        if alone is None:
            return first
        first = first + jnp.einsum("rks,rk->s", alone.sides, own)
        from_core = jnp.einsum("rks,s->rk", alone.sides, shared)
        return self._join_shared_and_own(
            first, jnp.einsum("rkl,rl->rk", alone.own, own) + from_core
        )

    def solve(self, rhs: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
        """Return the solution x of `matrix @ x = rhs`, or NaN unless this matrix is positive
        definite.

        `rhs` (n,) or (n, columns) holds one right-hand side or several; x has the shape of `rhs`.
        """
        alone, count = self.own_blocks, self.core.shape[0]
        if alone is None:
            return _solve_by_cholesky(self.core, rhs)
        shared, own = self._split_shared_and_own(rhs.reshape(rhs.shape[0], -1))
        taken = jax.vmap(_solve_by_cholesky)(alone.own, jnp.concatenate([alone.sides, own], axis=2))
        rest = jnp.einsum("rks,rkt->st", alone.sides, taken)
        first = _solve_by_cholesky(self.core - rest[:, :count], shared - rest[:, count:])
        last = taken[:, :, count:] - jnp.einsum("rks,st->rkt", taken[:, :, :count], first)
        return self._join_shared_and_own(first, last).reshape(rhs.shape)

    def _split_shared_and_own(self, x: Array) -> tuple[Array, Array]:
        """Return two parts of an array x (n, …), which has one entry for each of the n numbers of
        the normal matrix.

        The two parts are the entries (s, …) of the s numbers that recordings share; and the entries
        (R, k, …) of the k numbers that each of R recordings has alone. If no recording has numbers
        alone, both results are the whole of x.
        """
        return (
            (x, x) if self.own_blocks is None else (x[: self.core.shape[0]], x[self.own_blocks.at])
        )

    def _join_shared_and_own(self, shared: Array, own: Array | None) -> Array:
        """Return an array (n, …) with one entry for each of the n numbers of the normal matrix,
        joined from two parts.

        - `shared`: (s, …) the entries of the s numbers that recordings share.
        - `own`: (R, k, …) the entries of the k numbers that each of R recordings has alone. If no
          recording has such numbers, `own` is not read, and the result is `shared`.
        """
        if self.own_blocks is None:
            return shared
        first, at = shared.shape[0], self.own_blocks.at
        whole = jnp.zeros((first + at.size, *shared.shape[1:]), shared.dtype)
        return whole.at[:first].set(shared).at[at].set(own)


def _solve_by_cholesky(matrix: Array, rhs: Array) -> Array:
    """Return the solution x of `matrix @ x = rhs` by Cholesky's decomposition, or NaN unless the
    symmetric `matrix` (n, n) is positive definite.

    `rhs` (n,) or (n, columns) holds one right-hand side or several; x has the shape of `rhs`.
    """
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), rhs)


def normal_matrix_of_jacobians(
    jacobians: Sequence[Array], places: Array, size: int, own_columns: np.ndarray | None = None
) -> NormalMatrix:
    """Return the normal matrix Σ JᵀJ of the Jacobians J (R, T, j, m) of all sensors.

    J holds the derivatives of j residuals at T times with respect to the m numbers of one of R
    recordings.

    **Arguments:**

    - `jacobians`: J of each sensor.
    - `places`: (R, m) the index of each column of J among all numbers; a column that stands for no
      number has the index `size`.
    - `size`: how many numbers there are in all.
    - `own_columns`: the columns of the numbers that one recording has alone; `None` puts all
      numbers into the core, the dense first block of the result.
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
