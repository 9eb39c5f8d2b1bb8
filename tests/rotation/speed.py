"""Our time over each peer's, in one process, interleaved: `python -m tests.rotation.speed`.

Ratios, medians over rounds. Below 1 we are faster. Writes a markdown table to standard output.
Peers that are not installed are left out. Not a test: nothing asserts a time.
"""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj


def cases() -> dict[str, dict[str, Callable]]:
    """For each map, one function of one rotation per library: the same answer from all."""
    ours = {
        "exp": lambda v, u, p, q: rj.quaternion.exp(v),
        "exp to matrix": lambda v, u, p, q: rj.so3.exp(v),
        "log": lambda v, u, p, q: rj.quaternion.log(q),
        "compose": lambda v, u, p, q: rj.quaternion.multiply(p, q),
        "rotate": lambda v, u, p, q: rj.quaternion.rotate(q, u),
        "log of exp": lambda v, u, p, q: rj.quaternion.log(rj.quaternion.exp(v)),
        "attitude error": lambda v, u, p, q: rj.quaternion.log(
            rj.quaternion.multiply(rj.quaternion.conjugate(p), q)
        ),
    }
    table = {name: {"rigidjax": f} for name, f in ours.items()}
    try:
        from jaxlie import SO3
    except ImportError:
        pass
    else:
        theirs = {
            "exp": lambda v, u, p, q: SO3.exp(v).wxyz,
            "exp to matrix": lambda v, u, p, q: SO3.exp(v).as_matrix(),
            "log": lambda v, u, p, q: SO3(q).log(),
            "compose": lambda v, u, p, q: (SO3(p) @ SO3(q)).wxyz,
            "rotate": lambda v, u, p, q: SO3(q) @ u,
            "log of exp": lambda v, u, p, q: SO3.exp(v).log(),
            "attitude error": lambda v, u, p, q: (SO3(p).inverse() @ SO3(q)).log(),
        }
        for name, f in theirs.items():
            table[name]["jaxlie"] = f
    from scipy.spatial.transform import Rotation

    def scipy_quat(r: Rotation) -> Any:
        return r.as_quat(scalar_first=True)

    def of(q: Any) -> Rotation:
        return Rotation.from_quat(q, scalar_first=True)

    theirs = {
        "exp": lambda v, u, p, q: scipy_quat(Rotation.from_rotvec(v)),
        "exp to matrix": lambda v, u, p, q: Rotation.from_rotvec(v).as_matrix(),
        "log": lambda v, u, p, q: of(q).as_rotvec(),
        "compose": lambda v, u, p, q: scipy_quat(of(p) * of(q)),
        "rotate": lambda v, u, p, q: of(q).apply(u),
        "log of exp": lambda v, u, p, q: Rotation.from_rotvec(v).as_rotvec(),
        "attitude error": lambda v, u, p, q: (of(p).inv() * of(q)).as_rotvec(),
    }
    for name, f in theirs.items():
        table[name]["scipy"] = f
    return table


def arguments(n: int, dtype: Any) -> tuple[Any, ...]:
    rng = np.random.default_rng(0)
    c, v, u, p, q = (rng.normal(size=(n, k)) for k in (9, 3, 3, 4, 4))
    p, q = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (p, q))
    return tuple(jnp.asarray(x, dtype) for x in (c, v, u, p, q))


def build(f: Callable, kind: str, n: int) -> Callable:
    """The value, or the product of a row vector with the derivative in everything."""

    def gradient(c: Any, *args: Any) -> Any:
        out, back = jax.vjp(f, *args)
        return back(c.ravel()[: out.size].reshape(out.shape))

    f_ = gradient if kind == "gradient" else (lambda c, *args: f(*args))
    return jax.jit(jax.vmap(f_) if n > 1 else f_)


def seconds(f: Callable, args: tuple[Any, ...], repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        out = f(*args)
    jax.block_until_ready(out)
    return (time.perf_counter() - start) / repeats


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--batch", type=int, default=100_000)
    parser.add_argument("--only", default="")
    parser.add_argument("--float32", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    dtype = jnp.float32 if options.float32 else jnp.float64
    print(f"jax {jax.__version__} on {jax.default_backend()}, {jnp.dtype(dtype).name}\n")
    print(
        "| map | what | batch | ours, µs | ours / jaxlie | ours / scipy |\n|---|---|---|---|---|---|"
    )
    for name, libraries in cases().items():
        if options.only and name != options.only:
            continue
        for kind in ("value", "gradient"):
            for n in (1, options.batch):
                args = arguments(n, dtype)
                if n == 1:
                    args = tuple(x[0] for x in args)
                compiled, expected = {}, None
                for library, f in libraries.items():
                    compiled[library] = build(f, kind, n)
                    got = jax.block_until_ready(compiled[library](*args))
                    if kind == "value":
                        got = np.asarray(got)
                        expected = got if expected is None else expected
                        gap = np.minimum(abs(got - expected), abs(got + expected)).max()
                        assert gap < 1e-4, (name, library, gap)
                repeats = 1000 if n == 1 else 3
                times = {library: [] for library in compiled}
                for _ in range(options.rounds):
                    for library, f in compiled.items():
                        times[library].append(seconds(f, args, repeats))
                middle = {library: np.median(t) for library, t in times.items()}
                ratios = [
                    f"{np.median(np.divide(times['rigidjax'], times[peer])):.2f}"
                    if peer in times
                    else "–"
                    for peer in ("jaxlie", "scipy")
                ]
                ours = 1e6 * middle["rigidjax"]
                print(f"| {name} | {kind} | {n} | {ours:.1f} | {ratios[0]} | {ratios[1]} |")


if __name__ == "__main__":
    main()
