"""A method as the measurement sees it: something that is made ready for a scene, and then run."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rigidjax.workprecision.scene import Scene


class Run(NamedTuple):
    """What one run gives.

    **Fields:** `numbers` the last state (or the gradient) as one vector; `steps` taken.

    >>> float(Run([0.0, 1.0], 12).steps)
    12.0
    """

    numbers: Any
    steps: float


class Ready(NamedTuple):
    """A method made ready for a scene.

    **Fields:** `run` setting → `Run`, complete when it returns; `compile` s that making it took,
    `memory` bytes of temporaries, each NaN where unknown.

    >>> ready = Ready(lambda setting: Run([0.0, 1.0], 1 / setting))
    >>> ready.run(1e-2).steps, ready.compile
    (100.0, nan)
    """

    run: Callable[[float], Run]
    compile: float = float("nan")
    memory: float = float("nan")


class Method(NamedTuple):
    """A method to compare; give your own, or a peer's, to `measure` as one of these.

    **Fields:** `name`; `group` `ours`, `jax` (anything else that runs in JAX) or `peer`;
    `settings` tolerances, or numbers of equal steps, from coarse to fine; `value` makes it ready
    for a scene, `None` where it cannot do that one; `gradients` adjoint → the same for the gradient
    of the scene's scalar by its `numbers`; `equal` whether settings are numbers of steps for a run
    of 50 rad, to be scaled to the scene.

    >>> import numpy as np
    >>> ready = Ready(lambda setting: Run(np.ones(7), 0))
    >>> guess = Method("a guess", "peer", (1e-3,), lambda scene: ready)
    >>> guess.gradients
    {}
    """

    name: str
    group: str
    settings: Sequence[float]
    value: Callable[[Scene], Ready | None]
    gradients: dict[str, Callable[[Scene], Ready | None]] = {}  # noqa: RUF012
    equal: bool = False
