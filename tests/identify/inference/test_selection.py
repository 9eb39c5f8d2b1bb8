"""Terms that records ask for, and no others; what is worth a term to first order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.identify.answer.fit import fit
from rigidjax.identify.inference import selection
from rigidjax.identify.model.widened import with_slots

TIMES = jnp.linspace(0.0, 4.0, 90)
BODY = rj.Inertia.from_principal(1.0, 1.7, 2.1)
ZERO = [0.0, 0.0, 0.0]


def model_of(values, chart, torque=None, seed=0, count=1):
    """Return a model of gyro readings, whose sensor may have a bias and a scale."""
    readings = [
        identify.simulate_readings(
            identify.Gyro(noise=0.02, bias=values.get("bias", ZERO), scale=[1.0] * 3),
            BODY,
            rj.Spin([1.2 + 0.2 * k, 0.9, 2.5]),
            TIMES,
            torques.Damping(values["drag"]) if "drag" in values else None,
            key=jax.random.key(seed + k),
        )
        for k in range(count)
    ]
    gyro = identify.Gyro(noise=0.02, bias=ZERO, scale=[1.0] * 3)
    records = [identify.Recording(TIMES, (gyro, one)) for one in readings]
    return identify.Model(records if count > 1 else records[0], chart, torque=torque)


CANDIDATES = {
    "bias": identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
    "scale": identify.Free(lambda s: s.sensors[0].scale, "scale", scale=0.05),
}


@pytest.mark.parametrize("count", [1, 2])
def test_first_order_is_exact_where_the_readings_are_linear(count):
    """Of a known body and gyro errors alone: the sum of squares by NumPy's least squares."""
    model = model_of({"bias": [0.05, -0.04, 0.03]}, identify.Known(BODY), count=count)
    wide = with_slots(model, list(CANDIDATES.values()))
    terms = selection._Terms(model, wide, {"bias": ["bias"], "scale": ["scale"]})
    trial = fit(terms.held(frozenset(["bias"])), starts=1, held_out=False)
    value = terms.first_order(trial, 1.0)

    # Rows of all readings: their derivatives by initial rates, bias and scale, and the residual.
    linear = trial.linear
    assert linear is not None
    n, rows = trial.x.size, []
    for slope, places in zip(linear.slopes[0], linear.places, strict=True):
        wide = np.zeros((slope.shape[0] * 3, n + 1))
        wide[:, places] = slope.reshape(-1, slope.shape[-1])
        rows.append(wide[:, :n])
    rows, residual = np.concatenate(rows), linear.errors[0].reshape(-1)
    free = {name: np.ravel(terms.places[name]) for name in ("bias", "scale")}
    at_zero = residual - rows[:, free["bias"]] @ np.asarray(trial.x)[free["bias"]]
    at_zero = at_zero - rows[:, free["scale"]] @ np.asarray(trial.x)[free["scale"]]
    base = np.setdiff1d(np.arange(n), np.concatenate(list(free.values())))
    for names in ([], ["bias"], ["scale"], ["bias", "scale"]):
        use = np.concatenate([base, *(free[name] for name in names)])
        left = at_zero - rows[:, use] @ np.linalg.lstsq(rows[:, use], at_zero)[0]
        many, width = residual.size, 3 * len(names)
        wanted = many * np.log(left @ left) + width * np.log(many) + 2 * len(names) * np.log(2)
        assert value(frozenset(names)) == pytest.approx(wanted, abs=1e-6 * many)
    # A fit with the bias is the best of the four, as the hidden error says.
    everything = [frozenset(s) for s in ([], ["bias"], ["scale"], ["bias", "scale"])]
    assert min(everything, key=value) == frozenset(["bias"])


@pytest.mark.parametrize("hidden", [{}, {"drag": [0.3, 0.2, 0.4], "bias": [0.1, -0.1, 0.1]}])
def test_terms_are_those_of_the_record(hidden):
    law = torques.Damping(ZERO)
    drag = identify.Free(lambda s: s.torque.coefficient, "drag", scale=0.1)
    model = model_of(hidden, identify.PrincipalRatios(), torque=law)
    found = identify.select(model, {"drag": drag, "bias": CANDIDATES["bias"]}, starts=2)
    assert set(found.terms) == set(hidden)
    assert found.fit.ok
    for name, value in hidden.items():
        # The chart finds the inertia, and so the drag, up to a factor: its second moments add up to
        # one, those of BODY to 2.4.
        value = np.asarray(value) / (2.4 if name == "drag" else 1.0)
        low, high = found.fit.interval_of(lambda point, name=name: point.values[name], 0.999)
        assert (low <= value).all(), (low, value, high)
        assert (value <= high).all(), (low, value, high)
    assert found.path[0].terms == ()
    assert found.path[-1].terms == found.terms
    assert all(step.gain > 0 for step in found.path[1:])
    assert str(found).splitlines()[0].split() == ["terms", "criterion", "errors", "held", "out"]


def test_too_few_readings_to_hold_some_out_are_no_reason_against_a_term(monkeypatch):
    hidden = {"drag": [0.3, 0.2, 0.4], "bias": [0.1, -0.1, 0.1]}
    model = model_of(hidden, identify.PrincipalRatios(), torque=torques.Damping(ZERO))
    drag = identify.Free(lambda s: s.torque.coefficient, "drag", scale=0.1)
    monkeypatch.setattr(selection, "_held_out", lambda trial: ())
    found = identify.select(model, {"drag": drag, "bias": CANDIDATES["bias"]}, starts=2)
    assert set(found.terms) == set(hidden)


def test_usual_terms_leave_the_prediction_and_keep_what_was_free():
    """Of a model with a law whose number is free: the law becomes the first part of a sum."""
    law = torques.Damping([0.1, 0.2, 0.3])
    gyro = identify.Gyro(noise=0.02, bias=ZERO)
    record = identify.Recording(TIMES, (gyro, jnp.ones((90, 3))))
    free = [identify.Free(lambda s: s.torque.coefficient, "c", scale=0.1)]
    model = identify.Model(record, identify.Ratios(), torque=law, free=free)
    wider, terms = identify.usual_terms(model)
    assert set(terms) == {"quadratic drag", "constant torque", "wheel", "Gyro scale"}
    x = model.start().at[5:8].set(jnp.array([0.5, -0.3, 0.2]))  # the coefficients
    assert wider.values(x)["c"].tolist() == model.values(x)["c"].tolist()
    before, after = model.scenes(x), wider.scenes(x)
    assert after.torque.parts[0].coefficient.tolist() == before.torque.coefficient.tolist()
    state = rj.Spin([1.0, -2.0, 0.5])
    whole, alone = (jax.tree.map(lambda leaf: leaf[0], s.torque) for s in (after, before))
    assert whole(0.0, state, BODY).tolist() == alone(0.0, state, BODY).tolist()


def test_usual_terms_of_attitudes_and_of_two_sensors():
    sensors = (identify.Gyro(noise=0.02), identify.AttitudeSensor(noise=0.01))
    q = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), (90, 4))
    record = identify.Recording(TIMES, (sensors[0], jnp.ones((90, 3))), (sensors[1], q))
    terms = identify.usual_terms(identify.Model(record, identify.Ratios())).terms
    assert list(terms)[-4:] == ["torque in space", "Gyro bias", "Gyro scale", "Gyro clock"]


def test_two_terms_have_no_name_in_common():
    model = model_of({}, identify.Known(BODY))
    with pytest.raises(ValueError, match="another Free has this name"):
        identify.select(model, {"a": [CANDIDATES["bias"]], "b": [identify.Free(
            lambda s: s.sensors[0].scale, "bias")]})  # fmt: skip
