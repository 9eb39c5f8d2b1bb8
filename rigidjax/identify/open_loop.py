"""Open-loop runs of a model from the starts of windows, and their errors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax.identify.windows import Windows
from rigidjax.motion.coupled import Coupled, motion_of, started
from rigidjax.motion.manifold import minus_small
from rigidjax.motion.torques.inputs import bind
from rigidjax.solve import equations_of_motion
from rigidjax.solve.components import split
from rigidjax.solve.equal_steps import in_a_loop
from rigidjax.solve.fixed_loop import first_row, first_rows, step
from rigidjax.solve.steppers import cheapest, stepper_of


def open_loop_errors(
    scene: Any,
    h: float,
    value: Any,
    start: Any,
    wanted: Any,
    inputs: Any,
    steps: Any = None,
) -> Float[Array, "steps n"]:
    """The errors of one window, as changes from the measured states.

    With `steps` given (a traced number: no reverse mode), only the first `steps` of the window
    count; the others are zero.
    """
    body, law = scene(value)
    size, length = jnp.asarray(h, wanted.omega.dtype), wanted.omega.shape[0]
    before = next(iter(inputs.values())).shape[0] - length if inputs else 0
    start = started(body, start, bind(law, first_row(law, size, inputs)), 0.0)
    field = equations_of_motion(body, start, law)
    stepper = stepper_of(in_a_loop(cheapest(field)), field, start)

    def one(y: Any, i: Array) -> tuple[Any, Any]:
        y = step(stepper, size, jnp.zeros_like(size), i, y, inputs or None, before)
        return y, motion_of(stepper.state(y))

    def ahead(y: Any, i: Array) -> tuple[Any, None]:
        # The torque's own states follow the inputs; the body keeps its measured state.
        y = step(stepper, size, jnp.zeros_like(size), i, y, inputs, before)
        return split(Coupled(start.motion, stepper.state(y).own)), None

    y0 = stepper.start
    if before and isinstance(start, Coupled):
        y0, _ = lax.scan(ahead, y0, jnp.arange(-before, 0, dtype=jnp.int32))
    states = first_rows(length if steps is None else steps, one, y0, wanted)
    return jax.vmap(minus_small)(states, wanted)


@eqx.filter_jit
def all_errors(windows: Windows, scene: Any, value: Any) -> Float[Array, "windows steps n"]:
    """The errors of a model with these numbers."""

    def one(window: Any) -> Array:
        return open_loop_errors(scene, windows.step, value, *window)

    parts = (windows.starts, windows.wanted, windows.inputs)
    return lax.map(one, parts, batch_size=min(128, windows.count))
