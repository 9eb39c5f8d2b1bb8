"""A collision is named, with its time and distance, instead of ever smaller steps."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from rigidjax import _checks
from rigidjax._types import ScalarLike


class TooClose(eqx.Module):
    """Whether a state has come within a scene's smallest distance of one of its bodies.

    A condition for `diffrax.Event`. **Arguments:** `scene` any with `approach(t, state)`, which
    gives the distances and the smallest ones.

    >>> from rigidjax.frames import scenes
    >>> from rigidjax.frames.point import Point
    >>> bool(TooClose(scenes.hill(0.1))(0.0, Point([0.05, 0, 0], [0.0, 0, 0])))
    True
    """

    scene: Any

    def __call__(self, t: ScalarLike, y: Any, args: object = None, **_: object) -> Bool[Array, ""]:
        gaps, least = self.scene.approach(t, y)
        return jnp.any(gaps <= least)


def event(scene: Any) -> dfx.Event | None:
    """The event that ends a run at a collision, or `None` for scenes without bodies to hit.

    >>> from rigidjax.frames import scenes
    >>> event(scenes.earth(0.5)) is None
    True
    """
    close = condition(scene)
    return None if close is None else dfx.Event(close)


def condition(scene: Any) -> TooClose | None:
    """Whether a particle has collided, or `None` for scenes without bodies to hit.

    >>> from rigidjax.frames import scenes
    >>> condition(scenes.earth(0.5)) is None
    True
    """
    return TooClose(scene) if hasattr(scene, "approach") else None


def refuse(ys: Any, stats: dict[str, Any], ts: Any) -> Any:
    """The states `ys`, unless the run has ended in a collision: then an error that says which.

    **Arguments:** `ys` the states saved at `ts`; `stats` with `collided`, `end_time` and
    `end_distances`. **Raises:** `ValueError` with body, time, distance and the last time saved
    before; under `jit` or `vmap` `EquinoxRuntimeError` without the numbers.

    >>> refuse(0.0, {"collided": np.asarray(False)}, None)
    0.0
    """
    hit = stats["collided"]
    advice = "; give throw=False to keep what came before it"
    if not _checks.known(hit):
        words = "simulate: the particle collided with one of the scene's bodies" + advice
        return eqx.error_if(ys, hit, words)
    if not np.any(np.asarray(hit)):
        return ys
    end, gaps = float(stats["end_time"]), np.asarray(stats["end_distances"])
    before = np.asarray(ts)[np.asarray(ts) < end]
    raise ValueError(
        f"simulate: collision with body {int(gaps.argmin()) + 1} of the scene at t = {end:.9g}, "
        f"distance {gaps.min():.3g}; the last of ts before it is {before[-1]:.9g}" + advice
        if len(before)
        else f"simulate: the start touches body {int(gaps.argmin()) + 1} of the scene, distance "
        f"{gaps.min():.3g}"
    )
