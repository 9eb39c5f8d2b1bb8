"""Map unconstrained numbers to physically possible bodies by charts, for a fit."""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from rigidjax import _checks
from rigidjax.body import parameters as charts, validation
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of as tensor_of
from rigidjax.body.symmetric3 import to_inertia

# A fit may move three parts of a `MassProperties`. This dict maps each part to the indices of its
# numbers in the array that `rigidjax.body.parameters.pack` returns.
_PARTS = {"mass": (0,), "com": (7, 8, 9), "inertia": (1, 2, 3, 4, 5, 6)}
Numbers = Float[Array, " chart"]
HessianRows = Float[Array, "rows chart"]
# These are the index pairs of the six components of a symmetric tensor, in the order xx, yy, zz,
# yz, xz, xy, as in `Tensor.plain_names`.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
# BASIS[k] is the symmetric tensor whose component COMPONENTS[k] is one and whose other components
# are zero.
BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(COMPONENTS):
    BASIS[_k, _i, _j] = BASIS[_k, _j, _i] = 1.0


class AbstractBodyChart(eqx.Module):
    """Define a chart of bodies, which maps `size` unconstrained numbers to an `Inertia` or
    `MassProperties`, and back.

    To make a chart of your own, write a subclass with three methods: `body(vector)` returns the
    body that the numbers represent, `vector(body)` the numbers of a body, and `logs(body)` the
    logarithms of its positive quantities. The subclass also needs these members (the last two may
    be left out):

    - `size`: how many numbers represent a body.
    - `log_names`: the names of the positive quantities of a body that a fit reports, in the order
      of `logs(body)`.
    - `plain_names`: the names of the quantities of either sign that a fit reports; `plain(body)`
      returns these quantities. By default there are no such quantities.
    - `unit`: the unit of these quantities, by default an empty text.

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
    # This is the argument `scale` of the `Inertia` that a user gets from `Model`: "arbitrary" if
    # the chart finds the inertia only up to a factor. Within a fit the `Inertia` does not have this
    # mark, since a torque on a body of arbitrary scale would be refused.
    scale: ClassVar[str | None] = None

    @abc.abstractmethod
    def body(self, vector: Numbers) -> Inertia | MassProperties:
        """Return the body that the numbers `vector` (size,) represent in this chart."""

    @abc.abstractmethod
    def vector(self, body: PyTree) -> Numbers:
        """Return the numbers (size,) that represent a `body` in this chart. A fit may start from
        these numbers.
        """

    def curvature_rows(self, vector: Numbers, misfit_gradient: Numbers) -> HessianRows:
        """Return j rows B (j, size), by which a fit allows for the curvature of the chart: the body
        is not a linear function of its numbers.

        A fit adds BᵀB to the matrix JᵀJ of its normal equations, since J holds first derivatives
        only. This matters if a body may be flat (see
        `rigidjax.body.parameters.curvature_rows_near_flat_body`). A chart that returns no rows (j =
        0) leaves the curvature out.

        - `vector`: (size,) the numbers of the body in the chart.
        - `misfit_gradient`: (size,) the derivative of the cost with respect to these numbers.
        """
        return jnp.zeros((0, self.size), vector.dtype)

    @abc.abstractmethod
    def logs(self, body: PyTree) -> Float[Array, " positive_quantities"]:
        """Return the logarithms of the positive quantities of a `body` that are reported, in the
        order of `log_names`.
        """

    def plain(self, body: PyTree) -> Float[Array, " signed_quantities"]:
        """Return the reported quantities of a `body` that may have either sign, in the order of
        `plain_names`. A chart without this method reports no such quantities.
        """
        return jnp.zeros(0)


class Ratios(AbstractBodyChart):
    """Map five numbers to the inertia tensor up to scale, which is the two ratios I1/I3 and I2/I3
    of the principal moments, and the directions of the principal axes.

    The chart is for free motion, which does not show the scale of the inertia. The five numbers
    describe a square root of the matrix of second moments 𝔖 = ∫ r rᵀ dm, where r is the position of
    the mass element dm; the trace of 𝔖 is set to 1 (`rigidjax.body.parameters.pack_shape`). In this
    way a flat body, whose 𝔖 is singular, is an ordinary point of the chart.

    >>> Ratios().logs(Ratios().body(jnp.zeros(5)))
    Array([0., 0.], dtype=float64)
    """

    size: ClassVar[int] = 5
    log_names: ClassVar[tuple[str, ...]] = ("I1/I3", "I2/I3")
    scale: ClassVar[str | None] = "arbitrary"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(to_inertia(charts.unpack_shape(vector)))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_shape(body.second_moment)

    def curvature_rows(self, vector: Numbers, misfit_gradient: Numbers) -> HessianRows:
        return charts.curvature_rows_near_flat_body(vector, misfit_gradient)

    def logs(self, body: Inertia) -> Float[Array, "2"]:
        moments = jnp.log(body.moments)
        return moments[:2] - moments[2]


class PrincipalRatios(AbstractBodyChart):
    """Map two numbers to two ratios of moments, if the body axes are known to be principal.

    The two ratios are Ix/Iz and Iy/Iz. The two numbers describe the square roots of the second
    moments λ1, λ2, λ3 along the axes; the sum of the second moments is set to 1 (notes, eqs 72,
    76–78). In this way the moments of inertia obey the triangle inequalities for every pair of
    numbers.

    >>> PrincipalRatios().body(jnp.zeros(2)).moments.sum().round(12)  # the trace of I is 2
    Array(2., dtype=float64)
    """

    size: ClassVar[int] = 2
    log_names: ClassVar[tuple[str, ...]] = ("Ix/Iz", "Iy/Iz")
    scale: ClassVar[str | None] = "arbitrary"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(jnp.diag(charts.unpack_moments(_pad_with_zeros(vector, 1, 0)) / 3.0))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_moments(jnp.diagonal(body.tensor))[1:]

    def curvature_rows(self, vector: Numbers, misfit_gradient: Numbers) -> HessianRows:
        return charts.curvature_rows_near_flat_body(
            _pad_with_zeros(vector, 0, 3), _pad_with_zeros(misfit_gradient, 0, 3)
        )[:, :2]

    def logs(self, body: Inertia) -> Float[Array, "2"]:
        i = jnp.diagonal(body.tensor)
        return jnp.log(i[:2] / i[2])


def _checked_typical(value: object) -> Array:
    """Return `typical` of a chart as an array, after checks: it is easily taken for a body."""
    if isinstance(value, Inertia | MassProperties):
        raise TypeError(
            "typical: wanted the rough size of the moments, one number, kg m², got "
            f"{type(value).__name__}; give a known body as Known(body), an initial guess by "
            "fit(initial=model.start(body))"
        )
    size = _checks.positive_float(value, "typical", "a positive moment of inertia, kg m²")
    return jnp.asarray(size, jnp.result_type(float))


class Tensor(AbstractBodyChart):
    """Map six numbers to the inertia tensor with its scale.

    The scale can be found if a torque or a momentum is known. The first of the six numbers is the
    logarithm of the size of the matrix of second moments 𝔖 = ∫ r rᵀ dm, in units of `typical`; here
    r is the position of the mass element dm. The other five are the numbers of `Ratios`, the chart
    of a tensor without its scale.

    **Arguments:** `typical` kg m², the rough size of the moments of inertia, with which a fit
    starts. **Raises** `ValueError` if `typical` is not positive.

    >>> Tensor(1e-3).body(jnp.zeros(6)).tensor[0, 0]
    Array(0.001, dtype=float64)
    """

    typical: Float[Array, ""] = eqx.field(converter=_checked_typical, default=1.0)
    size: ClassVar[int] = 6
    log_names: ClassVar[tuple[str, ...]] = ("I1", "I2", "I3")
    plain_names: ClassVar[tuple[str, ...]] = ("Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy")
    unit: ClassVar[str] = "kg m²"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(to_inertia(charts.unpack_second_moment(vector) * (0.5 * self.typical)))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_second_moment(body.second_moment / (0.5 * self.typical))

    def curvature_rows(self, vector: Numbers, misfit_gradient: Numbers) -> HessianRows:
        return _pad_with_zeros(Ratios().curvature_rows(vector[1:], misfit_gradient[1:]), 1, 0)

    def logs(self, body: Inertia) -> Float[Array, "3"]:
        return jnp.log(body.moments)

    def plain(self, body: Inertia) -> Float[Array, "6"]:
        return jnp.stack([body.tensor[i, j] for i, j in COMPONENTS])


class Principal(AbstractBodyChart):
    """Map three numbers to three moments with their scale, if the body axes are known to be
    principal.

    The first number is the logarithm of the size of the second moments, in units of `typical`. The
    other two are the numbers of `PrincipalRatios`, the chart of the ratios of these moments.

    **Arguments:** `typical` kg m², the rough size of the moments of inertia, with which a fit
    starts. **Raises** `ValueError` if `typical` is not positive.

    >>> Principal(2.0).body(jnp.zeros(3)).tensor[0, 0]
    Array(2., dtype=float64)
    """

    typical: Float[Array, ""] = eqx.field(converter=_checked_typical, default=1.0)
    size: ClassVar[int] = 3
    log_names: ClassVar[tuple[str, ...]] = ("Ix", "Iy", "Iz")
    unit: ClassVar[str] = "kg m²"

    def body(self, vector: Numbers) -> Inertia:
        return Inertia(jnp.diag(charts.unpack_moments(vector) * (0.5 * self.typical)))

    def vector(self, body: Inertia) -> Numbers:
        return charts.pack_moments(jnp.diagonal(body.tensor) / (0.5 * self.typical))

    def curvature_rows(self, vector: Numbers, misfit_gradient: Numbers) -> HessianRows:
        return _pad_with_zeros(
            PrincipalRatios().curvature_rows(vector[1:], misfit_gradient[1:]), 1, 0
        )

    def logs(self, body: Inertia) -> Float[Array, "3"]:
        return jnp.log(jnp.diagonal(body.tensor))


class Mass(AbstractBodyChart):
    """Map up to ten numbers to the mass, the centre of mass and the inertia of a body.

    The recording must contain forces, without which the mass cannot be found. The body of the
    `guess` is described by ten numbers (`rigidjax.body.parameters.pack`), of which all or only some
    are free. The numbers of this chart are the changes of the free ones.

    **Arguments:**

    - `guess`: a `MassProperties` of about the right size, with the true values of all numbers that
      are not free.
    - `free`: the parts that a fit may move, some of `"mass"`, `"inertia"` (about the centre of
      mass) and `"com"` (the centre of mass). If the mass is free and the inertia is not, the second
      moments keep their ratio to the mass. Examples are `["inertia"]` for a body that was weighed
      and balanced, `["mass"]` for a load of known shape, and `["com"]` for a centre of mass that
      moved.

    **Raises:** `TypeError` for a `guess` that is not a `MassProperties`; `ValueError` if `free`
    contains another word than these three, or nothing.

    >>> box = rj.shapes.box(2.0, [1.0, 1.0, 1.0])
    >>> float(Mass(box).body(jnp.zeros(10)).mass), Mass(box, ["inertia"]).log_names
    (2.0, ('I1', 'I2', 'I3'))
    """

    guess: MassProperties
    free: tuple[str, ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    log_names: tuple[str, ...] = eqx.field(static=True)
    plain_names: tuple[str, ...] = eqx.field(static=True)  # pyright: ignore
    unit: ClassVar[str] = "kg m²"

    def __init__(self, guess: MassProperties, free: Sequence[str] = tuple(_PARTS)):
        self.guess = _checks.require_unbatched_instance(guess, MassProperties, "guess")
        wanted = "some of mass, inertia, com"
        _checks.require_instance(free, Sequence, "free", requirement=wanted)
        chosen = [free] if isinstance(free, str) else list(free)
        for name in chosen:
            _checks.require_option(name, tuple(_PARTS), "free")
        if not chosen:
            raise ValueError("free: wanted mass, inertia or com, got none; see Known")
        self.free = tuple(name for name in _PARTS if name in chosen)
        self.size = len(self._free_indices)
        moments = ("I1", "I2", "I3") if "inertia" in chosen else ()
        self.log_names = ("mass", *moments) if "mass" in chosen else moments
        center = ("com x", "com y", "com z") if "com" in chosen else ()
        self.plain_names = (*center, *(Tensor.plain_names if moments else ()))

    @property
    def _free_indices(self) -> list[int]:
        """Return the sorted indices of the chart's numbers among the ten of `pack`."""
        return sorted(place for name in self.free for place in _PARTS[name])

    @property
    def _body_length(self) -> Array:
        """Return √(tr 𝔖 / M) of the guess, m, the unit of the numbers of the centre of mass."""
        return jnp.sqrt(jnp.trace(self.guess.second_moment) / self.guess.mass)

    def body(self, vector: Numbers) -> MassProperties:
        if self.size < 10:
            vector = jnp.zeros(10, vector.dtype).at[np.array(self._free_indices)].set(vector)
        step = jnp.concatenate([vector[:7], self._body_length * vector[7:]])
        return charts.unpack(charts.pack(self.guess) + step)

    def vector(self, body: Inertia | MassProperties) -> Numbers:
        if isinstance(body, Inertia):
            return jnp.zeros(self.size, self.guess.mass.dtype)
        step = charts.pack(body) - charts.pack(self.guess)
        step = jnp.concatenate([step[:7], step[7:] / self._body_length])
        return step[np.array(self._free_indices)]

    def curvature_rows(self, vector: Numbers, misfit_gradient: Numbers) -> HessianRows:
        if "inertia" not in self.free:
            return jnp.zeros((0, self.size), vector.dtype)
        first = self._free_indices.index(2)
        rows = charts.curvature_rows_near_flat_body(
            charts.pack(self.guess)[2:7] + vector[first : first + 5],
            misfit_gradient[first : first + 5],
        )
        return _pad_with_zeros(rows, first, self.size - first - 5)

    def logs(self, body: MassProperties) -> Float[Array, " positive_quantities"]:
        mass, moments = body.mass[None], body.inertia.moments
        parts = [mass] if "mass" in self.free else []
        parts += [moments] if "inertia" in self.free else []
        return jnp.log(jnp.concatenate(parts)) if parts else jnp.zeros(0, mass.dtype)

    def plain(self, body: MassProperties) -> Float[Array, " signed_quantities"]:
        parts = [body.com] if "com" in self.free else []
        if "inertia" in self.free:
            parts += [jnp.stack([body.inertia.tensor[k] for k in COMPONENTS])]
        return jnp.concatenate(parts) if parts else jnp.zeros(0, body.com.dtype)


class Known(AbstractBodyChart):
    """Map no numbers to a known body: a fit then moves only states, torques and sensors.

    **Arguments:** `known` an `Inertia` or `MassProperties`.

    >>> Known(rj.Inertia.from_principal(1.0, 2.0, 3.0)).size
    0
    """

    known: Inertia | MassProperties
    size: ClassVar[int] = 0
    log_names: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self) -> None:
        validation.require_single_body(self.known, (Inertia, MassProperties), "known")

    def body(self, vector: Numbers) -> Inertia | MassProperties:
        return self.known

    def vector(self, body: Inertia) -> Numbers:
        return jnp.zeros(0, body.tensor.dtype)

    def logs(self, body: PyTree) -> Float[Array, "0"]:
        return jnp.zeros(0)


def _pad_with_zeros(
    x: Float[Array, "*rows n"], leading: int, trailing: int
) -> Float[Array, "*rows m"]:
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(leading, trailing)])


Charts = tuple[AbstractBodyChart, ...]


def body_places(
    charts: Charts, body_indices: Int[Array, " records"] | None, recording_count: int
) -> Int[np.ndarray, "records numbers"]:
    """Return the places of the parameters of each recording's body among those of all bodies (−1:
    the body has fewer parameters than another).
    """
    widest, size = max(one.size for one in charts), sum(one.size for one in charts)
    parts = split_numbers(charts, np.arange(size))
    rows = [np.pad(part, (0, widest - part.size), constant_values=-1) for part in parts]
    if body_indices is None:
        return np.broadcast_to(rows[0], (recording_count, widest))
    return np.stack(rows)[np.asarray(body_indices)]


def body_at(
    charts: Charts, vector: Numbers, body_index: Int[Array, ""] | None
) -> Inertia | MassProperties:
    """Return the body of one recording, whose parameters come first in the row `vector`.

    `body_index`, its index among several bodies, may be traced; it is `None` for a single body.
    """
    if body_index is None:
        return charts[0].body(vector[: charts[0].size])
    # Charts are of one kind if they have the same structure and their arrays the same shapes. All
    # charts of one kind are stacked in one chart, so that one program serves all bodies.
    kinds: dict[Any, list[int]] = {}
    for index, chart in enumerate(charts):
        leaves, structure = jax.tree.flatten(chart)
        kinds.setdefault((structure, tuple(map(jnp.shape, leaves))), []).append(index)
    chosen: Any = None
    for members in kinds.values():
        here = jnp.asarray(members, jnp.int32) == body_index
        row, right = jnp.argmax(here), jnp.any(here)
        alike = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(charts[i] for i in members))
        chart = jax.tree.map(lambda leaf, at=row: leaf[at], alike)
        body = chart.body(vector[: chart.size])
        leaves, form = jax.tree.flatten(body)
        if chosen is not None:
            # The chart of each kind makes a body, and the body of the right kind is chosen. The
            # choice is made array by array, since a choice between whole JAX trees needs trees of
            # one structure: the body of a `Known` chart may have another `scale`, a static member,
            # than the other bodies.
            both = zip(leaves, jax.tree.leaves(chosen), strict=True)
            body = jax.tree.unflatten(form, [jnp.where(right, *pair) for pair in both])
        chosen = body
    return chosen


def split_numbers(charts: Charts, vector: Array | np.ndarray) -> list[Any]:
    """Return the parts of `vector` that describe each body."""
    ends = np.cumsum([chart.size for chart in charts])
    return [vector[end - chart.size : end] for chart, end in zip(charts, ends, strict=True)]


def body_list(bodies: Inertia | MassProperties | dict[str, Any]) -> list[Any]:
    """Return the result of `Model.bodies` as a list."""
    return list(bodies.values()) if isinstance(bodies, dict) else [bodies]


def has_mass(chart: AbstractBodyChart) -> bool:
    """Return whether a `chart` makes `MassProperties`, not only an `Inertia`."""
    sample: Any = eqx.filter_eval_shape(chart.body, jnp.zeros(chart.size))
    return isinstance(sample, MassProperties)
