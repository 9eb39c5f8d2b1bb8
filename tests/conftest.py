"""Strict JAX, and every public signature checked at run time (jaxtyping + beartype)."""

import jax
import pytest
from jaxtyping import config, install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

with install_import_hook("rigidjax", "beartype.beartype"):
    import rigidjax  # noqa: F401


@pytest.fixture
def unhooked():
    """Users run without the jaxtyping hook: so do the tests of what they read on a mistake."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
