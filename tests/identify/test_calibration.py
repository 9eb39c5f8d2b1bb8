"""Do 95 % intervals hold the truth in 95 of 100 records? Five kinds of scene, 200 records each."""

import jax.numpy as jnp
import numpy as np
import pytest
import turns

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.uncertainty.quantities import (
    quantities_on_host,
    reported_quantities,
)

RECORDS = 200
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
TS = jnp.linspace(0.0, 8.0, 60)
Q0 = [1.0, 0.0, 0.0, 0.0]
OMEGA = [0.4, 1.2, -0.3]


def turned(q, rng, sigma):
    steps = jnp.asarray(sigma * rng.normal(size=(q.shape[0], 3)))
    return turns.perturbed(q, steps)


def gyro_alone(rng):
    ys = rj.simulate(BODY, rj.Spin(OMEGA), TS).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    record = identify.Recording(TS, (identify.Gyro(0.02), read))
    return identify.Model(record, identify.PrincipalRatios())


def noise_unknown(rng):
    ys = rj.simulate(BODY, rj.Spin(OMEGA), TS).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    record = identify.Recording(TS, (identify.Gyro(), read))
    return identify.Model(record, identify.PrincipalRatios())


def attitude_and_biased_gyro(rng):
    ys = rj.simulate(BODY, rj.Attitude(Q0, OMEGA), TS).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    record = identify.Recording(
        TS,
        (identify.AttitudeSensor(0.05), turned(ys.q, rng, 0.05)),
        (identify.Gyro(0.02, bias=[0.0, 0.0, 0.0]), read),
    )
    free = [identify.Free(lambda s: s.sensors[1].bias, "bias", scale=0.02)]
    return identify.Model(record, identify.PrincipalRatios(), free=free)


def wheel_and_drag(rng):
    speed = rj.torques.Series(np.linspace(0, 8, 60), 2 * np.tanh(np.linspace(0, 8, 60)))
    wheel = rj.torques.Flywheel(rj.torques.Wheel(0.3, [0.0, 0.0, 1.0], speed))
    law = rj.torques.Sum(wheel, rj.torques.Damping([0.05, 0.05, 0.05]))
    ys = rj.simulate(BODY, rj.Spin(OMEGA), TS, law).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    record = identify.Recording(TS, (identify.Gyro(0.02), read))
    free = [identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=0.05)]
    return identify.Model(record, identify.Principal(1.5), torque=law, free=free)


def two_directions_of_a_top(rng):
    top = rj.torques.HeavyTop(mass=1.0, com=[0.0, 0.0, 0.5], gravity=[0.0, 0.0, -2.0])
    ys = rj.simulate(BODY, rj.Attitude(Q0, [0.4, 1.2, 1.5]), TS, top).ys
    sensors = []
    for world in ([1.0, 0.0, 0.0], [0.0, 0.6, 0.8]):
        seen = turns.to_body(ys.q, jnp.array(world))
        off = seen + 0.02 * rng.normal(size=(60, 3))
        sensors.append(
            (identify.Direction(world, 0.02), off / jnp.linalg.norm(off, axis=1)[:, None])
        )
    record = identify.Recording(TS, *sensors)
    return identify.Model(record, identify.Principal(1.5), torque=top)


SCENES = (
    gyro_alone,
    noise_unknown,
    attitude_and_biased_gyro,
    wheel_and_drag,
    two_directions_of_a_top,
)


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_intervals_hold_the_truth_as_often_as_they_say(scene):
    rng = np.random.default_rng(11)
    truth, held = None, []
    for _ in range(RECORDS):
        problem = scene(rng)
        omega = [0.4, 1.2, 1.5] if scene is two_directions_of_a_top else OMEGA
        plan = problem.start(BODY, omega)
        if truth is None:
            found = quantities_on_host(problem, plan, None)
            named = reported_quantities(problem, found, np.eye(plan.size), np.zeros((0, plan.size)))
            truth = {q.name: q.value for q in named if not q.name.startswith(("drag", "bias"))}
        found = identify.fit(problem, starts=1, initial=plan)
        bounds = found.interval(0.95)
        held.append([bounds[k][0] <= v <= bounds[k][1] for k, v in truth.items()])
    share = np.mean(held)
    print(scene.__name__, dict(zip(truth, np.mean(held, axis=0), strict=True)), share)
    # 200 records, about five numbers each that are not independent: one standard deviation is 1 %.
    assert 0.93 <= share <= 0.97


def coverage(make, truth, records=RECORDS):
    """Share of 95 % intervals that hold, of `make(rng)` → fit, by name; `truth` name → value."""
    rng, held = np.random.default_rng(12), []
    for _ in range(records):
        bounds = make(rng).interval(0.95)
        held.append([bounds[k][0] <= v <= bounds[k][1] for k, v in truth.items()])
    print(make.__name__, dict(zip(truth, np.mean(held, axis=0), strict=True)), np.mean(held))
    return np.mean(held)


CLEAN = np.asarray(rj.simulate(BODY, rj.Spin(OMEGA), TS).ys.omega)
MOMENTS = {"Ix/Iz": 1.0 / 2.1, "Iy/Iz": 1.6 / 2.1}


def cut_off(rng):
    read = (CLEAN + 0.02 * rng.normal(size=(60, 3))).clip(-0.95, 0.95)
    record = identify.Recording(TS, (identify.Gyro(0.02), read))
    return identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)


def slow_errors(rng):
    """Errors that are correlated over six samples, as what a model leaves out is."""
    steps = 0.02 * rng.normal(size=(160, 3))
    slow = np.zeros((160, 3))
    for k in range(1, 160):
        slow[k] = 0.85 * slow[k - 1] + np.sqrt(1 - 0.85**2) * steps[k]
    read = CLEAN + slow[100:] + 0.005 * rng.normal(size=(60, 3))
    record = identify.Recording(TS, (identify.Gyro(), read))
    return identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)


SKEW = np.array([0.02, -0.01, 0.03])
THROWS = [
    np.asarray(rj.simulate(BODY, rj.Spin(omega), TS).ys.omega)
    for omega in (OMEGA, [1.0, 0.2, 0.5], [-0.3, 0.9, 1.1])
]


def skew_and_own_biases(rng):
    """A known body, two throws of another; noise of two sizes; biases about a shared one."""
    matrix = np.eye(3) + np.array([[0, SKEW[0], SKEW[1]], [0, 0, SKEW[2]], [0, 0, 0]])
    shared = np.array([0.03, 0.0, -0.02])
    records = []
    for clean, sigma in zip(THROWS, (0.01, 0.02, 0.02), strict=True):
        bias = shared + 0.02 * rng.normal(size=3)
        read = clean @ matrix.T + bias + sigma * rng.normal(size=clean.shape)
        gyro = identify.Gyro(bias=[0.0] * 3, skew=[0.0] * 3)
        records.append(identify.Recording(TS, (gyro, read)))
    free = [
        identify.Free(lambda s: s.sensors[0].skew, "skew", scale=0.02),
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05, spread=0.02),
    ]
    problem = identify.Model(
        {"known": records[:1], "new": records[1:]},
        {"known": identify.Known(BODY), "new": identify.PrincipalRatios()},
        free=free,
        noise_each="body",
    )
    return identify.fit(problem, starts=1)


SHARED = {f"skew {a}": v for a, v in zip("xyz", SKEW, strict=True)}
SHARED |= {f"bias {a}": v for a, v in zip("xyz", (0.03, 0.0, -0.02), strict=True)}
SHARED |= {f"{name} [new]": v for name, v in MOMENTS.items()}


@pytest.mark.slow
@pytest.mark.parametrize(("make", "truth"), [(cut_off, MOMENTS), (skew_and_own_biases, SHARED)])
def test_intervals_of_what_is_shared_or_cut_off_hold(make, truth):
    assert 0.93 <= coverage(make, truth) <= 0.97


@pytest.mark.slow
def test_intervals_hold_where_errors_are_not_white():
    # Sixty readings do not tell well over which time errors are correlated: wider, not narrower.
    assert 0.93 <= coverage(slow_errors, MOMENTS) <= 0.995
