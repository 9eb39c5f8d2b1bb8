"""Unconstrained numbers ↔ the body, for a fit. Every point is a real body."""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax.body import parameters as charts, validation
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of as tensor_of
from rigidjax.body.symmetric3 import swap_trace

# The parts of a `MassProperties` that may be free, and their places in `pack`.
_PARTS = {"mass": (0,), "com": (7, 8, 9), "inertia": (1, 2, 3, 4, 5, 6)}
Numbers = Float[Array, " chart"]
Rows = Float[Array, "rows chart"]
# Components of a tensor in the order of their names.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
# The basis of symmetric tensors, in this order.
BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(COMPONENTS):
    BASIS[_k, _i, _j] = BASIS[_k, _j, _i] = 1.0


class AbstractBodyChart(eqx.Module):
    """A chart of bodies: `size` numbers → an `Inertia` or `MassProperties`, and back.

    `log_names`, `unit` and `logs(body)` describe the positive quantities that are reported, through
    their logarithms; `plain_names` and `plain(body)` quantities of either sign, none unless given.

    >>> class Spheres(AbstractBodyChart):  # one number: the logarithm of the moment
    ...     size, unit, log_names = 1, "kg m²", ("I",)
    ...     def body(self, vector):
    ...         return Inertia.from_principal(*jnp.exp(vector[0]) * jnp.ones(3))
    ...     def vector(self, body):
    ...         return self.logs(body)
    ...     def logs(self, body):
    ...         return jnp.log(body.tensor[0, 0])[None]
    >>> Spheres().body(jnp.zeros(1)).tensor[0].tolist()
    [1.0, 0.0, 0.0]
    """

    size: eqx.AbstractVar[int]
    log_names: eqx.AbstractVar[tuple[str, ...]]
    plain_names: ClassVar[tuple[str, ...]] = ()
    unit: ClassVar[str] = ""
    # Of the bodies that `Model` hands out; within a fit a torque on them is no mistake.
    scale: ClassVar[str | None] = None

    @abc.abstractmethod
    def body(self, vector: Numbers) -> Inertia | MassProperties:
        """The body of these numbers."""

    @abc.abstractmethod
    def vector(self, body: Any) -> Numbers:
        """The numbers of a body with this `Inertia`, the initial guess of a fit."""

    def bend(self, vector: Numbers, slope: Numbers) -> Rows:
        """Rows whose squares are the second derivative of a misfit from the chart's curvature.

        They matter if a body may be flat (`rigidjax.body.parameters.flat_bend`); else there are
        none. **Arguments:** `slope` the misfit's derivative in the chart's numbers.
        """
        return jnp.zeros((0, self.size), vector.dtype)

    @abc.abstractmethod
    def logs(self, body: Any) -> Float[Array, " logs"]:
        """Logarithms of the positive quantities that are reported."""

    def plain(self, body: Any) -> Float[Array, " plain"]:
        """The other quantities that are reported."""
        return jnp.zeros(0)


class Ratios(AbstractBodyChart):
    """The whole inertia tensor up to scale: two ratios of moments and the principal axes.

    Five numbers: the root of the second moment 𝔖, its scale fixed (`rigidjax.body.parameters`), so
    that a flat body is an ordinary point. For free motion, which cannot show the scale.

    >>> Ratios().logs(Ratios().body(jnp.zeros(5)))
    Array([0., 0.], dtype=float64)
    """

    size: ClassVar[int] = 5
    log_names: ClassVar[tuple[str, ...]] = ("I1/I3", "I2/I3")
    scale: ClassVar[str | None] = "arbitrary"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(swap_trace(charts.unpack_shape(vector)))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_shape(body.second_moment)

    def bend(self, vector: Numbers, slope: Numbers) -> Rows:
        return charts.flat_bend(vector, slope)

    def logs(self, body: Inertia) -> Float[Array, "2"]:
        moments = jnp.log(body.moments)
        return moments[:2] - moments[2]


class PrincipalRatios(AbstractBodyChart):
    """Two ratios of moments, where the body axes are known to be principal.

    Two numbers: the roots of the second moments along the axes, λ1, λ2, λ3, their scale fixed
    (notes, eqs 72, 76–78), so that every pair of numbers obeys the triangle inequalities.

    >>> PrincipalRatios().body(jnp.zeros(2)).moments.sum().round(12)  # Tr I = 2, as of `Ratios`
    Array(2., dtype=float64)
    """

    size: ClassVar[int] = 2
    log_names: ClassVar[tuple[str, ...]] = ("Ix/Iz", "Iy/Iz")
    scale: ClassVar[str | None] = "arbitrary"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(jnp.diag(charts.unpack_moments(_padded(vector, 1, 0)) / 3.0))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_moments(jnp.diagonal(body.tensor))[1:]

    def bend(self, vector: Numbers, slope: Numbers) -> Rows:
        return charts.flat_bend(_padded(vector, 0, 3), _padded(slope, 0, 3))[:, :2]

    def logs(self, body: Inertia) -> Float[Array, "2"]:
        i = jnp.diagonal(body.tensor)
        return jnp.log(i[:2] / i[2])


def _typical(value: Any) -> Array:
    if isinstance(value, Inertia | MassProperties):
        raise TypeError(
            "typical: wanted the rough size of the moments, one number, kg m², got "
            f"{type(value).__name__}; give a known body as Known(body), an initial guess by "
            "fit(initial=model.start(body))"
        )
    size = _checks.positive(value, "typical", "a positive moment of inertia, kg m²")
    return jnp.asarray(size, jnp.result_type(float))


class Tensor(AbstractBodyChart):
    """The whole inertia tensor with its scale, which a known torque or internal momentum shows.

    Six numbers: the logarithm of the size of 𝔖 in units of `typical`, and its shape (as `Ratios`).

    **Arguments:** `typical` kg m², the rough size of the moments, where a fit starts. **Raises**
    `ValueError` if it is not positive.

    >>> Tensor(1e-3).body(jnp.zeros(6)).tensor[0, 0]
    Array(0.001, dtype=float64)
    """

    typical: Float[Array, ""] = eqx.field(converter=_typical, default=1.0)
    size: ClassVar[int] = 6
    log_names: ClassVar[tuple[str, ...]] = ("I1", "I2", "I3")
    plain_names: ClassVar[tuple[str, ...]] = ("Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy")
    unit: ClassVar[str] = "kg m²"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(swap_trace(charts.unpack_second_moment(vector) * (0.5 * self.typical)))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_second_moment(body.second_moment / (0.5 * self.typical))

    def bend(self, vector: Numbers, slope: Numbers) -> Rows:
        return _padded(Ratios().bend(vector[1:], slope[1:]), 1, 0)

    def logs(self, body: Inertia) -> Float[Array, "3"]:
        return jnp.log(body.moments)

    def plain(self, body: Inertia) -> Float[Array, "6"]:
        return jnp.stack([body.tensor[i, j] for i, j in COMPONENTS])


class Principal(AbstractBodyChart):
    """Three principal moments with their scale, where the body axes are known to be principal.

    Three numbers: the logarithm of the size in units of `typical`, and as `PrincipalRatios`.

    **Arguments:** as for `Tensor`.

    >>> Principal(2.0).body(jnp.zeros(3)).tensor[0, 0]
    Array(2., dtype=float64)
    """

    typical: Float[Array, ""] = eqx.field(converter=_typical, default=1.0)
    size: ClassVar[int] = 3
    log_names: ClassVar[tuple[str, ...]] = ("Ix", "Iy", "Iz")
    unit: ClassVar[str] = "kg m²"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(jnp.diag(charts.unpack_moments(vector) * (0.5 * self.typical)))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_moments(jnp.diagonal(body.tensor) / (0.5 * self.typical))

    def bend(self, vector: Numbers, slope: Numbers) -> Rows:
        return _padded(PrincipalRatios().bend(vector[1:], slope[1:]), 1, 0)

    def logs(self, body: Inertia) -> Float[Array, "3"]:
        return jnp.log(jnp.diagonal(body.tensor))


class Mass(AbstractBodyChart):
    """Mass, centre of mass and inertia: all ten numbers, if forces show them, or some of them.

    **Arguments:** `guess` a `MassProperties` of about the right size, with the true values of all
    numbers that are not free, where the chart of `rigidjax.body.parameters.pack` starts; `free` the
    parts that a fit may move: `"mass"` (the second moment keeps its ratio to the mass unless the
    inertia is free, too), `"inertia"` about the centre of mass, `"com"`: `["inertia"]` for a body
    that was weighed and balanced, `["mass"]` for a load of known shape, `["com"]` for a centre that
    moved. **Raises:** `TypeError` for a guess of another type; `ValueError` for another word, or
    none.

    >>> box = rj.shapes.box(2.0, [1.0, 1.0, 1.0])
    >>> float(Mass(box).body(jnp.zeros(10)).mass), Mass(box, ["inertia"]).log_names
    (2.0, ('I1', 'I2', 'I3'))
    """

    guess: MassProperties
    free: tuple[str, ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    log_names: tuple[str, ...] = eqx.field(static=True)
    plain_names: tuple[str, ...] = eqx.field(static=True)  # pyright: ignore
    unit: ClassVar[str] = "SI"

    def __init__(self, guess: MassProperties, free: Sequence[str] = tuple(_PARTS)):
        self.guess = _checks.single(guess, MassProperties, "guess")
        wanted = "some of mass, inertia, com"
        _checks.instance(free, Sequence, "free", wanted=wanted)
        chosen = [free] if isinstance(free, str) else list(free)
        for name in chosen:
            _checks.word(name, tuple(_PARTS), "free")
        if not chosen:
            raise ValueError("free: wanted mass, inertia or com, got none; see Known")
        self.free = tuple(name for name in _PARTS if name in chosen)
        self.size = len(self._places)
        moments = ("I1", "I2", "I3") if "inertia" in chosen else ()
        self.log_names = ("mass", *moments) if "mass" in chosen else moments
        self.plain_names = ("com x", "com y", "com z") if "com" in chosen else ()

    @property
    def _places(self) -> list[int]:
        return sorted(place for name in self.free for place in _PARTS[name])

    @property
    def _length(self) -> Array:
        # The centre in units of the body's own size: every number is of order one.
        return jnp.sqrt(jnp.trace(self.guess.second_moment) / self.guess.mass)

    def body(self, vector: Numbers) -> MassProperties:
        if self.size < 10:
            vector = jnp.zeros(10, vector.dtype).at[np.array(self._places)].set(vector)
        step = jnp.concatenate([vector[:7], self._length * vector[7:]])
        return charts.unpack(charts.pack(self.guess) + step)

    def vector(self, body: Inertia | MassProperties) -> Numbers:
        if isinstance(body, Inertia):
            return jnp.zeros(self.size, self.guess.mass.dtype)
        step = charts.pack(body) - charts.pack(self.guess)
        step = jnp.concatenate([step[:7], step[7:] / self._length])
        return step[np.array(self._places)]

    def bend(self, vector: Numbers, slope: Numbers) -> Rows:
        if "inertia" not in self.free:
            return jnp.zeros((0, self.size), vector.dtype)
        first = self._places.index(2)
        rows = charts.flat_bend(
            charts.pack(self.guess)[2:7] + vector[first : first + 5], slope[first : first + 5]
        )
        return _padded(rows, first, self.size - first - 5)

    def logs(self, body: MassProperties) -> Float[Array, " logs"]:
        mass, moments = body.mass[None], body.inertia.moments
        kept = [mass] if "mass" in self.free else []
        kept += [moments] if "inertia" in self.free else []
        return jnp.log(jnp.concatenate(kept)) if kept else jnp.zeros(0, mass.dtype)

    def plain(self, body: MassProperties) -> Float[Array, " plain"]:
        return body.com if "com" in self.free else jnp.zeros(0, body.com.dtype)


class Known(AbstractBodyChart):
    """A known body: only states, torques and sensors are fitted.

    **Arguments:** `known` an `Inertia` or `MassProperties`.

    >>> Known(rj.Inertia.from_principal(1.0, 2.0, 3.0)).size
    0
    """

    known: Inertia | MassProperties
    size: ClassVar[int] = 0
    log_names: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self) -> None:
        validation.single(self.known, (Inertia, MassProperties), "known")

    def body(self, vector: Numbers) -> Inertia | MassProperties:
        return self.known

    def vector(self, body: Inertia) -> Numbers:
        return jnp.zeros(0, body.tensor.dtype)

    def logs(self, body: Any) -> Float[Array, "0"]:
        return jnp.zeros(0)


def _padded(x: Float[Array, "*rows n"], before: int, after: int) -> Float[Array, "*rows m"]:
    """The same numbers with zeros before and after them."""
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(before, after)])


class Bodies(eqx.Module):
    """The charts of several bodies, by name; their numbers follow one another. Charts of the same
    kind are kept stacked, so that one program serves all recordings.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    charts: tuple[AbstractBodyChart, ...]
    kinds: tuple[AbstractBodyChart, ...]
    kind_of: tuple[int, ...] = eqx.field(static=True)
    row_of: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, charts: Mapping[str, AbstractBodyChart]):
        self.names, self.charts = tuple(charts), tuple(charts.values())
        members: dict[Any, list[AbstractBodyChart]] = {}
        kind_of, row_of = [], []
        for chart in self.charts:
            leaves, structure = jax.tree.flatten(chart)
            form = structure, tuple(np.shape(leaf) for leaf in leaves)
            alike = members.setdefault(form, [])
            kind_of.append(list(members).index(form))
            row_of.append(len(alike))
            alike.append(chart)
        self.kind_of, self.row_of = tuple(kind_of), tuple(row_of)
        self.kinds = tuple(
            jax.tree.map(lambda *x: jnp.stack(x), *alike) for alike in members.values()
        )
        if len({has_mass(chart) for chart in self.charts}) > 1:
            raise ValueError(
                "body: wanted a mass for all bodies or for none, got "
                + ", ".join(f"{n}: {type(c).__name__}" for n, c in charts.items())
            )

    @property
    def size(self) -> int:
        """The number of free numbers of all bodies."""
        return sum(chart.size for chart in self.charts)

    def all(self, vector: Float[Array, " numbers"]) -> dict[str, Any]:
        """Every body by its name."""
        rows = zip(self.names, self.charts, numbers_of(self, vector), strict=True)
        return {name: scaled(chart, numbers) for name, chart, numbers in rows}

    def body(self, vector: Numbers, which: Int[Array, ""]) -> Any:
        """The body at the index `which`, from its numbers, padded with zeros."""
        kind, row = jnp.asarray(self.kind_of)[which], jnp.asarray(self.row_of)[which]
        found: Any = None
        for index, alike in enumerate(self.kinds):
            here = jnp.where(kind == index, row, 0)
            chart = jax.tree.map(lambda leaf, at=here: leaf[at], alike)
            body = chart.body(vector[: chart.size])
            leaves, form = jax.tree.flatten(body)
            if found is not None:
                # The body of a `Known` may have a scale of its own, which is no number.
                both = zip(leaves, jax.tree.leaves(found), strict=True)
                body = jax.tree.unflatten(form, [jnp.where(kind == index, *pair) for pair in both])
            found = body
        return found


def scaled(chart: AbstractBodyChart, vector: Numbers) -> Inertia | MassProperties:
    """The body of a chart as a user gets it: it says if its scale is arbitrary."""
    body = chart.body(vector)
    if chart.scale is None or isinstance(body, MassProperties):
        return body
    return Inertia(body.tensor, chart.scale)


def places_of(
    body: AbstractBodyChart | Bodies, which: Int[Array, " records"] | None, count: int
) -> Int[np.ndarray, "records numbers"]:
    """Return the places of the numbers of each recording's body among those of all bodies.

    Rows of smaller charts are filled with −1. `which` (R,) is the index of each recording's body.
    """
    if not isinstance(body, Bodies):
        return np.broadcast_to(np.arange(body.size), (count, body.size))
    widest = max(chart.size for chart in body.charts)
    parts = numbers_of(body, np.arange(body.size))
    rows = [np.pad(part, (0, widest - part.size), constant_values=-1) for part in parts]
    return np.stack(rows)[np.asarray(which)]


def body_of_recording(
    body: AbstractBodyChart | Bodies, vector: Numbers, which: Int[Array, ""] | None
) -> Inertia | MassProperties:
    """Return the body of one recording from the row that begins with its numbers.

    `which` is its index among several bodies, `None` of one.
    """
    if not isinstance(body, Bodies):
        return body.body(vector[: body.size])
    assert which is not None
    return body.body(vector, which)


def charts_of(body: Any) -> tuple[Any, ...]:
    """Return the charts of a model's body or bodies."""
    return body.charts if isinstance(body, Bodies) else (body,)


def numbers_of(body: Any, vector: Any) -> list[Any]:
    """Return the numbers of each chart of a model's body or bodies."""
    sizes = [chart.size for chart in charts_of(body)]
    return [vector[end - size : end] for size, end in zip(sizes, np.cumsum(sizes), strict=True)]


def as_list(bodies: Any) -> list[Any]:
    """Return the bodies of `Model.bodies`, of one or of several."""
    return list(bodies.values()) if isinstance(bodies, dict) else [bodies]


def has_mass(chart: AbstractBodyChart) -> bool:
    """Whether the chart's bodies have a mass."""
    sample: Any = eqx.filter_eval_shape(chart.body, jnp.zeros(chart.size))
    return isinstance(sample, MassProperties)
