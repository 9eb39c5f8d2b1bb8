"""A scene may end a run, instead of ever smaller steps: at a collision, where it is lost, …"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool

from rigidjax import _checks
from rigidjax._types import ScalarLike


class Ends(eqx.Module):
    """The condition that ends a run of `scene`, as `diffrax.Event` asks it.

    **Arguments:** `scene` any with `ends(t, state) → bool` and `end_words(t, state) → str`.

    >>> from rigidjax import orbits
    >>> bool(Ends(orbits.hill(0.1))(0.0, rj.Point([0.05, 0, 0], [0.0, 0, 0])))
    True
    """

    scene: Any

    def __call__(self, t: ScalarLike, y: Any, args: object = None, **_: object) -> Bool[Array, ""]:
        return self.scene.ends(t, y)


def condition(scene: Any) -> Ends | None:
    """When a run ends, or `None` for scenes that end none.

    >>> from rigidjax.frames import scenes
    >>> condition(scenes.earth(0.5)) is None
    True
    """
    return Ends(scene) if hasattr(scene, "ends") else None


def refuse(scene: Any, ys: Any, stats: dict[str, Any], ts: Any) -> Any:
    """The states `ys`, unless the scene has ended the run: then an error in the scene's words.

    **Arguments:** `scene` as of `Ends`; `ys` the states saved at `ts`; `stats` with `ended`,
    `end_time` and `end_state`. **Raises:** `ValueError` with the last time saved before; under
    `jit` or `vmap` `EquinoxRuntimeError` without numbers.

    >>> refuse(None, 0.0, {"ended": np.asarray(False)}, None)
    0.0
    """
    ended, advice = stats["ended"], "; give throw=False to keep what came before it"
    if _checks.known(ended) and not np.any(np.asarray(ended)):
        return ys
    words = "simulate: " + scene.end_words(stats["end_time"], stats["end_state"])
    if not _checks.known(ended):
        return eqx.error_if(ys, ended, words + advice)
    before = np.asarray(ts)[np.asarray(ts) < float(stats["end_time"])]
    last = f"the last of ts before it is {before[-1]:.9g}{advice}" if len(before) else "the start"
    raise ValueError(f"{words}; {last}")
