"""A neural torque in `simulate` beside plain diffrax by hand: `python tests/benchmarks/solve/bench_neural_torque.py`.

An `eqx.nn.MLP` (6, 16, 3) gives the torque from the direction of gravity and the body rate. Printed for
each scene (bodies, seconds, saved times, tolerance), in ms of CPU time: the value of a loss, and a training
step with its gradient (optax's adam); medians of seven, interleaved. By hand: Tsit5 as in a textbook (a
rotation matrix, the tensor, `jnp.linalg.solve`), then Tsit5 and Dopri8 written in components.
"""

import statistics
import time

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optax

jax.config.update("jax_enable_x64", True)

import rigidjax as rj

SCENES = ((1, 20.0, 201, 1e-6), (8, 4.0, 41, 1e-6), (8, 4.0, 41, 1e-9))
MOMENTS = jnp.array([1.0, 1.6, 2.2])
BODY, TENSOR = rj.Inertia.from_principal(1.0, 1.6, 2.2), jnp.diag(MOMENTS)
DOWN, Q = jnp.array([0.0, 0.0, -1.0]), jnp.array([1.0, 0.0, 0.0, 0.0])
ADAM = optax.adam(3e-2)


class Network(eqx.Module):
    net: eqx.nn.MLP

    def __call__(self, t, state, body):
        gravity = rj.quaternion.rotate_inverse(state.q, DOWN)
        return self.net(jnp.concatenate([gravity, state.omega]))


def turning(q, omega):
    a, x, y, z = q
    p, r, s = omega
    return 0.5 * jnp.array(
        [
            -x * p - y * r - z * s,
            a * p + y * s - z * r,
            a * r + z * p - x * s,
            a * s + x * r - y * p,
        ]
    )


def textbook(t, y, net):
    q, omega = y
    w, a, b, c = q / jnp.linalg.norm(q)
    matrix = jnp.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )
    torque = net(jnp.concatenate([matrix.T @ DOWN, omega]))
    change = jnp.linalg.solve(TENSOR, torque - jnp.cross(omega, TENSOR @ omega))
    return turning(jnp.stack([w, a, b, c]), omega), change


def components(t, y, net):
    q, omega = y
    w, a, b, c = q = q / jnp.linalg.norm(q)
    gravity = -jnp.stack([2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)])
    torque = net(jnp.concatenate([gravity, omega]))
    return turning(q, omega), (torque - jnp.cross(omega, MOMENTS * omega)) / MOMENTS


def programs(run, starts):
    """The value of a loss and a training step, compiled."""

    def loss(law):
        return jnp.mean((jax.vmap(lambda omega: run(law, omega))(starts) - 0.5) ** 2)

    @eqx.filter_jit
    def step(law, memory):
        value, slope = eqx.filter_value_and_grad(loss)(law)
        change, memory = ADAM.update(slope, memory)
        return eqx.apply_updates(law, change), memory, value

    return eqx.filter_jit(loss), step


def measure(count, end, saves, tolerance):
    starts, ts = jax.random.normal(jax.random.key(0), (count, 3)), jnp.linspace(0.0, end, saves)
    law = Network(eqx.nn.MLP(6, 3, 16, 1, activation=jnp.tanh, key=jax.random.key(2)))
    memory = ADAM.init(eqx.filter(law, eqx.is_array))

    def ours(law, omega):
        state = rj.Attitude(Q, omega)
        return rj.simulate(BODY, state, ts, law, rtol=tolerance, atol=tolerance).ys.omega

    def by_hand(field, solver):
        def run(law, omega):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                solver,
                0.0,
                end,
                None,
                (Q, omega),
                law.net,
                saveat=diffrax.SaveAt(ts=ts),
                stepsize_controller=diffrax.PIDController(tolerance, tolerance),
            ).ys[1]

        return run

    ways = {
        "rigidjax": ours,
        "textbook, Tsit5": by_hand(textbook, diffrax.Tsit5()),
        "components, Tsit5": by_hand(components, diffrax.Tsit5()),
        "components, Dopri8": by_hand(components, diffrax.Dopri8()),
    }
    calls = {}
    for name, run in ways.items():
        value, step = programs(run, starts)
        jax.block_until_ready((value(law), step(law, memory)))
        calls[name, "value"] = lambda value=value: value(law)
        calls[name, "step"] = lambda step=step: step(law, memory)
    spent = {key: [] for key in calls}
    for _ in range(7):
        for key, call in calls.items():
            before = time.process_time()
            for _ in range(5):
                jax.block_until_ready(call())
            spent[key].append((time.process_time() - before) / 5 * 1e3)
    print(f"\n{count} bodies, {end:g} s, {saves} saved times, tolerance {tolerance:g}: CPU ms")
    for name in ways:
        value, step = (statistics.median(spent[name, kind]) for kind in ("value", "step"))
        print(f"{name:20} value {value:6.2f}  training step {step:6.2f}")


if __name__ == "__main__":
    for scene in SCENES:
        measure(*scene)
