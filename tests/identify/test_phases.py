"""Where the motion is in a record: simulated logs whose truth is known, and real throws."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import throw_logs

from rigidjax import identify
from rigidjax.identify import Recording, find_phases
from rigidjax.motion.torques import Series

DELFT = Path(__file__).parents[3] / "shared" / "data" / "tudelft_throw"
T = 0.01 * np.arange(800)
GYRO, ACCELEROMETER = identify.Gyro(), identify.Accelerometer(None, place=[0.0, 0.0, 0.0])


def record(t, w, f=None, **inputs):
    return Recording(t, (GYRO, w), *(((ACCELEROMETER, f),) if f is not None else ()), inputs=inputs)


def shares(log, phases):
    """The share of the free flight that is found, and of what is called free and is not."""
    fine = np.arange(0.0, log.t[-1], 5e-4)
    inside = lambda spans: np.any([(fine >= a) & (fine <= b) for a, b in spans] or [fine < 0], 0)
    called = inside([(p.start, p.end) for p in phases if p.kind == "free"])
    wanted = inside([span for span in log.free if span[1] - span[0] >= 0.1])
    wrong = (called & ~inside(log.free)).sum() / max(called.sum(), 1)
    return (wanted & called).sum() / max(wanted.sum(), 1), wrong


@pytest.mark.parametrize(
    ("seed", "throws", "rate", "how"),
    [
        (31, 1, 200.0, {}),
        (32, 3, 250.0, dict(lever=0.12, fastest=12.0)),
        (33, 5, 500.0, dict(fastest=30.0, noise=2.0)),
    ],
)
def test_throws_are_found_in_whole_logs(seed, throws, rate, how):
    log = throw_logs.make(seed, throws, rate, **how)
    phases = find_phases(record(log.t, log.rates, log.forces))
    found, wrong = shares(log, phases)
    assert found > 0.95 and wrong < 0.02
    # Nothing is told twice, and nothing is left out, but for the step from one phase to the next.
    for one, after in itertools.pairwise(phases):
        assert 0 < after.start - one.end < 1.5 / rate
    rest = sum(p.end - p.start for p in phases if p.kind == "rest")
    assert rest == pytest.approx(np.diff(log.rest).sum(), rel=0.3)
    # By the gyro alone fewer are found, and little is called free that is not.
    _, wrong = shares(log, find_phases(record(log.t, log.rates)))
    assert wrong < 0.05


def test_a_log_without_a_throw_has_none():
    log = throw_logs.make(34, 0, 100.0)
    for force in (log.forces, None):
        kinds = {p.kind for p in find_phases(record(log.t, log.rates, force))}
        assert kinds == {"rest", "handling"}


def swung(turn=2.0):
    """A pendulum of 0.25 m with its sensors at 0.2 m below the axle, y; at rest for the first 2 s."""
    from scipy.integrate import solve_ivp

    field = lambda t, y: [y[1], -9.81 / 0.25 * np.sin(y[0])]
    way = solve_ivp(field, (0, 6), [0.0, turn], t_eval=T[T >= 2.0] - 2.0, rtol=1e-8).y
    angle, w = np.concatenate([np.zeros((2, 200)), way], axis=1)
    slope = np.append(np.zeros(200), -9.81 / 0.25 * np.sin(way[0]))
    force = np.stack([9.81 * np.sin(angle) + 0.2 * slope, 0 * w, 9.81 * np.cos(angle) + 0.2 * w**2])
    noise = np.random.default_rng(1).normal(size=(2, T.size, 3))
    rates = np.stack([0 * w, w, 0 * w], axis=1)
    return rates + 0.005 * noise[0], force.T + 0.05 * noise[1]


@pytest.mark.parametrize("turn", [1.0, 11.0])
def test_a_swing_and_a_rest(turn):
    w, f = swung(turn)
    for force in (f, None):
        rest, swing = find_phases(record(T, w, force))
        assert (rest.kind, swing.kind) == ("rest", "swing")
        assert rest.end == pytest.approx(2.0, abs=0.2) and swing.end == T[-1]
        assert "[0.0, 1.0, 0.0]" in swing.says
        assert not rest.is_usable and not swing.is_usable


def spun(rate=6.0):
    """A disc that wobbles in the air: a closed form."""
    phase = 0.8 * rate * T
    w = rate * np.stack([0.3 * np.cos(phase), 0.3 * np.sin(phase), np.ones(T.size)], axis=1)
    return w + 0.003 * np.random.default_rng(2).normal(size=w.shape)


def test_gaps_full_scale_and_what_is_too_short_or_too_slow():
    w, f = spun(), np.zeros((T.size, 3))
    kept = (T < 3.0) | (T > 3.5)
    phases = find_phases(record(T[kept], np.minimum(w[kept], 6.0), f[kept]))
    kinds = [(p.kind, round(p.start, 1), round(p.end, 1)) for p in phases]
    assert {("free", 0.0, 3.0), ("gap", 3.0, 3.5), ("free", 3.5, 8.0)} <= {*kinds}
    assert any("about z is at least 6" in p.says for p in phases if p.kind == "full scale")
    held = f + np.where((T > 2.0) & (T < 7.9), 20.0, 0.0)[:, None] * [0, 0, 1.0]
    slow = find_phases(record(T, 0.03 * w, held))
    assert [p.kind for p in slow] == ["free", "handling", "free"]
    assert "rad only" in slow[0].says and not slow[0].is_usable
    held[T > 7.7] = 0.0
    few = find_phases(record(T[::4], w[::4], held[::4]))
    assert few[0].is_usable and "too few" in few[-1].says


def test_no_flight_is_free_while_a_motor_runs():
    w, f = spun(), np.zeros((T.size, 3))
    speed = np.where((T > 4.0) & (T < 5.0), 800.0, 100.0)
    made = record(T, w, f, m1=Series(T, speed), m2=np.full((T.size, 2), 1000.0))
    phases = find_phases(made, ["m1", "m2"])
    assert [p.kind for p in phases] == ["free", "motors", "free"]
    assert phases[1].start == pytest.approx(4.0, abs=0.02)
    with pytest.raises(ValueError, match="wanted inputs of the recording, got 'm3'"):
        find_phases(made, ["m3"])


def test_what_is_no_specific_force_is_refused():
    w, f = swung()
    for wrong in (f / 9.81, f - np.mean(f, axis=0)):
        with pytest.raises(ValueError, match="at rest the accelerometer reads"):
            find_phases(record(T, w, wrong))
    with pytest.raises(ValueError, match="wanted 8 readings of a gyro"):
        find_phases(Recording(T, (ACCELEROMETER, f)))


def test_a_part_of_a_recording_reads_what_the_whole_reads():
    w, f = swung()
    whole = record(T, w, f, held=np.arange(T.size), known=Series(T, T))
    part = whole.between(1.0, 2.005)
    np.testing.assert_array_equal(part.t, T[100:201])
    np.testing.assert_array_equal(part.readings[1].values, f[100:201])
    np.testing.assert_array_equal(part.inputs["held"], np.arange(100, 201))
    assert part.inputs["known"] is whole.inputs["known"]
    with pytest.raises(ValueError, match="at least two times"):
        whole.between(9.0, 10.0)


@pytest.mark.skipif(not DELFT.exists(), reason="the throws are not beside this checkout")
@pytest.mark.parametrize("path", sorted(DELFT.glob("*.csv"))[::4], ids=lambda path: path.stem)
def test_real_throws(path):
    columns = identify.read_table(path, ["t", "wx", "wy", "wz", "ax", "ay", "az"])
    t, x = columns.pop("t"), np.stack(list(columns.values()), axis=1)
    hand, free = find_phases(record(t, x[:, :3], x[:, 3:]))
    # The flywheel starts at 0, in the air.
    assert (hand.kind, free.kind) == ("handling", "free")
    assert -0.12 < free.start < -0.02 and free.end == t[-1] and free.is_usable
