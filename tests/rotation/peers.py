"""Our figure beside each peer's where rotations fail: `python -m tests.rotation.peers [file.md]`.

Rows R1–R10 of the project's failure list, measured here and now, never typed in. Needs the extra
`peers`; a peer that is not installed is left out. Writes a markdown table. Not a test: the bars are
asserted in this directory's tests.
"""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import importlib.metadata
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation as JaxRotation
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax.rotation import euler

try:
    from jaxlie import SO3
except ImportError:
    SO3 = None

AXES = np.random.default_rng(0).normal(size=(50, 3))
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)


def libraries() -> dict[str, dict[str, Callable]]:
    """Each library's own functions, brought to one form: q is (w, x, y, z)."""
    table = {
        "rigidjax": {
            "exp": rj.quaternion.exp,
            "log": rj.quaternion.log,
            "matrix": rj.so3.exp,
            "log matrix": rj.so3.log,
            "multiply": rj.quaternion.multiply,
            "project": rj.so3.project,
            "euler": lambda m: euler.from_matrix(m, "ZXZ"),
            "from euler": lambda a: euler.to_matrix(a, "ZXZ"),
        }
    }
    if SO3 is not None:
        table["jaxlie"] = {
            "exp": lambda v: SO3.exp(v).wxyz,
            "log": lambda q: SO3(q).log(),
            "matrix": lambda v: SO3.exp(v).as_matrix(),
            "log matrix": lambda m: SO3.from_matrix(m).log(),
            "multiply": lambda p, q: (SO3(p) @ SO3(q)).wxyz,
            # jaxlie's only angles: roll, pitch, yaw, extrinsic xyz.
            "singular at": np.pi / 2,
            "euler": lambda m: jnp.stack(list(SO3.from_matrix(m).as_rpy_radians())),
            "from euler": lambda a: SO3.from_rpy_radians(a[0], a[1], a[2]).as_matrix(),
        }

    def of(q: Any) -> Rotation:
        return Rotation.from_quat(q, scalar_first=True)

    table["scipy on JAX"] = {
        "exp": lambda v: Rotation.from_rotvec(v).as_quat(scalar_first=True),
        "log": lambda q: of(q).as_rotvec(),
        "matrix": lambda v: Rotation.from_rotvec(v).as_matrix(),
        "log matrix": lambda m: Rotation.from_matrix(m).as_rotvec(),
        "multiply": lambda p, q: (of(p) * of(q)).as_quat(scalar_first=True),
        "project": lambda m: Rotation.from_matrix(m).as_matrix(),
        "euler": lambda m: Rotation.from_matrix(m, assume_valid=True).as_euler("ZXZ"),
        "from euler": lambda a: Rotation.from_euler("ZXZ", a).as_matrix(),
    }

    def first(q: Any) -> Any:
        return jnp.roll(q, 1)

    def from_first(q: Any) -> Any:
        return JaxRotation.from_quat(jnp.roll(q, -1))

    table["jax.scipy"] = {
        "exp": lambda v: first(JaxRotation.from_rotvec(v).as_quat()),
        "log": lambda q: from_first(q).as_rotvec(),
        "matrix": lambda v: JaxRotation.from_rotvec(v).as_matrix(),
        "log matrix": lambda m: JaxRotation.from_matrix(m).as_rotvec(),
        "multiply": lambda p, q: first((from_first(p) * from_first(q)).as_quat()),
        "euler": lambda m: JaxRotation.from_matrix(m).as_euler("ZXZ"),
        "from euler": lambda a: JaxRotation.from_euler("ZXZ", a).as_matrix(),
    }
    return table


def worst(x: Any) -> float:
    """Largest absolute value; NaN wins."""
    return float(np.max(np.abs(np.asarray(x, np.float64))))


def log_of_exp_jacobian(f: dict, angle: float, dtype: Any, route: str) -> float:
    """|J − 1| of log∘exp, reverse mode, worst of the axes."""
    both = {
        "q": lambda v: f["log"](f["exp"](v)),
        "m": lambda v: f["log matrix"](f["matrix"](v)),
    }[route]
    v = jnp.asarray(AXES * angle, dtype)
    one = np.eye(3)[None]
    return worst(np.asarray(jax.jit(jax.vmap(jax.jacrev(both)))(v), np.float64) - one)


def log_value(f: dict, gap: float, dtype: Any) -> float:
    """|log − v| at π − gap up to the sign there, v exact, through the quaternion."""
    v = AXES * (np.pi - gap)
    half = (np.pi - gap) / 2
    q = np.concatenate([np.full((len(v), 1), np.cos(half)), np.sin(half) * AXES], axis=1)
    if dtype == jnp.float64:
        # cos(π/2 − gap/2) to full accuracy.
        q[:, 0] = np.sin(gap / 2)
    got = np.asarray(jax.jit(jax.vmap(f["log"]))(jnp.asarray(q, dtype)), np.float64)
    return float(np.minimum(abs(got - v).max(1), abs(got + v).max(1)).max())


def half_turn_slope(f: dict, dtype: Any) -> float:
    """Norm of ∇|log|² at exactly half a turn (true 4π in the scalar part)."""
    q = jnp.asarray(np.concatenate([[0.0], AXES[0]]), dtype)
    return float(abs(jax.jit(jax.grad(lambda q: (f["log"](q) ** 2).sum()))(q)[0]))


def rest(f: dict, dtype: Any) -> float:
    """|d(attitude)/dω − T 1| at ω = 0, T = 1."""
    return log_of_exp_jacobian(f, 0.0, dtype, "q")


def angle(f: dict, dtype: Any) -> float:
    """Relative error of the angle of a rotation by 1e-9 (float32: 1e-6), from its matrix."""
    size = 1e-9 if dtype == jnp.float64 else 1e-6
    m = rj.so3.exp(jnp.asarray(AXES[0] * size, dtype))
    return abs(float(jnp.linalg.norm(f["log matrix"](m))) / size - 1)


def projection(f: dict, dtype: Any) -> float:
    """|J − truth| of the projection at a rotation R: truth is E ↦ R skew(RᵀE)."""
    r = np.asarray(rj.so3.exp(jnp.asarray([0.3, -1.0, 0.5])), np.float64)
    e = np.random.default_rng(1).normal(size=(3, 3))
    got = jax.jacrev(f["project"])(jnp.asarray(r, dtype))
    truth = r @ (r.T @ e - e.T @ r) / 2
    return worst(np.einsum("ijkl,kl->ij", np.asarray(got, np.float64), e) - truth)


def gimbal(f: dict, apart: float, dtype: Any) -> float:
    """|R(angles(R)) − R| near the singular case of the library's own angles."""
    a = jnp.asarray([1.0, f.get("singular at", 0.0) - apart, -2.0], dtype)
    m = f["from euler"](a)
    return worst(np.asarray(f["from euler"](f["euler"](m)), np.float64) - np.asarray(m, np.float64))


def drift(f: dict, dtype: Any) -> float:
    """||q| − 1| after 1e5 products as the library makes them (ours: normalised after each)."""
    step = rj.quaternion.exp(jnp.asarray([1e-3, 2e-3, -1.5e-3], dtype))
    ours = f["multiply"] is rj.quaternion.multiply
    clean = rj.quaternion.normalise if ours else (lambda q: q)

    def body(_: Any, q: Any) -> Any:
        return clean(f["multiply"](q, step))

    q = jax.jit(lambda q: jax.lax.fori_loop(0, 100_000, body, q))(step)
    return abs(float(np.linalg.norm(np.asarray(q, np.float64))) - 1)


def cover(f: dict, dtype: Any) -> float:
    """|log(q) − log(−q)|, worst of many."""
    q = jax.vmap(rj.quaternion.exp)(jnp.asarray(AXES * 2, dtype))
    log = jax.jit(jax.vmap(f["log"]))
    return worst(log(q) - log(-q))


def rows(dtype: Any) -> list[tuple[str, Callable, float | None]]:
    """Text, measurement, and our bar."""
    double = dtype == jnp.float64
    tight, near = (1e-13, 1e-12) if double else (2e-6, 1e-5)
    gap = 1e-10 if double else 1e-5

    def jacobian(t: float, route: str) -> Callable:
        return lambda f: log_of_exp_jacobian(f, t, dtype, route)

    out: list[tuple[str, Callable, float | None]] = []
    for t in (0.0, 1e-12, 1e-8, 1e-3, 1.0):
        out.append((f"R1 J(log∘exp) − 1, θ = {t:g}", jacobian(t, "q"), tight))
        out.append((f"R1 the same through matrices, θ = {t:g}", jacobian(t, "m"), tight))
    out += [
        ("R2 d(attitude)/dω at rest", lambda f: rest(f, dtype), tight),
        (f"R3 log at π − {gap:g}", lambda f: log_value(f, gap, dtype), 4e-15 if double else 1e-6),
        ("R4 J(log∘exp) − 1 at π − 0.0001", jacobian(np.pi - 1e-4, "q"), near),
        (f"R4 J(log∘exp) − 1 at π − {gap:g}", jacobian(np.pi - gap, "q"), near),
        ("R4 slope of \\|log\\|² at π (true 12.566)", lambda f: half_turn_slope(f, dtype), None),
        ("R5 relative error of a tiny angle", lambda f: angle(f, dtype), 1e-6),
        ("R6 derivative of the projection", lambda f: projection(f, dtype), tight),
    ]
    for e in (0.0, 1e-9, 1e-4):
        text = f"R8 R(angles(R)) − R, {e:g} from the singular case"
        out.append((text, lambda f, e=e: gimbal(f, e, dtype), 1e-14 if double else 1e-6))
    return [
        *out,
        ("R9 norm after 1e5 products", lambda f: drift(f, dtype), 1e-14 if double else 2e-7),
        ("R10 log(q) − log(−q)", lambda f: cover(f, dtype), 0.0),
    ]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    table = libraries()
    packages = ["jax", "scipy"] + (["jaxlie"] if SO3 is not None else [])
    versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in packages)
    lines = [
        "Made by `python -m tests.rotation.peers`. Errors; – is not offered.",
        f"Measured with {versions} on {jax.default_backend()}.",
        "",
    ]
    lines.append("| row | precision | bar | " + " | ".join(table) + " |")
    lines.append("| --- | --- | --- |" + " --- |" * len(table))
    for dtype in (jnp.float64, jnp.float32):
        for text, measure, bar in rows(dtype):
            cells = []
            for functions in table.values():
                try:
                    cells.append(f"{measure(functions):.1e}")
                except KeyError:
                    cells.append("–")
                except Exception as error:  # a peer that refuses is a finding, not a failure
                    cells.append(type(error).__name__)
            shown = "" if bar is None else f"{bar:g}"
            cells = [text, jnp.dtype(dtype).name, shown, *cells]
            lines.append("| " + " | ".join(cells) + " |")
            print(lines[-1], file=sys.stderr)
    text = "\n".join(lines) + "\n"
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text)
    print(text)


if __name__ == "__main__":
    main()
