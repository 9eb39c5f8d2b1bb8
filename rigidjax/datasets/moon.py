"""Provide the position and attitude of the Moon, 1900 to 2199, from JPL's ephemeris DE421.

W. M. Folkner, J. G. Williams, D. H. Boggs, "The planetary and lunar ephemeris DE421", IPN Progress
Report 42-178 (2009). The numbers are read from the package `de421` (`pip install '.[moon]'` in the
clone). World axes are those of the ICRF, body axes the Moon's principal axes; times are barycentric
dynamical time.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks, _show
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import HasAttitude, ScalarLike
from rigidjax.body.inertia import Inertia
from rigidjax.identify.model.charts import AbstractBodyChart
from rigidjax.motion import Attitude
from rigidjax.motion.torques import ChangingInertia, Chebyshev, GravityGradient, Sum, Tide
from rigidjax.motion.torques.base import Torque, evaluate_torque
from rigidjax.rotation import euler
from rigidjax.rotation.linalg3 import cross

CITATION = "Folkner, Williams & Boggs 2009, IPN Progress Report 42-178"
DAY = 86400.0
# The gravitational constant, m³/(kg s²). Masses in kg depend on this value, but no motion does.
_G = 6.6743e-11
# _FIRST is the Julian date of the start of the ephemeris, _BLOCK the length of a block of the
# ephemeris, days, and _BLOCKS the number of blocks.
_FIRST, _BLOCK, _BLOCKS = 2414992.5, 32, 3426
# The Julian year, 28 June 1969, at which DE421's constants give the motion of the Moon and its
# core.
EPOCH = 2000 + (2440400.5 - 2451545.0) / 365.25


class Moon(eqx.Module):
    """Hold the motions of Moon, Earth and Sun over some years, as functions of the time.

    The time is in s since the start of the year `first`. The numbers are those of JPL's ephemeris
    DE421.

    **Arguments:** `first`, `last` Julian years, such as 1970.0 and 1976.0; 2000.0 is the Julian
    date 2451545.0. The tables begin at least ten days before `first` and end at least ten days
    after `last`.

    **Fields:**

    - `earth`, `sun`: Chebyshev tables of the positions of Earth and Sun relative to the Moon, m,
      ICRF.
    - `angles`: a Chebyshev table of the 3-1-3 Euler angles (φ, θ, ψ) of the Moon, rad, body → ICRF.
    - `constants`: the constants of DE421, by name, in the units of DE421 (au, day, km).
    - `first`: the argument `first`.

    **Raises:** `ModuleNotFoundError` without the package `de421`; `ValueError` for years outside of
    1900 to 2199, or not in order.

    >>> Moon(1970.0, 1971.0).earth.coefficients.shape  # doctest: +SKIP
    (104, 3, 13)
    """

    earth: Chebyshev
    sun: Chebyshev
    angles: Chebyshev
    constants: dict[str, float] = eqx.field(static=True)
    first: float = eqx.field(static=True)

    __repr__ = _show.fields_as_text

    def __init__(self, first: float, last: float):
        spec = find_spec("de421")
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(
                "datasets.moon: de421 is missing; in the clone: pip install '.[moon]'", name="de421"
            )
        days = [(_checks.python_float(year, "year") - 2000) * 365.25 + 2451545.0 - _FIRST
                for year in (first, last)]  # fmt: skip
        low, high = int((days[0] - 10) // _BLOCK), int((days[1] + 10) // _BLOCK) + 1
        if not (days[0] < days[1] and 10 <= days[0] and high <= _BLOCKS):
            raise ValueError(f"Moon: wanted years in order in 1900 to 2199, got {first}, {last}")

        def table(name: str, days: int) -> np.ndarray:
            # Return the coefficients (N, 3, k) of three functions on each of N intervals of so many
            # days; longer intervals of the file are divided.
            rows = np.load(Path(spec.origin or "").parent / f"jpl-{name}.npy", mmap_mode="r")
            a_block = len(rows) // _BLOCKS
            return _subdivided(rows[low * a_block : high * a_block], _BLOCK // a_block // days)

        numbers = np.load(Path(spec.origin).parent / "constants.npy")
        self.constants = {name.decode(): float(value) for name, value in numbers}
        # The ephemeris has three positions: the Moon relative to the Earth; the barycentre of Earth
        # and Moon; and the Sun. `share` is the Earth's part of the mass of Earth and Moon: the Moon
        # is at `middle + share * moon`.
        share = self.constants["EMRAT"] / (1 + self.constants["EMRAT"])
        moon, middle, sun = (1e3 * table(name, 4) for name in ("moon", "earthmoon", "sun"))
        sun = np.pad(sun, ((0, 0), (0, 0), (0, moon.shape[2] - sun.shape[2])))
        start = (_BLOCK * low - days[0]) * DAY
        self.earth = Chebyshev(start, 4 * DAY, -moon)
        self.sun = Chebyshev(start, 4 * DAY, sun - middle - share * moon)
        self.angles = Chebyshev(start, 8 * DAY, table("librations", 8))
        self.first = first

    def attitude(self, t: ScalarLike) -> Attitude:
        """Return the attitude and body rate of the Moon at the time `t`, s, since `first`."""
        t = jnp.asarray(t, float)
        angles, rates = jax.jvp(self.angles, (t,), (jnp.ones_like(t),))
        turned = jnp.remainder(angles, 2 * jnp.pi)
        return Attitude(euler.to_quaternion(turned), euler.rates_to_omega(turned, rates))

    def body(
        self, beta: ScalarLike | None = None, gamma: ScalarLike | None = None, *, core: bool = False
    ) -> Inertia:
        """Return the inertia of the Moon, kg m², with the oblateness J2 of DE421.

        **Arguments:**

        - `beta`: β = (C − A)/B for the principal moments A ≤ B ≤ C; `None` for the value of DE421.
        - `gamma`: γ = (B − A)/C; `None` for the value of DE421.
        - `core`: whether a liquid core turns in the mantle; the result is then the inertia of the
          mantle alone, for use with `torque(core=True)`.
        """
        c = self.constants
        b = jnp.asarray(c["LBET"] if beta is None else beta)
        g = jnp.asarray(c["LGAM"] if gamma is None else gamma)
        largest = self._mass * self._radius**2 * c["J2M"] * 2 * (1 + b) / (2 * b - g + b * g)
        ones = jnp.stack([(1 - b * g) / (1 + b), (1 + g) / (1 + b), jnp.ones_like(b)])
        whole = Inertia(largest * jnp.diag(ones))
        return whole - self._core_inertia if core else whole

    def chart(self, *, core: bool = False) -> AbstractBodyChart:
        """Return a chart for a fit: a map from two parameters, for β = (C − A)/B and γ = (B −
        A)/C with the principal moments A ≤ B ≤ C, to the inertia that `body` returns.
        """
        return _BetaGammaChart(self, core)

    def torque(
        self, degree: int = 4, *, tide: bool = False, core: bool = False, figure: bool = False
    ) -> Torque:
        """Return the torque of Earth and Sun on the Moon.

        **Arguments:**

        - `degree`: the highest degree of the Moon's gravity field that the Earth acts on, 2 to 4.
        - `tide`: whether the Earth and the spin deform the Moon.
        - `core`: whether a liquid core turns in the mantle.
        - `figure`: whether the Earth is oblate.

        DE421 gives the core's angular velocity at `EPOCH`. The value at `first`, with which the
        torque begins, is integrated from `EPOCH` while the mantle moves as in the ephemeris.
        **Raises:** `ValueError` for a core in float32 (unless `first` is `EPOCH`): a time of
        decades, in s, has rounding errors of minutes in float32.
        """
        c = self.constants
        rows = []
        for n in range(3, degree + 1):
            pairs = [c[f"{k}{n}{m}M"] for m in range(1, n + 1) for k in "CS" if f"{k}{n}{m}M" in c]
            rows.append(self._mass * self._radius**n * jnp.array([-c[f"J{n}M"], *pairs]))
        earths = [(self._mu_earth, 0.0)]
        if figure:
            # Two negative masses on the z axis, each one Earth radius from the centre on either
            # side of it, give the Earth's J2. The z axis is that of the ICRF; precession turns the
            # Earth's axis away from it by 0.1° in 20 years.
            few, radius = -0.5 * c["J2E"] * self._mu_earth, 1e3 * c["AE"]
            earths = [(self._mu_earth - 2 * few, 0.0), (few, radius), (few, -radius)]

        def moved(z: float) -> Chebyshev:
            shifted = self.earth.coefficients.at[:, 2, 0].add(z)
            return eqx.tree_at(lambda t: t.coefficients, self.earth, shifted)

        law: Any = Sum(
            *(GravityGradient(mu, moved(z), rows) for mu, z in earths),
            GravityGradient(c["GMS"] * self._si_per_au3_day2, self.sun),
        )
        if core:
            rate = jnp.array([c["OMGCX"], c["OMGCY"], c["OMGCZ"]]) / DAY
            friction = c["KVC"] / DAY * self.body().tensor[2, 2]
            law = _LiquidCore(rate, self._core_inertia.tensor, friction, law)
            if self.first != EPOCH:
                if rate.dtype != jnp.float64:
                    raise ValueError(
                        "torque: wanted float64 for a core that is integrated from EPOCH to "
                        f"{self.first}, got {rate.dtype}; set jax.config.update("
                        "'jax_enable_x64', True)"
                    )
                between = Moon(min(self.first, EPOCH), max(self.first, EPOCH))
                ends = [365.25 * DAY * (at - between.first) for at in (EPOCH, self.first)]
                field = _CoreAcceleration(law, between)
                rate = _core_velocity(field, rate, jnp.array(ends))
                law = eqx.tree_at(lambda core: core.state0, law, rate)
        if tide:
            response, turn = c["K2M"] * self._radius**5 / _G, 2 * np.pi / (27.321661 * DAY)
            bulge = Tide(response, c["TAUM"] * DAY, self._mu_earth, self.earth, turn)
            law = ChangingInertia(bulge, law)
        return law

    @property
    def _core_inertia(self) -> Inertia:
        """Return the inertia of the liquid core, kg m².

        The largest moment of the core is a fraction of the Moon's largest moment, and the core is
        flattened. DE421 gives the fraction and the flattening.
        """
        c = self.constants
        share, flat = c["IFAC"] * self.body().tensor[2, 2], 1 - c["COBLAT"]
        return Inertia(share * jnp.diag(jnp.array([flat, flat, 1.0])))

    @property
    def _si_per_au3_day2(self) -> float:
        """Return the number of m³/s² in one au³/day², the unit of the gravitational parameters of
        DE421.
        """
        return (1e3 * self.constants["AU"]) ** 3 / DAY**2

    @property
    def _mu_earth(self) -> float:
        """Return the gravitational parameter of the Earth, m³/s²: the gravitational constant times
        the mass of the Earth.
        """
        c = self.constants
        return self._si_per_au3_day2 * c["GMB"] * c["EMRAT"] / (1 + c["EMRAT"])

    @property
    def _mass(self) -> float:
        """Return the mass of the Moon, kg."""
        return self._mu_earth / self.constants["EMRAT"] / _G

    @property
    def _radius(self) -> float:
        """Return the radius of the Moon, m, to which its gravity field refers."""
        return 1e3 * self.constants["AM"]


class _BetaGammaChart(AbstractBodyChart):
    """Describe the inertia of the Moon (of the mantle alone, with a `core`) by the parameters 1000
    log(β/β*) and 1000 log(γ/γ*), where β = (C − A)/B and γ = (B − A)/C for the principal moments A
    ≤ B ≤ C, and β*, γ* are the values of DE421.
    """

    size: ClassVar[int] = 2
    log_names: ClassVar[tuple[str, ...]] = ("β", "γ")
    moon: Moon
    core: bool = eqx.field(static=True)

    def body(self, vector: Array) -> Inertia:
        beta, gamma = jnp.exp(1e-3 * vector + self._published)
        return self.moon.body(beta, gamma, core=self.core)

    def vector(self, body: Inertia) -> Array:
        return 1e3 * (self.logs(body) - self._published)

    def logs(self, body: Inertia) -> Array:
        tensor = body.tensor + self.moon._core_inertia.tensor if self.core else body.tensor
        a, b, c = (tensor[i, i] for i in range(3))
        return jnp.log(jnp.stack([(c - a) / b, (b - a) / c]))

    @property
    def _published(self) -> Float[Array, "2"]:
        """Return the logarithms (2,) of the values β* and γ* that DE421 gives for β and γ."""
        return jnp.log(jnp.array([self.moon.constants[name] for name in ("LBET", "LGAM")]))


class _LiquidCore(eqx.Module):
    """Describe the torque on the mantle of the Moon from gravity on the whole Moon and from a
    liquid core, by friction at the boundary and by the flattening of the boundary.

    The state of this torque, `own` in its methods, is the angular velocity of the core, rad/s,
    mantle frame. Source: Folkner and others 2014 (DE430), section III; Williams and others 2001,
    Lunar rotational dissipation in solid body and molten core, JGR 106:27933.
    """

    feels: ClassVar[type] = HasAttitude
    state0: Float[Array, "3"]
    tensor: Float[Array, "3 3"]  # the inertia of the core, kg m²
    friction: Array  # torque over the difference of the angular velocities, N m s
    gravity: Sum

    def on_mantle(self, state: HasAttitude, own: Array) -> Array:
        x, y, z = own
        flat = self.tensor[2, 2] - self.tensor[0, 0]
        pushed = flat * z * jnp.stack([-y, x, jnp.zeros_like(z)])
        return self.friction * (own - state.omega) + pushed

    def rate(self, t: ScalarLike, own: Array, state: HasAttitude, body: Inertia) -> Array:
        moments = jnp.stack([self.tensor[i, i] for i in range(3)])
        return (cross(moments * own, state.omega) - self.on_mantle(state, own)) / moments

    def __call__(self, t: ScalarLike, state: HasAttitude, body: Inertia, own: Array) -> Array:
        whole = Inertia(body.tensor + self.tensor)
        return evaluate_torque(self.gravity, t, state, whole) + self.on_mantle(state, own)


class _CoreAcceleration(eqx.Module):
    """Evaluate the time derivative, rad/s², of the core's angular velocity as a vector field, while
    the mantle moves as in the ephemeris.
    """

    core: _LiquidCore
    moon: Moon

    def __call__(self, t: ScalarLike, own: Array, args: object = None) -> Array:
        return self.core.rate(t, own, self.moon.attitude(t), self.moon.body(core=True))


@eqx.filter_jit
def _core_velocity(
    field: _CoreAcceleration, initial_velocity: Array, ends: Float[Array, "2"]
) -> Float[Array, "3"]:
    """Return the angular velocity of the core at the second of two times, s, which may be the
    earlier one.
    """
    steps = dfx.PIDController(rtol=1e-12, atol=1e-12 * jnp.max(jnp.abs(initial_velocity)))
    first = jnp.sign(ends[1] - ends[0]) * jnp.minimum(DAY, jnp.abs(ends[1] - ends[0]))
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Dopri8(), ends[0], ends[1], first, initial_velocity,
        stepsize_controller=steps, max_steps=1_000_000,
    )  # fmt: skip
    return solution.ys[0]  # pyright: ignore[reportOptionalSubscript]


def _subdivided(
    coefficients: Float[np.ndarray, "intervals k terms"], parts: int
) -> Float[np.ndarray, "parts k terms"]:
    """Return the Chebyshev coefficients of given functions on intervals divided into equal
    parts.
    """
    count, k, terms = coefficients.shape
    if parts == 1:
        return coefficients
    nodes = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    back = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, terms - 1))
    out = np.empty((count, parts, k, terms))
    for part in range(parts):
        at = np.polynomial.chebyshev.chebvander((2 * part + 1 + nodes) / parts - 1, terms - 1)
        out[:, part] = coefficients @ (back @ at).T
    return out.reshape(count * parts, k, terms)


__all__ = ["CITATION", "DAY", "EPOCH", "Moon"]

define_dir_and_getattr(__name__)
