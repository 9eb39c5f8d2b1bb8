"""Strict JAX, and every public signature checked at run time (jaxtyping + beartype)."""

import gc
import importlib
import itertools
import os
from pathlib import Path

import pytest

# What `import rigidjax` leaves until it is asked for: imported here under the hook.
LATER = (
    "datasets",
    "elliptic",
    "lagrangian",
    "orbits",
    "plot",
    "suspensions",
    "tumblers",
    "workprecision",
)


def pytest_configure(config):
    """Compiled programs are kept beside pytest's own cache: the next run takes a third of the time.

    By the environment, so that processes which tests start find them, too.
    """
    if hasattr(config, "cache") and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(config.cache.mkdir("jax"))
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    # Threads of OpenBLAS wait busily for one another: where all cores are taken, the QR of some
    # thousand small matrices took 0.55 s of the processor by one thread and 115 s by two.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The process that shares tests out to others runs none, and they wait for it.
    if not config.getoption("numprocesses", None) or hasattr(config, "workerinput"):
        _load(config.option.markexpr in ("not slow and not long", "long and not slow"))


def _load(default_run):
    import equinox
    import jax
    from jaxtyping import install_import_hook

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    # A plugin may have imported JAX before its environment was set.
    if folder := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", folder)
        seconds = os.environ.get("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1")
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(seconds))

    # Fits and searches for orbits are the largest programs, and are not measured in round-off: in a
    # default run they are compiled as `once` does, in a long run as users compile them.
    once = importlib.import_module("once")
    once.ask(default_run)
    usual = once.library_programs(("rigidjax.identify", "rigidjax.orbits", "rigidjax.tumblers"))
    with install_import_hook("rigidjax", "beartype.beartype"):
        for name in ("rigidjax", *(f"rigidjax.{late}" for late in LATER)):
            importlib.import_module(name)
    equinox.filter_jit = usual

    # As the command line does; but long tests are compiled by the emitters that users have.
    if not default_run and jax.__version_info__ < (0, 11):
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=true"
    importlib.import_module("rigidjax").set_xla_flags()

    # Traced programs are millions of objects that all stay: to look through them again and again
    # for garbage is a tenth of the time.
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)


# Tests that took two and a half seconds or more of a run beside others; of many cases the shortest stays.
MARKED = {
    mark: frozenset((Path(__file__).parent / name).read_text(encoding="utf-8").splitlines())
    for mark, name in (("long", "long.txt"), ("slow", "slow.txt"))
}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        for mark, listed in MARKED.items():
            if item.nodeid in listed:
                item.add_marker(mark)


_MAPS, _MANY, _TESTS = Path("/proc/self/maps"), 45_000, itertools.count()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Half of the tests each, in order: neighbours share compiled programs. Then help each other."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getoption("dist") == "load" else None


@pytest.fixture(autouse=True)
def room_for_programs():
    """Linux lets a process have 65530 memory maps, and every compiled program takes some.

    Beyond that XLA ends in a segmentation fault: so programs are forgotten in time.
    """
    import jax

    yield
    if next(_TESTS) % 10 == 0 and _MAPS.exists():
        with _MAPS.open() as lines:
            many = sum(1 for _ in lines)
        if many > _MANY:
            jax.clear_caches()
            gc.collect()


@pytest.fixture
def unhooked():
    """Users run without the jaxtyping hook: so do the tests of what they read on a mistake."""
    from jaxtyping import config

    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
