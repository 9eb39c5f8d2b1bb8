"""Two processes: the same bits as one. Two devices: the same but for the last bit."""

import os
import socket
import subprocess
import sys
import textwrap
import time

import pytest

HEAD = """
import sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import rigidjax as rj
rng = np.random.default_rng(0)
count = 21
bodies = rj.Inertia(jnp.asarray(rng.uniform(1, 1.9, (count, 3)))[:, None] * jnp.eye(3))
q = rng.normal(size=(count, 4)); q /= np.linalg.norm(q, axis=1)[:, None]
states = rj.Attitude(q, rng.normal(size=(count, 3)))
top = rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -1])
def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))
"""


def start(code, devices=1, *arguments):
    flags = f"--xla_force_host_platform_device_count={devices}"
    env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [sys.executable, "-c", HEAD + textwrap.dedent(code), *map(str, arguments)],
        env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def port():
    with socket.socket() as s:
        s.bind(("localhost", 0))
        return s.getsockname()[1]


def test_two_devices():
    code = """
    assert len(jax.devices()) == 2
    run = lambda law, **more: rj.batch.rollout(bodies, states, 0.05, 9, law, chunk=4, **more)
    assert same(run(None), run(None, devices="all")), "rollout"
    # XLA orders products of what all bodies share in another way when it cuts a program in two.
    one, two = run(top), run(top, devices="all")
    assert max(np.abs(one.q - two.q).max(), np.abs(one.omega - two.omega).max()) < 1e-15
    print("equal")
    """
    out, _ = start(code, 2).communicate(timeout=300)
    assert out.strip().endswith("equal"), out


@pytest.mark.slow
def test_two_devices_adaptive_and_reverse():
    code = """
    run = lambda **more: rj.batch.simulate(bodies, states, [0.0, 1.0, 3.0], top, chunk=4, **more)
    one, two = run(), run(devices="all")
    assert np.abs(one.ys.q - two.ys.q).max() < 1e-11 and same(one.num_steps, two.num_steps)
    free = lambda **more: rj.batch.simulate(bodies, states, [0.0, 3.0], chunk=4, **more).ys
    assert same(free(), free(devices=jax.devices())), "closed form"
    def loss(com, **more):
        law = rj.torques.HeavyTop(1.0, com, [0.0, 0, -1])
        return jnp.sum(rj.batch.rollout(bodies, states, 0.05, 4, law, chunk=4, **more).omega[:, 0])
    for derivative in (jax.grad, jax.jacfwd):
        one = derivative(loss)(top.com)
        two = derivative(lambda com: loss(com, devices="all"))(top.com)
        assert np.abs(one - two).max() < 1e-14, "derivative by what all share"
    print("equal")
    """
    out, _ = start(code, 2).communicate(timeout=600)
    assert out.strip().endswith("equal"), out


JOIN = """
port, here = sys.argv[1:3]
rj.batch.distributed.connect(f"localhost:{port}", 2, int(here), patience=10)
"""


def test_two_processes():
    code = """
    mine = rj.batch.distributed.share((bodies, states))
    assert mine[1].q.shape[0] in (10, 11)
    run = lambda b, s: rj.batch.rollout(b, s, 0.05, 9, top, chunk=4)
    found = rj.batch.distributed.gather(run(*mine))
    assert same(found, run(bodies, states)), "gathered"
    assert rj.batch.distributed.total(jnp.asarray(float(jax.process_index()))) == 1.0
    print("equal")
    """
    at = port()
    peers = [_joined(code, at, here) for here in (0, 1)]
    for peer in peers:
        out, _ = peer.communicate(timeout=300)
        assert peer.returncode == 0 and "equal" in out, out


def _joined(code, at, here):
    head, rest = HEAD.split("rng = ", 1)
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}
    env.pop("XLA_FLAGS", None)
    whole = head + JOIN + "rng = " + rest + textwrap.dedent(code)
    return subprocess.Popen(
        [sys.executable, "-c", whole, str(at), str(here)],
        env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.mark.slow
def test_a_dead_peer_ends_the_run(tmp_path):
    code = f"""
    mine = rj.batch.distributed.share(states)
    rj.batch.distributed.gather(mine)
    print("ready", flush=True)
    if int(here) == 1:
        import os, signal
        os.kill(os.getpid(), signal.SIGKILL)
    rj.batch.distributed.gather(mine, checkpoint={str(tmp_path)!r})
    print("gathered")
    """
    at = port()
    peers = [_joined(code, at, here) for here in (0, 1)]
    peers[1].communicate(timeout=300)
    begin = time.monotonic()
    out, _ = peers[0].communicate(timeout=120)
    assert time.monotonic() - begin < 60
    assert peers[0].returncode != 0 and "gathered" not in out
    assert "another process did not answer" in out and "share-0.npz" in out, out
    assert (tmp_path / "share-0.npz").exists()
