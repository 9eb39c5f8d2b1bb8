"""What a fit says of itself: of wrong set-ups none is `ok`, of right ones all are."""

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import turns

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.answer.misread import (
    ATTITUDES,
    ORDERS,
    UNITS,
    WORLD,
    cause_by_misread_file,
)
from rigidjax.identify.data.full_scale import full_scale_of

BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
PLATE = rj.Inertia.from_principal(0.7, 1.3, 1.95)
TS = np.linspace(0.0, 10.0, 80)
OMEGA = (0.4, 1.2, -0.3)
SIGMA = 0.01


def tumble(body=BODY, omega=OMEGA, sigma=SIGMA, seed=0, ts=TS, law=None):
    """Rates with noise, quaternions with noise."""
    ys = rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], list(omega)), jnp.asarray(ts), law).ys
    rng = np.random.default_rng(seed)
    rates = np.asarray(ys.omega) + sigma * rng.normal(size=(ts.size, 3))
    steps = jnp.asarray(sigma * rng.normal(size=(ts.size, 3)))
    turned = turns.perturbed(ys.q, steps)
    return rates, np.asarray(turned)


def law(inertia=0.6, axis=(0.0, 0.0, 1.0), drag=(0.06, 0.05, 0.04), late=0.0):
    times = np.linspace(-1.0, 11.0, 120)
    speed = rj.torques.Series(times, 1.5 * np.tanh(times - 3.0 - late))
    wheel = rj.torques.Flywheel(rj.torques.Wheel(inertia, list(axis), speed))
    return rj.torques.Sum(wheel, rj.torques.Damping(list(drag)))


def gyro(rates, noise=SIGMA, chart=None, ts=TS, starts=2, **options):
    """A gyro alone."""
    record = identify.Recording(ts, (identify.Gyro(noise), rates))
    model = identify.Model(record, chart or identify.PrincipalRatios(), **options)
    return identify.fit(model, starts=starts)


def both(rates, turns, ts=TS, **sensor):
    """A gyro and a star tracker of unknown noise."""
    record = identify.Recording(
        ts, (identify.Gyro(**sensor), rates), (identify.AttitudeSensor(), turns)
    )
    return identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=2)


def wheel(rates, named, free=True):
    """A gyro on a body with a wheel and drag."""
    moves = [identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=0.05)]
    record = identify.Recording(TS, (identify.Gyro(), rates))
    moves = moves if free else []
    model = identify.Model(record, identify.Principal(1.5), torque=named, free=moves)
    return identify.fit(model, starts=2)


def together(*readings):
    """Throws of one body."""
    records = [identify.Recording(TS, (identify.Gyro(SIGMA), r)) for r in readings]
    return identify.fit(identify.Model(records, identify.PrincipalRatios()), starts=2)


def unlike(rates):
    """Gyro axes that are three degrees off a right angle."""
    a = np.radians(3.0)
    return rates @ np.array([[1.0, a, -a], [0.0, 1.0, a], [0.0, 0.0, 1.0]]).T


def hit(sigma=SIGMA):
    """Another motion from the middle on."""
    rates = tumble(sigma=sigma)[0]
    rates[40:] = tumble(omega=(0.9, -0.5, 0.8), seed=1, sigma=sigma)[0][:40]
    return rates


def drifting():
    rates, turns = tumble()
    return rates + 0.01 * TS[:, None] * np.array([1.0, -1.0, 0.5]), turns


def scattered(sigma=0.04):
    """A clock whose time stamps scatter by 40 ms."""
    times = TS + sigma * np.random.default_rng(3).normal(size=TS.size)
    order = np.argsort(times)
    shown = tumble(sigma=2e-3, ts=np.concatenate([[-1.0], times[order]]))[0][1:]
    return shown[np.argsort(order)]


def weighed(unit):
    """A gyro and an accelerometer whose readings are in `unit` m/s²."""
    sensors = identify.Gyro(SIGMA), identify.Accelerometer(0.02, place=[0.3, 0.0, 0.1])
    start = rj.Spin(list(OMEGA))
    read = identify.simulate_readings(sensors, BODY, start, TS, key=jax.random.key(0))
    unknown = identify.Accelerometer(place=[0.3, 0.0, 0.1])
    record = identify.Recording(TS, (sensors[0], read[0]), (unknown, read[1] / unit))
    return identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=2)


def still(momentum=0.1):
    """A wheel of constant speed."""
    speed = rj.torques.Series(np.linspace(-1.0, 11.0, 4), np.ones(4))
    return rj.torques.Flywheel(rj.torques.Wheel(momentum, [0.0, 0.0, 1.0], speed))


def spun():
    speed = rj.torques.Series(np.linspace(0.0, 10.0, 4), np.linspace(0.0, 1.0, 4))
    return rj.torques.Flywheel(rj.torques.Wheel(0.3, [0.0, 0.6, 0.8], speed))


def world(rates, turned):
    return np.asarray(jax.vmap(rj.quaternion.rotate)(jnp.asarray(turned), jnp.asarray(rates)))


BIAS = np.array([0.05, -0.04, 0.06])
WHEEL = law()
TURN = rj.quaternion.exp(jnp.array([0.15, -0.2, 0.1]))

FEW_WRONG = {
    "one scale 5 % off": lambda: both(tumble()[0] * [1.05, 1, 1], tumble()[1]),
    "skew of 3 degrees": lambda: gyro(unlike(tumble()[0])),
    "axes that are not principal": lambda: gyro(tumble(BODY.rotate(TURN))[0]),
    "a hit in the middle": lambda: gyro(hit()),
    "a bias left out": lambda: gyro(tumble()[0] + BIAS),
    "deg/s, a gyro alone": lambda: gyro(np.degrees(tumble(sigma=1e-3)[0]), noise=0.1),
    "time stamps that scatter": lambda: gyro(scattered()),
}
WRONG = {
    "deg/s read as rad/s": lambda: both(np.degrees(tumble()[0]), tumble()[1]),
    "rad/s read as deg/s": lambda: both(np.radians(tumble()[0]), tumble()[1]),
    "signs of all axes": lambda: both(-tumble()[0], tumble()[1]),
    "sign of one axis": lambda: both(tumble()[0] * [1, 1, -1], tumble()[1]),
    "two axes swapped": lambda: both(tumble()[0][:, [1, 0, 2]], tumble()[1]),
    "axes in another order": lambda: both(tumble()[0][:, [1, 2, 0]], tumble()[1]),
    "a clock that is 5 % fast": lambda: both(*tumble(), ts=1.05 * TS),
    "scalar last": lambda: both(tumble()[0], np.roll(tumble()[1], -1, axis=1)),
    "world to body": lambda: both(tumble()[0], tumble()[1] * [1, -1, -1, -1]),
    "gyro turned by 6 degrees": lambda: both(
        tumble()[0] @ np.asarray(rj.so3.exp(jnp.array([0.0, 0.1, 0.0]))), tumble()[1]
    ),
    "a bias that drifts": lambda: both(*drifting()),
    "random readings": lambda: gyro(np.random.default_rng(1).normal(size=(80, 3)), noise=None),
    "the wheel not named": lambda: gyro(tumble(law=WHEEL)[0], noise=None),
    "g read as m/s²": lambda: weighed(9.81),
    "a still wheel not named": lambda: gyro(tumble(law=still())[0], noise=None),
    "an axis mirrored beside a wheel": lambda: wheel(tumble(law=WHEEL)[0] * [1, -1, 1], WHEEL),
    "the wheel the other way": lambda: wheel(tumble(law=WHEEL)[0], law(-0.6)),
    "the wheel about x": lambda: wheel(tumble(law=WHEEL)[0], law(axis=(1.0, 0.0, 0.0))),
    "the wheel's log late": lambda: wheel(tumble(law=WHEEL)[0], law(late=0.5)),
    "rates in the world's axes": lambda: both(world(*tumble()), tumble()[1]),
    "half a turn about x": lambda: both(tumble()[0] * [1, -1, -1], tumble()[1]),
    "a wheel that spins up": lambda: gyro(tumble(law=spun())[0], noise=None),
    "rates that no gyro reads": lambda: gyro(80.0 * tumble()[0], noise=None, ts=TS / 80.0),
    "drag left out": lambda: wheel(tumble(law=WHEEL)[0], law(drag=(0.0,) * 3), free=False),
    "two bodies mixed": lambda: together(tumble()[0], tumble(PLATE, seed=1)[0]),
    "cut off, then smoothed": lambda: gyro(
        tumble(sigma=0.0)[0].clip(-0.9, 0.9) + tumble()[0] - tumble(sigma=0.0)[0]
    ),
}


# What the causes say of some of them; the others have none that is one of the table's.
CAUSES = {
    "skew of 3 degrees": "axes not orthogonal",
    "axes that are not principal": "axes turned by",
    "a bias left out": "a bias left out, (0.044, -0.04, 0.059) rad/s",
    "deg/s, a gyro alone": "deg/s read as rad/s",
    "time stamps that scatter": "time stamps that scatter by 42 ms",
    "deg/s read as rad/s": "deg/s read as rad/s",
    "rad/s read as deg/s": "rad/s read as deg/s",
    "signs of all axes": "all signs turned round",
    "sign of one axis": "the z axis mirrored",
    "two axes swapped": "x and y swapped",
    "axes in another order": "axes in the order y, z, x",
    "a clock that is 5 % fast": "scale errors of (0.048, 0.051, 0.046)",
    "scalar last": "the quaternion's scalar last",
    "world to body": "the quaternion from world to body",
    "gyro turned by 6 degrees": "axes turned by",
    "one scale 5 % off": "scale errors of (0.048,",
    "a bias that drifts": "a bias that drifts by (0.0099, -0.01, 0.005)",
    "g read as m/s²": "scale errors of (-0.9, -0.89, -0.9)",
    "a still wheel not named": "a constant internal angular momentum",
    "an axis mirrored beside a wheel": "the y axis mirrored",
    "the wheel the other way": "the torque with the other sign",
    "the wheel about x": "axes in the order y, z, x",
    "the wheel's log late": "a clock offset of 0.4",
    "rates in the world's axes": "rates in the world's axes",
    "half a turn about x": "half a turn about x",
    "a wheel that spins up": "a wheel that spins up",
    "rates that no gyro reads": "deg/s read as rad/s",
    "drag left out": "a torque against the rate",
}


def right(seed):
    """A body, a first rate and a noise drawn at random."""
    rng = np.random.default_rng(100 + seed)
    # A triangle of moments that is no plate and no ball; never near the middle axis.
    s = np.sort(rng.uniform(0.3, 1.0, 3)) * [1.0, 1.3, 1.7]
    body = rj.Inertia.from_principal(s[1] + s[2], s[0] + s[2], s[0] + s[1])
    return dict(
        body=body,
        omega=rng.choice([-1.0, 1.0], 3) * rng.uniform(0.4, 1.2, 3),
        sigma=10 ** rng.uniform(-3, -1.5),
        seed=seed,
    )


def cut(seed):
    rates = tumble(**right(seed))[0]
    limit = 0.85 * np.abs(rates).max()
    return gyro(rates.clip(-limit, limit), noise=right(seed)["sigma"])


FEW_RIGHT = {"noise given": lambda: gyro(tumble(**right(0))[0], noise=right(0)["sigma"])}
RIGHT = (
    {f"noise given {k}": lambda k=k: gyro(tumble(**right(k))[0], noise=right(k)["sigma"]) for k in range(1, 6)}
    | {f"noise unknown {k}": lambda k=k: gyro(tumble(**right(k))[0], noise=None) for k in range(6, 10)}
    | {f"two sensors {k}": lambda k=k: both(*tumble(**right(k))) for k in range(10, 14)}
    | {f"a wheel and drag {k}": lambda k=k: wheel(tumble(**right(k), law=WHEEL)[0], law(drag=(0.0,) * 3)) for k in range(14, 17)}
    | {f"two throws {k}": lambda k=k: together(tumble(omega=right(k)["omega"], seed=k)[0], tumble(seed=k + 50)[0]) for k in (17, 18)}
    | {f"cut off at full scale {k}": lambda k=k: cut(k) for k in (19, 20)}
)  # fmt: skip


def test_numbers_of_frames_as_times_are_among_the_causes():
    """A motion in 50 frames a second: its rates are then as wrong as those in deg/s."""
    ts = 0.02 * np.arange(80)
    rates = rj.simulate(BODY, rj.Spin([3.0, 1.5, 2.0]), ts).ys.omega
    rates += 0.01 * np.random.default_rng(5).normal(size=rates.shape)
    (cause,) = gyro(rates, ts=50 * ts).causes
    assert cause.words == "most likely numbers of frames read as times, or deg/s read as rad/s"


@pytest.mark.parametrize(
    "name", [*FEW_WRONG, *(pytest.param(name, marks=pytest.mark.slow) for name in WRONG)]
)
def test_no_wrong_set_up_is_called_ok(name):
    # What the sizes of the rates show is said before the search.
    units = pytest.warns(UserWarning, match="fit: most likely .*; the search goes on, but")
    with units if "/s" in CAUSES.get(name, "") and "read as" in CAUSES[name] else nullcontext():
        found = (FEW_WRONG | WRONG)[name]()
    print(f"{name}: {found.status}")
    assert not found.ok and "can be trusted" not in found.advice
    said = " ".join(str(cause) for cause in found.causes)
    assert (CAUSES[name] in said) if name in CAUSES else not found.causes, said
    # Wrong all the same where the errors are as small as those of real records.
    sizes = found.explanation.reasons
    assert sizes and sizes[0].startswith("the errors of the ")


@pytest.mark.parametrize(
    "name", [*FEW_RIGHT, *(pytest.param(name, marks=pytest.mark.slow) for name in RIGHT)]
)
def test_every_right_set_up_is_called_ok(name):
    found = (FEW_RIGHT | RIGHT)[name]()
    print(f"{name}: {found.status}")
    assert found.ok


def test_a_fit_prints_its_table_its_answers_and_what_follows():
    found = gyro(tumble()[0] + BIAS)
    assert (found.search.word, found.explanation.word) == ("found", "leaves a part")
    table, words = str(found).split("\n\n")
    assert table == identify.report.table(identify.report.rows(found))
    lines = words.splitlines()
    assert lines[:2] == ["search: found", f"model: {found.explanation}"]
    assert "2.25 times the noise" in lines[1] and lines[2] == str(found.causes[0])
    assert lines[3] == found.advice and "let a Free move the sensor's bias" in found.advice
    # The other body that has these rates with an axis mirrored.
    assert any("with an axis mirrored or two axes swapped" in line for line in lines)
    assert "Ix/Iz" in found._repr_html_() and "search: found" in found._repr_html_()
    held = identify.report.as_dict(found)
    assert held["search"] == {"answer": "found", "reasons": []}
    assert held["model"] == {"answer": "leaves a part", "reasons": list(found.explanation.reasons)}
    assert held["causes"][0]["name"] == "bias" and held["advice"] == found.advice


@pytest.mark.parametrize("sign", [(1, -1, 1), (1, 1, -1), (-1, -1, -1)])
def test_free_rates_do_not_show_a_mirrored_axis(sign):
    found = gyro(tumble()[0] * sign)
    assert found.ok and any("cannot show such a mistake" in line for line in found.identifiability)


@pytest.mark.slow
def test_axes_that_are_known_to_be_turned_are_not_called_misread():
    rates, turns = drifting()
    back = np.asarray(rj.so3.exp(jnp.array([0.0, 0.0, -np.pi / 2])))
    found = both(rates @ back.T, turns, mounting=[0.0, 0.0, np.pi / 2])
    assert found.causes[0].name == "drift"


def test_a_plateau_is_one_only_where_readings_are_cut_off():
    t = np.linspace(0.0, 10.0, 200)
    wave = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    assert full_scale_of(wave) is None
    assert full_scale_of(wave.clip(-0.9, 0.9)) == 0.9
    assert full_scale_of((wave - 0.5).clip(-0.9, 0.9)) == 0.9
    # A slow wave in few digits is flat at its top.
    assert full_scale_of(np.round(np.sin(0.7 * t), 3)) is None
    assert full_scale_of(np.round(np.sin(0.7 * t) * 8) / 8) is None
    assert full_scale_of(np.full(200, 2.0)) is None
    assert full_scale_of(np.zeros(200)) is None


def test_time_stamps_that_scatter_are_named_and_can_be_a_sensor():
    body, ts = rj.Inertia.from_principal(1.0, 1.6, 2.2), jnp.linspace(0.0, 1.0, 101)
    for seed in range(1, 4):
        rng = np.random.default_rng(seed)
        start = rng.normal(size=3)
        motion = rj.exact.FreeBody(body, rj.Spin(8.0 * start / np.linalg.norm(start)))
        stamped = ts + 5e-3 * rng.normal(size=101) * (np.arange(101) > 0)
        rates = jax.vmap(lambda t, motion=motion: motion(t).omega)(stamped)
        rates = rates + 0.02 * rng.normal(size=(101, 3))
        for gyro in (identify.Gyro(0.02), identify.Gyro(0.02, jitter=5e-3)):
            record = identify.Recording(ts, (gyro, rates))
            found = identify.fit(identify.Model(record, identify.Ratios()), starts=2)
            assert found.ok == (gyro.jitter is not None)
            if not found.ok:
                assert "time stamps that scatter" in str(found)
            else:
                low, high = np.array([found.interval()[name] for name in ("I1/I3", "I2/I3")]).T
                true = np.array([1.0, 1.6]) / 2.2
                assert (low < true).all() and (true < high).all() and (high - low < 0.02).all()


def test_many_short_recordings_are_no_correlated_errors():
    # Three numbers fitted to each of 120 records of 24 rates take a part of the errors away, and
    # what is left is correlated, by −1 % at each lag: over all records this shows.
    ts = jnp.linspace(0.0, 2.0, 24)
    rates = 3.0 * np.random.default_rng(0).normal(size=(120, 3))
    motions = jax.vmap(lambda rate: rj.simulate(BODY, rj.Spin(rate), ts).ys.omega)(rates)
    read = np.asarray(motions) + SIGMA * np.random.default_rng(1).normal(size=motions.shape)
    records = [identify.Recording(ts, (identify.Gyro(SIGMA), rows)) for rows in read]
    found = identify.fit(identify.Model(records, identify.Ratios()), starts=1)
    assert found.ok


def test_every_wrong_order_of_axes_beside_attitudes_has_its_own_name():
    ts = np.linspace(0.0, 4.0, 200)
    rates, turned = tumble(omega=(1.5, 1.1, -2.0), ts=ts)
    assert len(ORDERS) == 47
    wrong = ORDERS | UNITS
    for name, turn in wrong.items():
        read = rates @ np.linalg.inv(turn).T
        record = identify.Recording(
            ts, (identify.Gyro(), read), (identify.AttitudeSensor(), turned)
        )
        found = cause_by_misread_file([record], None)
        assert found is not None and found.words == f"most likely {name}"
    for values, name in ((world(rates, turned), WORLD), (rates, None)):
        record = identify.Recording(
            ts, (identify.Gyro(), values), (identify.AttitudeSensor(), turned)
        )
        found = cause_by_misread_file([record], None)
        assert found is None if name is None else found.words == f"most likely {name}"
    for name, change in ATTITUDES.items():
        back = np.roll(turned, -1, axis=1) if "last" in name else change(turned)
        record = identify.Recording(ts, (identify.Gyro(), rates), (identify.AttitudeSensor(), back))
        assert cause_by_misread_file([record], None).words == f"most likely {name}"


def test_a_status_says_if_what_of_a_sensor_it_holds():
    rates = tumble(**right(0))[0]
    for gyro, condition in (
        (identify.Gyro(right(0)["sigma"]), "ok, if the Gyro is right to"),
        (identify.Gyro(right(0)["sigma"], tolerance="phone"), "ok"),
    ):
        record = identify.Recording(TS, (gyro, rates))
        found = identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=2)
        assert found.ok and found.status.startswith(condition)
        assert (", if" in found.status) == (gyro.tolerance is None)
    with pytest.raises(ValueError, match="phone"):
        identify.Gyro(tolerance="telephone")
