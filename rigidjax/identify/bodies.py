"""Unconstrained numbers ↔ inertia, as a fit needs them. Every point is a real body."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax.body import parameters as charts
from rigidjax.body.inertia import Inertia
from rigidjax.body.symmetric import swap_trace


class AbstractBodyChart(eqx.Module):
    """A chart of bodies: `size` numbers → an `Inertia` of a fixed overall scale, and back."""

    size: eqx.AbstractClassVar[int]
    in_words: eqx.AbstractClassVar[str]

    @abc.abstractmethod
    def inertia(self, vector: Float[Array, " chart"]) -> Inertia:
        """The body of these numbers."""

    @abc.abstractmethod
    def vector(self, body: Inertia) -> Float[Array, " chart"]:
        """The numbers of this body; its overall scale is dropped."""

    @abc.abstractmethod
    def log_ratios(self, body: Inertia) -> Any:
        """Logarithms of the two ratios that are reported (2,)."""

    @property
    @abc.abstractmethod
    def ratio_names(self) -> tuple[str, str]:
        """What the two ratios are called."""


class Ratios(AbstractBodyChart):
    """The whole inertia tensor up to scale: two ratios of moments and the principal axes.

    Five numbers: the log-Cholesky factor of the second moment 𝔖, its scale fixed
    (Rucker and Wensing 2022, IEEE RA-L 7:2771, doi:10.1109/LRA.2022.3144517).

    >>> Ratios().log_ratios(Ratios().inertia(jnp.zeros(5)))
    Array([0., 0.], dtype=float64)
    """

    size: ClassVar[int] = 5
    in_words: ClassVar[str] = "the inertia tensor up to scale"

    def inertia(self, vector: Float[Array, " chart"]) -> Inertia:
        return Inertia(swap_trace(charts.unpack_shape(vector)))

    def vector(self, body: Inertia) -> Float[Array, " chart"]:
        return charts.pack_shape(body.second_moment)

    def log_ratios(self, body: Inertia) -> Any:
        moments = jnp.log(body.moments)
        return moments[:2] - moments[2]

    @property
    def ratio_names(self) -> tuple[str, str]:
        return ("I1/I3", "I2/I3")


class PrincipalRatios(AbstractBodyChart):
    """Two ratios of moments, where the body axes are known to be principal.

    Two numbers: the logarithms of λ1/λ3 and λ2/λ3, the second moments along the axes (notes,
    eqs 72, 76–78), so that every pair of numbers obeys the triangle inequalities.

    >>> PrincipalRatios().inertia(jnp.zeros(2)).tensor[0, 0]
    Array(2., dtype=float64)
    """

    size: ClassVar[int] = 2
    in_words: ClassVar[str] = "two ratios of moments, the body axes being principal"

    def inertia(self, vector: Float[Array, " chart"]) -> Inertia:
        a, b, c = jnp.exp(vector[0]), jnp.exp(vector[1]), jnp.ones((), vector.dtype)
        return Inertia(jnp.diag(jnp.stack([b + c, c + a, a + b])))

    def vector(self, body: Inertia) -> Float[Array, " chart"]:
        s = body.second_moment
        return jnp.log(jnp.stack([s[0, 0], s[1, 1]]) / s[2, 2])

    def log_ratios(self, body: Inertia) -> Any:
        i = body.tensor
        return jnp.log(jnp.stack([i[0, 0], i[1, 1]]) / i[2, 2])

    @property
    def ratio_names(self) -> tuple[str, str]:
        return ("Ix/Iz", "Iy/Iz")
