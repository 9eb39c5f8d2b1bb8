"""Evaluate each part of a torque on the correct side of its jumps in time.

Steps end at stops, the times at which a part of the torque jumps. If two parts jump at the same
time, two stops are made, one slightly after the other. In the short step between the two stops, the
part with the earlier stop has its value after the jump, and the part with the later stop its value
before the jump. The derivatives with respect to the two jump times are then separate.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.motion.torques.base import jump_times_of, require_single
from rigidjax.motion.torques.inputs import Delayed
from rigidjax.motion.torques.piecewise import Held, Linear, Pulses, Tabulated
from rigidjax.motion.torques.states import has_own_states
from rigidjax.solve.times.switching import DECLARED

# These laws of this package have jumps of their own. All other laws of this package only pass on
# the jumps of the laws inside them.
_OWN = (Held, Linear, Pulses, Tabulated, Delayed)


class Sided(eqx.Module):
    """Evaluate a torque law on the correct side of its jumps in time.

    A step that ends at a jump needs the value of the law before the jump. A step that begins at a
    jump needs the value after the jump.
    """

    law: Any  # a torque (t, state, body), or a function of the time
    jumps: Any  # (n,) s, the times at which the law jumps
    # (n,) s, the times at which steps end because of the jumps, from which they differ by at most
    # some units of round-off; `None`: they are equal.
    stops: Any
    sign: Any  # the direction of time: 1, −1 in a run backwards, or `None` for 1
    end: Any  # s, the time at which the run ends

    def __getattr__(self, name: str) -> Any:
        # Attributes that a `Sided` does not have, such as `feels` or `rate_free`, are those of the
        # law that it wraps.
        if name.startswith("__") or name in ("law", "jumps", "stops", "sign", "end"):
            raise AttributeError(name)
        return getattr(self.law, name)

    @property
    def law_name(self) -> str:
        """Return the name of the class of the `law`."""
        return type(self.law).__name__

    def __call__(self, t: Any, *args: Any) -> Any:
        require_single(self.law)
        with jax.named_scope(DECLARED):
            return self.law(self.time_on_correct_side(t), *args)

    def time_on_correct_side(self, t: Any) -> Any:
        """Return t, s, or, if it is on the wrong side of a jump, the nearest time that is not."""
        still = lax.stop_gradient(jnp.asarray(t))
        # The oldest supported JAX has no derivative of `nextafter`, not even inside
        # `stop_gradient`: `stop_gradient` is therefore applied to its argument.
        ahead, behind = (jnp.full_like(still, end) for end in (jnp.inf, -jnp.inf))
        jumps = lax.stop_gradient(self.jumps.astype(still.dtype))
        # At the time of a jump a law has the value after the jump, or that before it, as tables do
        # at their last row. A step that begins there in a run backwards needs the number before the
        # jump, else the next one. The step that ends the run needs the value on its own side.
        jump = jumps[-1:] if self.sign is None and isinstance(self.law, _OWN) else jumps
        if self.sign is not None:
            ahead, behind = (jnp.where(self.sign < 0, -end, end) for end in (ahead, behind))
        now = jnp.where(jnp.any(still == jump), jnp.nextafter(still, ahead), still)
        now = jnp.where(still == self.end, jnp.nextafter(still, behind), now)
        if self.stops is not None:
            stops = self.stops.astype(still.dtype)
            new = now >= stops
            if self.sign is not None:
                new = jnp.where(self.sign < 0, now > stops, new)
            after = jnp.nextafter(jumps, jnp.full_like(jumps, jnp.inf))
            before = jnp.nextafter(jumps, jnp.full_like(jumps, -jnp.inf))
            now = jnp.maximum(now, jnp.max(jnp.where(new, after, -jnp.inf)))
            now = jnp.minimum(now, jnp.min(jnp.where(new, jnp.inf, before)))
        return t + (now - still)


def _declares_jumps(node: Any) -> bool:
    """Return whether a node of a vector field is a law that declares jumps in time.

    A law of this package does if its class has jumps of its own (not only those of a law inside it)
    and the law has at least one jump time; a law of a user if it has the member `jump_times`, even
    if this array is empty.
    """
    if isinstance(node, type) or not hasattr(node, "jump_times"):
        return False
    if type(node).__module__.startswith("rigidjax."):
        return isinstance(node, _OWN) and jump_times_of(node).shape[0] > 0
    return True


def declared_jumps(field: Any) -> list[Array]:
    """Return the jump times, s, of each part of a vector field that has some."""
    parts = filter(_declares_jumps, jax.tree.leaves(field, is_leaf=_declares_jumps))
    return [jumps for part in parts if (jumps := jnp.asarray(jump_times_of(part))).shape[0]]


def evaluate_on_correct_sides(
    field: Any, sign: Array | None, stop_times: list[Array] | None, end: Array
) -> Any:
    """Wrap each part of a vector field that declares jumps in a `Sided`.

    `stop_times` has the `stops` of each such part, in the order of `declared_jumps`; `sign`, `end`
    and `None` are as in `Sided`.
    """
    stops = iter(stop_times or ())

    def on_side(part: Any) -> Any:
        if not _declares_jumps(part):
            return part
        jumps = jnp.asarray(jump_times_of(part))
        own = next(stops, None) if jumps.shape[0] else None
        # A law with states of its own has kinks but no jumps, and later code looks for its class.
        # It is therefore not wrapped.
        return (
            part
            if has_own_states(part)
            else Sided(part, jumps, own, sign if jumps.shape[0] else None, end)
        )

    return jax.tree.map(on_side, field, is_leaf=_declares_jumps)
