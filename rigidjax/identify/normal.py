"""Normal equations; the numbers of one recording alone go out of them by their Schur complement."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Normal(eqx.Module):
    """A normal matrix of n numbers: `core` (s, s) of the first ones, which recordings share; `own`
    (R, k, k) of numbers that one recording alone has, at the places `at`, and `sides` (R, k, s) of
    these with the first ones. Without the last three all n numbers are in the core.
    """

    core: Float[Array, "s s"]
    own: Float[Array, "records k k"] | None = None
    sides: Float[Array, "records k s"] | None = None
    at: Int[Array, "records k"] | None = None

    @property
    def diagonal(self) -> Float[Array, " n"]:
        """Its diagonal."""
        own = None if self.own is None else jnp.diagonal(self.own, axis1=1, axis2=2)
        return self._joined(jnp.diagonal(self.core), own)

    def plus(self, diagonal: Float[Array, " n"]) -> "Normal":
        """The matrix with these numbers added to its diagonal."""
        shared, own = self._split(diagonal)
        core = self.core + jnp.diag(shared)
        if self.own is None:
            return Normal(core)
        return Normal(core, self.own + jax.vmap(jnp.diag)(own), self.sides, self.at)

    def wider(self, rows: Float[Array, "m n"]) -> "Normal":
        """The matrix of these residuals, too, that only numbers in the core change."""
        rows = rows[:, : self.core.shape[0]]
        return Normal(self.core + rows.T @ rows, self.own, self.sides, self.at)

    def scaled(self, unit: Float[Array, " n"]) -> "Normal":
        """The matrix of numbers in these units."""
        shared, own = self._split(unit)
        core = self.core * (shared[:, None] * shared[None, :])
        if self.own is None:
            return Normal(core)
        wide = own[:, :, None]
        return Normal(core, self.own * wide * own[:, None, :], self.sides * wide * shared, self.at)

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        shared, own = self._split(x)
        if self.own is None:
            return self.core @ shared
        there = jnp.einsum("rks,s->rk", self.sides, shared)
        back = jnp.einsum("rks,rk->s", self.sides, own)
        return self._joined(
            self.core @ shared + back, jnp.einsum("rkl,rl->rk", self.own, own) + there
        )

    def solve(self, side: Float[Array, " n"]) -> Float[Array, " n"]:
        """The numbers whose product with the matrix is `side`; NaN unless it is positive."""
        shared, own = self._split(side)
        if self.own is None:
            return _positive_solve(self.core, shared)
        both = jnp.concatenate([self.sides, own[:, :, None]], axis=2)
        taken = jax.vmap(_positive_solve)(self.own, both)
        rest = jnp.einsum("rks,rkt->st", self.sides, taken)
        first = _positive_solve(self.core - rest[:, :-1], shared - rest[:, -1])
        return self._joined(first, taken[:, :, -1] - taken[:, :, :-1] @ first)

    def _split(self, x: Array) -> tuple[Array, Array]:
        return (x, x) if self.at is None else (x[: self.core.shape[0]], x[self.at])

    def _joined(self, shared: Array, own: Array | None) -> Array:
        if self.at is None:
            return shared
        whole = jnp.zeros(shared.size + self.at.size, shared.dtype)
        return whole.at[: shared.size].set(shared).at[self.at].set(own)


def _positive_solve(matrix: Array, side: Array) -> Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), side)


def normal_of(
    blocks: Sequence[Array], where: Array, size: int, own: np.ndarray | None = None
) -> Normal:
    """Σ JᵀJ of blocks (R, T, j, m), their columns at the places `where` (R, m) of `size` numbers.

    The columns `own` are of one recording alone, and go out of the core; for `None` all are in it.
    """
    squares = sum(jnp.einsum("rtki,rtkj->rij", rows, rows) for rows in blocks)
    alone = np.zeros(0, int) if own is None else own
    rest = np.setdiff1d(np.arange(where.shape[1]), alone)
    core, shared = size - where.shape[0] * alone.size, where[:, rest]
    # A column of no number has the place `size`.
    shared = jnp.minimum(shared, core)
    total = jnp.zeros((core + 1, core + 1), squares.dtype)
    total = total.at[shared[:, :, None], shared[:, None, :]].add(squares[:, rest[:, None], rest])
    if own is None:
        return Normal(total[:-1, :-1])
    sides = jnp.zeros((where.shape[0], own.size, core + 1), squares.dtype)
    rows, columns = jnp.arange(where.shape[0])[:, None, None], np.arange(own.size)[:, None]
    sides = sides.at[rows, columns, shared[:, None, :]].add(squares[:, own[:, None], rest])
    return Normal(total[:-1, :-1], squares[:, own[:, None], own], sides[:, :, :-1], where[:, own])
