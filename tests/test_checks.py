"""Functions that a user gives: told apart by their arguments before anything is traced."""

import functools

import jax
import jax.numpy as jnp
import pytest

import rigidjax as rj
from rigidjax import _checks

BODY, START = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
OF = "(t, state, body) → scalar"


def three(t, state, body):
    return state.omega[1]


@pytest.mark.parametrize(
    "function",
    [
        three,
        jax.jit(three),
        functools.partial(lambda level, t, state, body: state.omega[1] - level, 0.5),
        lambda t, state, body=None: state.omega[1],
        lambda *args: args[1].omega[1],
        max,
    ],
)
def test_functions_of_three_arguments_pass(function):
    assert _checks.require_function(function, "condition", OF) is function


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: rj.Event(lambda t, state: t), r"condition: .*other arguments: \(t, state\)"),
        (
            lambda: rj.crossings(BODY, START, 0.0, 1.0, lambda state: state.omega[1]),
            r"condition: wanted a function \(t, state, body\).*other arguments: \(state\)",
        ),
        (
            lambda: rj.lyapunov_exponents(lambda y: -y, jnp.zeros(2), 1.0),
            r"field: wanted a function f\(t, y, args\), got one with other arguments: \(y\)",
        ),
    ],
)
def test_other_arguments_are_named(call, words):
    with pytest.raises(TypeError, match=words):
        call()
