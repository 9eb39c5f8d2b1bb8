"""Loops that a batch goes through together.

Under `jax.vmap` a loop whose condition differs from body to body keeps, after each round, the old
state of those that are through: JAX selects between whole states, and where the state is a record
of 2000 steps that takes longer than the steps. A condition that is one for all leaves the state
alone. The loop's body must then change nothing for those that are through.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


@jax.custom_batching.custom_vmap
def anywhere(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """The flag; under `jax.vmap`, of however many levels, whether any of the batch has it.

    >>> bool(anywhere(jnp.array(False))), jax.vmap(anywhere)(jnp.array([False, True])).tolist()
    (False, [True, True])
    """
    return flag


@anywhere.def_vmap
def _anywhere_of_batch(size: int, batched: Any, flag: Array) -> tuple[Array, bool]:
    del size
    return anywhere(jnp.any(flag, axis=0) if batched[0] else flag), False
