"""Fuzz of values: public functions of drawn arguments against a second way of computing them.

A row says what is called, how its arguments are drawn and what else gives the same numbers, in
mpmath on arrays of `mpf` unless it is `plain`. How far the two may be apart is not chosen row by
row: `ulps` units of round-off of what the result is (the largest number of each array) and of what
it changes by when the arguments do. The second is measured, on the second way. Only a method that
has a tolerance (a solver, a quadrature) adds it to round-off, as `rtol`.

`JAX_ENABLE_X64=1 python -m surface.values_table [NAME]`, from `tests`, says how near each row comes to its bound.
"""

import dataclasses
import functools
import inspect
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import mpmath as mp
import numpy as np
from surface import public

EPS = float(np.finfo(float).eps)
DIGITS = 40
# By how much arguments are moved to see what the result changes by.
NUDGE, PLAIN_NUDGE = mp.mpf(10) ** -20, 2.0**-24
# A result of which the arguments leave fewer digits than this says nothing.
VAGUE = 1e-3

Draw = Callable[[np.random.Generator, int], Any]


@dataclasses.dataclass(frozen=True)
class Way:
    """A row: `names` what it covers, `ours` and `second` of the same arguments, `draws` of each.

    `norm`: arguments are moved by their largest number, as what factorises a matrix moves them, not
    each number by itself. `batched`: all draws in one call under `vmap`. `cost`: how many draws one
    counts for, of what takes long.
    """

    names: tuple[str, ...]
    ours: Callable[..., Any]
    draws: Sequence[Draw]
    second: Callable[..., Any]
    ulps: float = 8.0
    rtol: float = 0.0
    norm: bool = False
    plain: bool = False
    batched: bool = True
    cost: float = 1.0


WAYS: dict[str, Way] = {}
# Public, and no row: why.
WITHOUT: dict[str, str] = {}


def way(names: str, ours: Callable, draws: Any, second: Callable, **more: Any) -> None:
    """A row for the public names in `names`; what is in brackets after them tells rows apart."""
    draws = draws if isinstance(draws, tuple) else (draws,)
    if names in WAYS:
        raise ValueError(f"{names} is in the table already")
    covered = tuple(names.partition(" (")[0].split())
    WAYS[names] = Way(covered, ours, draws, second, **more)


def leave_out(reason: str, *names: str) -> None:
    """Public names without a row."""
    for name in names:
        if name in WITHOUT:
            raise ValueError(f"{name} is left out already")
        WITHOUT[name] = reason


@functools.cache
def wanted() -> set[str]:
    """All that a row or a reason must be there for: functions, methods, inherited ones, properties.

    A class that is called is one with its `__call__`.
    """
    found = {name for name in public.functions() if not name.startswith(_FAR)}
    found |= {name for name in public.methods() if not name.startswith(_FAR)}
    classes = {name: thing for name, thing in public.functions().items() if inspect.isclass(thing)}
    known = {id(thing) for thing in classes.values()}
    for name, thing in classes.items():
        if name.startswith(_FAR):
            continue
        for base in thing.__mro__:
            if not base.__module__.startswith("rigidjax") or (
                base is not thing and id(base) in known
            ):
                continue
            for member, value in vars(base).items():
                if getattr(value, "__isabstractmethod__", False):
                    continue
                plain = inspect.isfunction(value) or isinstance(value, staticmethod | classmethod)
                if not member.startswith("_") and (plain or isinstance(value, property)):
                    found.add(f"{name}.{member}")
    return {name.removesuffix(".__call__") for name in found}


# Pictures, timings, processes and one recording: no numbers of mechanics.
_FAR = ("plot.", "tumblers.plot.", "workprecision.", "batch.distributed.", "datasets.")


def drawn(row: Way, key: str, count: int, seed: int) -> list[tuple]:
    """`count` sets of arguments. Draw i is of class i of each kind of argument: all come."""
    found = []
    for i in range(count):
        rng = np.random.default_rng([seed, zlib.crc32(key.encode()), i])
        start = int(rng.integers(1000)) if len(row.draws) > 1 else 0
        one: list[np.ndarray] = []
        for k, draw in enumerate(row.draws):
            made = draw(rng, i + k * (start + 1))
            # Several that belong together, each an argument.
            one += map(np.asarray, made if isinstance(made, tuple) else [made])
        found.append(tuple(one))
    return found


@dataclasses.dataclass(frozen=True)
class Judged:
    """One call: the error over its bound, whether the bound says anything, and what was wrong."""

    ratio: float
    vague: bool
    what: str = ""


def judged(key: str, count: int, seed: int = 0) -> Iterator[Judged]:
    """The draws of a row, one by one."""
    row = WAYS[key]
    sets = drawn(row, key, count, seed)
    for i, (arguments, got) in enumerate(zip(sets, _ours(row, sets), strict=True)):
        with mp.workdps(DIGITS):
            right, moved = _second(row, arguments, i)
        yield _compared(row, arguments, got, right, moved)


def _ours(row: Way, sets: list[tuple]) -> list[list[np.ndarray]]:
    if not row.batched:
        return [[np.asarray(leaf) for leaf in _leaves(row.ours(*one))] for one in sets]
    stacked = [np.stack(parts) for parts in zip(*sets, strict=True)]
    leaves = jax.jit(jax.vmap(lambda *a: _leaves(row.ours(*a))))(*stacked)
    leaves = [np.asarray(leaf) for leaf in leaves]
    return [[leaf[i] for leaf in leaves] for i in range(len(sets))]


def _leaves(tree: Any) -> list[Any]:
    if isinstance(tree, dict):
        return [leaf for name in sorted(tree) for leaf in _leaves(tree[name])]
    if isinstance(tree, list | tuple):
        return [leaf for part in tree for leaf in _leaves(part)]
    if tree is None:
        return []
    if isinstance(tree, np.ndarray | float | int | bool | np.generic | mp.mpf):
        return [tree]
    return [leaf for leaf in jax.tree.leaves(tree) if eqx.is_array_like(leaf)]


def _second(row: Way, arguments: tuple, i: int) -> tuple[list, list]:
    """The other way's result, and by how much it changes for a relative change of one."""
    change = (lambda x: x) if row.plain else number
    nudge = PLAIN_NUDGE if row.plain else NUDGE
    right = [_objects(leaf) for leaf in _leaves(row.second(*map(change, arguments)))]
    most = [mp.mpf(0)] * len(right)
    rng = np.random.default_rng(i)
    for _ in range(1 if row.plain else 2):
        moved = _leaves(row.second(*(_moved(change(a), nudge, row.norm, rng) for a in arguments)))
        for k, (a, b) in enumerate(zip(moved, right, strict=True)):
            most[k] = max(most[k], _largest(_objects(a) - b) / mp.mpf(nudge))
    return right, most


def _moved(x: Any, nudge: Any, norm: bool, rng: np.random.Generator) -> Any:
    x = np.asarray(x)
    if x.dtype.kind in "biuU" or x.size == 0:
        return x
    # Not all by as much: moves of several numbers do not undo each other.
    signs = rng.choice([-1.0, 1.0], x.shape) * rng.uniform(0.5, 1.0, x.shape)
    if x.ndim == 2 and x.shape[0] == x.shape[1] and (x == x.T).all():
        signs = np.triu(signs) + np.triu(signs, 1).T
    signs = number(signs) if x.dtype == object else signs
    size = _largest(x) if norm else np.abs(x)
    found = x + nudge * signs * size
    return np.asarray(found)[()]


def _objects(x: Any) -> np.ndarray:
    x = np.asarray(x)
    return x if x.dtype == object else np.asarray(number(x.astype(float)), object)


def _largest(x: np.ndarray) -> Any:
    return max((abs(part) for part in np.ravel(x)), default=mp.mpf(0))


def _compared(row: Way, arguments: tuple, got: list, right: list, moved: list) -> Judged:
    said = f"{' '.join(row.names)} of {[a.tolist() for a in arguments]}"
    if len(got) != len(right):
        return Judged(np.inf, False, f"{said}: {len(got)} arrays where {len(right)} are wanted")
    worst, vague, what = 0.0, False, ""
    for k, (a, b, change) in enumerate(zip(got, right, moved, strict=True)):
        if a.shape != np.shape(b):
            return Judged(np.inf, False, f"{said}, [{k}]: shape {a.shape}, not {np.shape(b)}")
        infinite = np.array([not mp.isfinite(x) for x in np.ravel(b)], bool).reshape(np.shape(b))
        if infinite.any() or not np.isfinite(np.asarray(a, float)).all():
            if not np.array_equal(np.asarray(a, float)[infinite], b[infinite].astype(float)) or (
                not np.isfinite(np.asarray(a, float)[~infinite]).all()
            ):
                return Judged(np.inf, False, f"{said}, [{k}]: {a.tolist()}, not {_plain(b)}")
            continue
        size = _largest(b)
        # Below the smallest normal number digits are lost one by one.
        bound = (row.ulps * EPS + row.rtol) * (size + change) + mp.mpf(2) ** -1022
        vague = vague or bool(bound > VAGUE * size > 0)
        error = _largest(number(np.asarray(a, float)) - b)
        ratio = float(error / bound)
        if ratio > worst:
            worst = ratio
            if ratio > 1:
                off = float(error / size) if size else float(error)
                what = f"{said}, [{k}]: {a.tolist()}, not {_plain(b)}: off by {off:.2g}, {ratio:.2g} bounds"
    return Judged(worst, vague, what)


def _plain(x: np.ndarray) -> Any:
    return np.asarray(x).astype(float).tolist()


# Numbers of mpmath in arrays of NumPy, whose + − * / @ they take.
_number = np.vectorize(lambda x: x if isinstance(x, mp.mpf) else mp.mpf(float(x)), otypes=[object])


def number(x: Any) -> Any:
    return _number(x)[()]


def _each(function: Callable) -> Callable:
    return np.vectorize(function, otypes=[object])


sqrt, sin, cos, exp, log = map(_each, (mp.sqrt, mp.sin, mp.cos, mp.exp, mp.log))
tan, atan2, acos, tanh = map(_each, (mp.tan, mp.atan2, mp.acos, mp.tanh))


def eye(n: int = 3) -> np.ndarray:
    return number(np.eye(n))


def dot(a: Any, b: Any) -> Any:
    return (np.asarray(a) * np.asarray(b)).sum()


def norm(a: Any) -> Any:
    return mp.sqrt(dot(a, a))


def hat(w: Any) -> np.ndarray:
    zero = 0 * w[0]
    return np.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def vee(a: Any) -> np.ndarray:
    return np.array([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]]) / 2


def solve(a: Any, b: Any) -> np.ndarray:
    """x with a x = b, by Gauss's elimination; b a vector or a matrix."""
    a, b = np.array(a, object), np.array(b, object)
    n = len(a)
    for i in range(n):
        p = max(range(i, n), key=lambda k: abs(a[k, i]))
        a[[i, p]], b[[i, p]] = a[[p, i]], b[[p, i]]
        for k in range(i + 1, n):
            f = a[k, i] / a[i, i]
            a[k, i:] = a[k, i:] - f * a[i, i:]
            b[k] = b[k] - f * b[i]
    for i in reversed(range(n)):
        b[i] = (b[i] - (a[i, i + 1 :] @ b[i + 1 :] if i < n - 1 else 0)) / a[i, i]
    return b


def determinant(a: Any) -> Any:
    return mp.det(mp.matrix(np.asarray(a).tolist()))


def eigen(a: Any) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues, ascending, and eigenvectors in columns, of a symmetric matrix."""
    a = (a + a.T) / 2
    scale = _largest(a)
    if scale == 0:
        return number(np.zeros(len(a))), eye(len(a))
    values, vectors = mp.eigsy(mp.matrix((a / scale).tolist()))
    values = np.array([v * scale for v in values], object)
    order = np.argsort(values)
    return values[order], np.array(vectors.tolist(), object).reshape(a.shape)[:, order]


def matrix_of(q: Any) -> np.ndarray:
    """The rotation matrix of a quaternion of any length."""
    w, u = q[0], np.asarray(q[1:])
    n2 = w * w + dot(u, u)
    return ((w * w - dot(u, u)) * eye() + 2 * np.outer(u, u) + 2 * w * hat(u)) / n2


def times(p: Any, q: Any) -> np.ndarray:
    """The product of quaternions."""
    a, u, b, v = p[0], np.asarray(p[1:]), q[0], np.asarray(q[1:])
    return np.concatenate([[a * b - dot(u, v)], a * v + b * u + np.cross(u, v)])


def quaternion_of(v: Any) -> np.ndarray:
    """The quaternion of a rotation vector."""
    angle = norm(v)
    if angle == 0:
        return number(np.array([1.0, 0, 0, 0]))
    return np.concatenate([[mp.cos(angle / 2)], mp.sin(angle / 2) / angle * np.asarray(v)])


def turn_of(q: Any) -> np.ndarray:
    """The shortest rotation vector of a quaternion."""
    u = np.asarray(q[1:])
    size = norm(u)
    if size == 0:
        return 0 * u
    lead = q[0] if q[0] != 0 else next(x for x in u if x != 0)
    return 2 * mp.atan2(size, abs(q[0])) / size * u * mp.sign(lead)


def rotation(v: Any) -> np.ndarray:
    return matrix_of(quaternion_of(v))


# What is drawn.
def one_of(*draws: Draw) -> Draw:
    """Class i of draw i, round and round."""
    return lambda rng, i: draws[i % len(draws)](rng, i)


def fixed(*values: Any) -> Draw:
    return lambda rng, i: np.asarray(values[i % len(values)], float)


def scale(low: float = -20, high: float = 20) -> Draw:
    """A positive number, its logarithm even."""
    return lambda rng, i: 10.0 ** rng.uniform(low, high)


def between(low: float, high: float, *shape: int) -> Draw:
    return lambda rng, i: rng.uniform(low, high, shape)


def normal(*shape: int, low: float = 0, high: float = 0) -> Draw:
    """Normal numbers of one scale."""
    return lambda rng, i: rng.normal(size=shape) * 10.0 ** rng.uniform(low, high)


def _uneven(rng: np.random.Generator, i: int) -> np.ndarray:
    return rng.normal(size=3) * 10.0 ** rng.uniform(-8, 8, 3)


def _flat(rng: np.random.Generator, i: int) -> np.ndarray:
    return rng.normal(size=3) * rng.permutation([0.0, 1.0, 1.0])


vector = one_of(normal(3), normal(3, low=-20, high=20), _flat, _uneven)
ordinary = normal(3)


def direction(rng: np.random.Generator, i: int = 0) -> np.ndarray:
    x = rng.normal(size=3) if i % 3 else rng.permutation([1.0, 0.0, 0.0])
    return x / np.linalg.norm(x)


def rotated_by(angle: Draw) -> Draw:
    return lambda rng, i: direction(rng, i) * angle(rng, i)


# Rotation vectors: none, almost none, some, almost a half turn, about a turn, many.
_angles = (
    scale(-12, -4), between(0.1, 3.0), lambda rng, i: np.pi - 10.0 ** rng.uniform(-9, -2),
    fixed(0.0), scale(-20, -12), between(3.2, 6.2), between(6.2, 6.4), scale(1, 8),
)  # fmt: skip
turn = rotated_by(one_of(*_angles))
short_turn = rotated_by(one_of(*_angles[:5]))


def quaternion(rng: np.random.Generator, i: int) -> np.ndarray:
    """Unit; of both signs, near one, near a half turn, along an axis."""
    q = rng.normal(size=4)
    kind = i % 5
    if kind == 1:
        q[1:] *= 10.0 ** rng.uniform(-16, -3)
    elif kind == 2:
        q[0] *= 10.0 ** rng.uniform(-12, -3)
    elif kind == 3:
        q[rng.integers(4)] = 0.0
    elif kind == 4:
        q = rng.permutation([1.0, 0, 0, 0]) * rng.choice([-1.0, 1.0])
    return q / np.linalg.norm(q)


def matrix(rng: np.random.Generator, i: int) -> np.ndarray:
    """A rotation, rounded."""
    w, x, y, z = quaternion(rng, i)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def moments(rng: np.random.Generator, i: int) -> np.ndarray:
    """Second moments (3,): any, equal, two nearly equal, flat, long, small and large."""
    kind = i % 6
    x = rng.uniform(0.3, 1.0, 3)
    if kind == 1:
        x[:] = x[0]
    elif kind == 2:
        x[1] = x[0] * (1 + 10.0 ** rng.uniform(-15, -4))
    elif kind == 3:
        x[2] *= 10.0 ** rng.uniform(-6, -2)
    elif kind == 4:
        x[:2] *= 10.0 ** rng.uniform(-6, -2)
    elif kind == 5:
        x *= 10.0 ** rng.uniform(-20, 20)
    return rng.permutation(x)


def second_moment(rng: np.random.Generator, i: int) -> np.ndarray:
    """𝔖 (3, 3), positive definite, in axes of its own or turned."""
    r = np.eye(3) if i % 4 == 3 else matrix(rng, 0)
    s = r @ np.diag(moments(rng, i)) @ r.T
    return 0.5 * (s + s.T)


def inertia(rng: np.random.Generator, i: int) -> np.ndarray:
    s = second_moment(rng, i)
    return np.trace(s) * np.eye(3) - s


def draws_of(row: Way, count: int = 8) -> int:
    return max(1, round(count / row.cost))
