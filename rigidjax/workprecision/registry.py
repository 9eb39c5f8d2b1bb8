"""All methods that can be compared here."""

from rigidjax import _checks
from rigidjax.workprecision.jax_methods import methods_in_jax
from rigidjax.workprecision.method import Method
from rigidjax.workprecision.peers import methods_outside


def methods(group: str | None = None) -> list[Method]:
    """The methods that can be compared here: ours, others in JAX, and the peers installed.

    **Arguments:** `group` `ours`, `jax` or `peer` for those alone.

    >>> [method.name for method in methods("ours")][:2]
    ['closed form', 'simulate']
    """
    if group is not None:
        _checks.word(group, ("ours", "jax", "peer"), "group")
    found = [*methods_in_jax(), *methods_outside()]
    return [method for method in found if group in (None, method.group)]
