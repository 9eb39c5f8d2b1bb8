"""Do 95 % intervals hold the truth in 95 of 100 records? Five kinds of scene, 200 records each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.reported import quantities

RECORDS = 200
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
TS = jnp.linspace(0.0, 8.0, 60)
Q0 = [1.0, 0.0, 0.0, 0.0]
OMEGA = [0.4, 1.2, -0.3]


def turned(q, rng, sigma):
    steps = jnp.asarray(sigma * rng.normal(size=(q.shape[0], 3)))
    return jax.vmap(lambda a, e: rj.quaternion.multiply(a, rj.quaternion.exp(e)))(q, steps)


def gyro_alone(rng):
    ys = rj.simulate(BODY, rj.Spin(OMEGA), TS).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    return identify.Recording(TS, (identify.Gyro(0.02), read)), identify.PrincipalRatios(), []


def noise_unknown(rng):
    ys = rj.simulate(BODY, rj.Spin(OMEGA), TS).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    return identify.Recording(TS, (identify.Gyro(), read)), identify.PrincipalRatios(), []


def attitude_and_biased_gyro(rng):
    ys = rj.simulate(BODY, rj.Attitude(Q0, OMEGA), TS).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    record = identify.Recording(
        TS,
        (identify.AttitudeSensor(0.05), turned(ys.q, rng, 0.05)),
        (identify.Gyro(0.02, bias=[0.0, 0.0, 0.0]), read),
    )
    free = [identify.Free(lambda r: r.readings[1].sensor.bias, "bias", scale=0.02)]
    return record, identify.PrincipalRatios(), free


def wheel_and_drag(rng):
    speed = rj.torques.Series(np.linspace(0, 8, 60), 2 * np.tanh(np.linspace(0, 8, 60)))
    wheel = rj.torques.Flywheel(rj.torques.Wheel(0.3, [0.0, 0.0, 1.0], speed))
    law = rj.torques.Sum(wheel, rj.torques.Damping([0.05, 0.05, 0.05]))
    ys = rj.simulate(BODY, rj.Spin(OMEGA), TS, law).ys
    read = ys.omega + 0.02 * rng.normal(size=(60, 3))
    record = identify.Recording(TS, (identify.Gyro(0.02), read), torque=law)
    free = [identify.Free(lambda r: r.torque.parts[1].coefficient, "drag", scale=0.05)]
    return record, identify.Principal(1.5), free


def two_directions_of_a_top(rng):
    top = rj.torques.HeavyTop(mass=1.0, com=[0.0, 0.0, 0.5], gravity=[0.0, 0.0, -2.0])
    ys = rj.simulate(BODY, rj.Attitude(Q0, [0.4, 1.2, 1.5]), TS, top).ys
    sensors = []
    for world in ([1.0, 0.0, 0.0], [0.0, 0.6, 0.8]):
        seen = jax.vmap(lambda q, w=world: rj.quaternion.rotate_inverse(q, jnp.array(w)))(ys.q)
        off = seen + 0.02 * rng.normal(size=(60, 3))
        sensors.append(
            (identify.Direction(world, 0.02), off / jnp.linalg.norm(off, axis=1)[:, None])
        )
    record = identify.Recording(TS, *sensors, torque=top)
    return record, identify.Principal(1.5), []


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
        record, chart, free = scene(rng)
        problem = identify.Problem(record, chart, free=free)
        omega = [0.4, 1.2, 1.5] if scene is two_directions_of_a_top else OMEGA
        plan = identify.plan_of(problem, BODY, omega)
        if truth is None:
            n = sum(x.size for x in jax.tree.leaves(plan))
            named = quantities(problem, plan, np.eye(n), np.zeros((0, n)))
            truth = {q.name: q.value for q in named if not q.name.startswith(("drag", "bias"))}
        found = identify.fit(problem, starts=1, initial=plan)
        bounds = found.interval(0.95)
        held.append([bounds[k][0] <= v <= bounds[k][1] for k, v in truth.items()])
    share = np.mean(held)
    print(scene.__name__, dict(zip(truth, np.mean(held, axis=0), strict=True)), share)
    # 200 records, about five numbers each that are not independent: one standard deviation is 1 %.
    assert 0.93 <= share <= 0.97
