"""A network as a torque: its weights are fitted to recordings, and to windows."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from once import once

import rigidjax as rj
from rigidjax import identify
from rigidjax._types import HasSpin

BODY = rj.Inertia.from_principal(1.0, 1.7, 2.3)
TS = np.linspace(0.0, 3.0, 21)
STARTS = ([1.2, 0.4, -0.9], [-0.5, 1.1, 0.8])


class Cubic(eqx.Module):
    """The true law, −0.1 Ω − 0.2 Ω³."""

    feels: ClassVar[type] = HasSpin

    def __call__(self, t, state, body):
        return -0.1 * state.omega - 0.2 * state.omega**3


class Network(eqx.Module):
    """A torque of the body rate by a network."""

    net: eqx.nn.MLP
    feels: ClassVar[type] = HasSpin

    def __call__(self, t, state, body):
        return self.net(state.omega)


def network():
    key = jax.random.key(3)
    net = eqx.nn.MLP(3, 3, width_size=3, depth=1, activation=jnp.tanh, key=key)
    return Network(jax.tree.map(lambda x: x.astype(float) if eqx.is_array(x) else x, net))


def rates(start):
    return rj.simulate(BODY, rj.Spin(start), TS, Cubic()).ys


def distance(law):
    """The error of a law at the rates of all motions over the size of the true one, rms."""
    omega = jnp.concatenate([rates(start).omega for start in STARTS])
    of = lambda law: once(jax.vmap(lambda w: law(0.0, rj.Spin(w), BODY)))(omega)
    true = of(Cubic())
    return float(jnp.sqrt(jnp.mean((of(law) - true) ** 2) / jnp.mean(true**2)))


WEIGHTS = [
    identify.Free(lambda s, i=i, part=part: getattr(s.torque.net.layers[i], part), f"{part} {i}")
    for i in (0, 1)
    for part in ("weight", "bias")
]


def fitted(fit):
    law = fit.model.scenes(fit.x).torque
    return jax.tree.map(lambda leaf: leaf[0] if eqx.is_array(leaf) else leaf, law)


def test_the_weights_of_a_network_are_fitted_to_recordings():
    records = [
        identify.Recording(TS, (identify.Gyro(1e-3), rates(start).omega)) for start in STARTS
    ]
    model = identify.Model(records, identify.Known(BODY), torque=network(), free=WEIGHTS)
    fit = identify.fit(model, initial=model.start(), max_steps=40)
    assert fitted(fit).net.activation is jnp.tanh
    assert distance(network()) > 0.5 and distance(fitted(fit)) < 0.1


def test_the_weights_of_a_network_are_fitted_to_windows():
    cut = [identify.windows(TS, rates(start), length=5, stride=3) for start in STARTS]
    windows = identify.Windows.join(*cut)
    model = identify.Model(windows, identify.Known(BODY), torque=network(), free=WEIGHTS)
    fit = identify.fit(model, max_steps=60)
    assert fitted(fit).net.activation is jnp.tanh and distance(fitted(fit)) < 0.1
