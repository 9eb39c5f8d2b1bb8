"""A function compiled as one kernel is the same function, in batches and in derivatives, too."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.rotation import barrier
from rigidjax.rotation.barrier import match_batch_axes, one_kernel

LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"
OLDER = "--xla_cpu_use_fusion_emitters=false"


def partly_shared(a, b):
    return 2.0 * a, jnp.zeros_like(a) + 3.0, a * jnp.sin(b)


@pytest.mark.parametrize("axes", [(None, 0), (0, None), (0, 0)])
def test_a_derivative_of_its_batch_under_jit(axes):
    """Results that a batch shares: JAX gave the derivatives of all bodies to each."""
    a, b = (jnp.arange(1.0, 4.0) if axis == 0 else jnp.array(0.7) for axis in axes)
    one, plain = jax.jit(one_kernel(partly_shared)), partly_shared
    found, wanted = (
        jax.jit(lambda a, b, f=f: jax.jvp(jax.vmap(f, axes), (a, b), (2 * a, -b)))(a, b)
        for f in (one, plain)
    )
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.oldest
@pytest.mark.parametrize("axes", [(None, 0), (0, None), (0, 0)])
def test_a_second_derivative_of_its_batch_under_jit(axes):
    """The derivative of a kernel repeats its values, which are differentiated in their turn."""
    a, b = (jnp.arange(1.0, 4.0) if axis == 0 else jnp.array(0.7) for axis in axes)
    kernel = jax.vmap(one_kernel(partly_shared), axes)

    def along(a, b):
        return jax.jvp(kernel, (a, b), (jnp.ones_like(a), jnp.ones_like(b)))

    steps = 2.0 * jnp.ones_like(a), jnp.ones_like(b)
    (value, change), (slope, second) = jax.jit(lambda: jax.jvp(along, (a, b), steps))()
    # Of a sin b: by (1, 1), by (2, 1), and by both.
    np.testing.assert_allclose(value[2], a * jnp.sin(b), rtol=1e-15)
    np.testing.assert_allclose(change[2], jnp.sin(b) + a * jnp.cos(b), rtol=1e-15)
    np.testing.assert_allclose(slope[2], 2 * jnp.sin(b) + a * jnp.cos(b), rtol=1e-15)
    np.testing.assert_allclose(second[2], 3 * jnp.cos(b) - a * jnp.sin(b), rtol=1e-14)


def test_a_constant_with_a_derivative():
    """As entries that are zero by choice of the axes; all is linear: the slope is 4 exactly."""

    @jax.custom_jvp
    def zero(x):
        return match_batch_axes(jnp.zeros_like(x), x)

    zero.defjvp(lambda primals, tangents: (zero(*primals), tangents[0]))
    batch = jax.vmap(jax.jit(lambda x: 2.0 * zero(x) + 1.0))
    slope = jax.grad(lambda x: jnp.sum(batch(x) ** 2))(jnp.arange(3.0))
    np.testing.assert_array_equal(slope, [4.0, 4.0, 4.0])


@pytest.mark.parametrize(
    ("release", "flags", "wanted"),
    [
        ((0, 10, 1), "", f"{LOOPS} {OLDER}"),
        ((0, 10, 1), "--a=1", f"{LOOPS} {OLDER} --a=1"),
        ((0, 10, 1), "--xla_cpu_use_fusion_emitters=true", f"{LOOPS} --xla_cpu_use_fusion_emitters=true"),
        ((0, 10, 1), *2 * (f"{OLDER} {LOOPS}",)),
        ((0, 11, 2), *2 * ("--a=1",)),
    ],
)  # fmt: skip
def test_flags_are_set_where_they_help(release, flags, wanted, monkeypatch):
    monkeypatch.setattr(jax, "__version_info__", release)
    monkeypatch.setenv("XLA_FLAGS", flags)
    rj.set_xla_flags()
    assert os.environ["XLA_FLAGS"] == wanted


RUNS = """
import os, sys
import jax
jax.config.update("jax_enable_x64", True)
import rigidjax as rj
if len(sys.argv) > 1:
    rj.set_xla_flags()
body = rj.Inertia.from_principal(1.6, 2.0, 3.0)
def last(omega, torque=None):
    return rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], omega), [0.0, 1.0], torque).ys.omega[-1]
start = jax.numpy.array([0.5, 1.0, 6.0])
last(start)
print("free", file=sys.stderr)
law = rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0.0, 0.0, -9.81])
last(start, law)
compiled = jax.jit(lambda w: last(w, law)).lower(start).compile()
compiled(start)
print("xla_cpu_small_call" in compiled.as_text())
"""


@pytest.mark.oldest
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of a processor")
def test_a_process_without_the_option_of_loops_says_so_once():
    env = {**os.environ, "XLA_FLAGS": "", "PYTHONPATH": str(Path(rj.__file__).parents[1])}
    # Of each program that it loads from a cache, XLA 0.10 has something to say.
    env.pop("JAX_COMPILATION_CACHE_DIR", None)
    how = dict(env=env, capture_output=True, text=True, check=True)
    plain, flagged = (
        subprocess.run([sys.executable, "-c", RUNS, *given], **how) for given in ([], ["set"])
    )
    assert flagged.stderr == "free\n" and flagged.stdout == "True\n"
    before, after = plain.stderr.split("free\n")
    many = jax.__version_info__ < (0, 11)
    assert before == "" and after.count(LOOPS) == many and plain.stdout == f"{not many}\n"


@pytest.mark.parametrize(("release", "flags", "said"), [(10, "", 1), (10, LOOPS, 0), (11, "", 0)])
def test_slow_loops_are_said(release, flags, said, monkeypatch):
    monkeypatch.setattr(jax, "__version_info__", (0, release, 0))
    monkeypatch.setenv("XLA_FLAGS", flags)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        barrier.warn_of_slow_loops.__wrapped__()
    assert [LOOPS in str(one.message) for one in found] == [True] * (
        said and jax.default_backend() == "cpu"
    )
