"""A scene of one's own that ends its runs, under our adjoint and diffrax's."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj


class Fall(rj.frames.AbstractScene):
    """Free fall onto the ground z = 0."""

    def acceleration(self, t, state):
        return jnp.array([0.0, 0.0, -9.81])

    def conserved(self, t, state):
        return {}

    def ends(self, t, state):
        return state.x[2] <= 0

    def end_words(self, t, state):
        return "the ground was reached"


@pytest.mark.parametrize("solver", [None, dfx.Dopri5()])
def test_a_scene_of_ones_own_ends_a_run(solver):
    ts, start = np.linspace(0.0, 2.0, 21), rj.Point([0.0, 0, 5.0], [1.0, 0, 0])
    out = rj.simulate(None, start, ts, Fall(), solver=solver, throw=False)
    # A run ends at the end of the step in which it meets the condition: z = 5 − 9.81 t²/2.
    end = float(out.stats["end_time"])
    assert bool(out.stats["ended"]) and end >= np.sqrt(10 / 9.81)
    state = out.stats["end_state"]
    np.testing.assert_allclose(state.x, [end, 0.0, 5 - 4.905 * end**2], atol=1e-8)
    assert out.result == dfx.RESULTS.event_occurred
    reached = ts < np.sqrt(10 / 9.81)
    expected = 5 - 4.905 * ts[reached] ** 2
    np.testing.assert_allclose(out.ys.x[reached, 2], expected, atol=1e-8)
    assert np.isnan(np.asarray(out.ys.x)[ts > end]).all()
    with pytest.raises(ValueError, match=r"simulate: the ground was reached; the last of ts"):
        rj.simulate(None, start, ts, Fall(), solver=solver)
    below = rj.Point([0.0, 0, -1.0], [1.0, 0, 0])
    with pytest.raises(ValueError, match="the ground was reached; the start"):
        rj.simulate(None, below, ts, Fall(), solver=solver)
