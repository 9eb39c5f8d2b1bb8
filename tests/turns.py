"""Rotations of many readings by quaternions (T, 4), each compiled once for all tests of one length."""

import jax
from once import once

import rigidjax as rj

to_world = once(jax.vmap(rj.quaternion.rotate, (0, None)))
to_body = once(jax.vmap(rj.quaternion.rotate_inverse, (0, None)))
# q · exp(e), with one error for each reading.
perturbed = once(jax.vmap(lambda q, e: rj.quaternion.multiply(q, rj.quaternion.exp(e))))
