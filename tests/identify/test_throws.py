"""Real throws with a flywheel: calibration, choice of a model, two objects of known inertia."""

import importlib.util
import json
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

_spec = importlib.util.spec_from_file_location("throws", Path(__file__).with_name("throws.py"))
throws = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(throws)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not throws.FOLDER.exists(), reason="the throws are not beside this checkout"
    ),
]
NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "15_throws.ipynb"
GROUPS = ("calibration_device_only", "calibration_proof_body", "object_empty", "object_a")


@pytest.fixture(scope="module")
def found():
    return {g: {m: throws.fits(g, m) for m in throws.MODELS} for g in GROUPS}


@pytest.fixture(scope="module")
def model(found):
    """The model that the data ask for: all throws together, no truth looked at."""
    total = dict.fromkeys(throws.MODELS, 0.0)
    for group in GROUPS:
        for name, value in throws.preference(group, found[group]).items():
            total[name] += value
        print(group, throws.preference(group, found[group]))
    return min(total, key=total.get)


def test_the_data_ask_for_drag_and_bias(model):
    assert model == "delay drag bias"


def test_no_throw_diverges_from_a_blind_start(found, model):
    for group in GROUPS:
        # Errors of tenths of a per cent are not white: the status says so.
        assert {f.search.word for f in found[group][model]} == {"found"}
        assert "does not explain the readings" not in {
            f.explanation.word for f in found[group][model]
        }


def test_a_right_throw_has_no_cause_of_its_errors_and_one_read_wrong_has_its_own(found, model):
    for group in GROUPS:
        assert not any(f.causes for f in found[group][model])
    # Without drag most throws of the lighter object say what is missing.
    names = [cause.name for f in found["object_empty"]["delay"] for cause in f.causes]
    assert sum("drag" in name for name in names) >= 6
    right = throws.record(throws.FOLDER / "object_empty_log00179.csv")

    def words_of(record, torque=throws.LAW):
        (cause,) = identify.fit(throws.problem([record], model, torque), starts=1).causes
        return cause.words

    def misread(change):
        change_of = lambda x: jnp.asarray(change(np.asarray(x)))
        return words_of(eqx.tree_at(lambda r: r.readings[0].values, right, replace_fn=change_of))

    inertia = lambda law: law.parts[0].momentum.inertia
    other = eqx.tree_at(inertia, throws.LAW, replace_fn=lambda x: -x)
    assert words_of(right, other) == "most likely the torque with the other sign"
    with pytest.warns(UserWarning, match="the search goes on"):
        assert misread(np.degrees) == "most likely deg/s read as rad/s"
    words = misread(lambda w: w * np.array([1.0, -1.0, 1.0]))
    assert "the y axis mirrored" in words and "z" not in words
    assert misread(lambda w: w[:, [0, 2, 1]]) == "most likely y and z swapped"


def test_the_calibration_reproduces_the_proof_body(found, model):
    _, moments = throws.calibrate(*(found[g][model] for g in GROUPS[:2]))
    print("proof body", moments, moments / throws.PROOF_MOMENTS - 1)
    # The bar of the issue is 1 %; measured 0.8 %.
    np.testing.assert_allclose(moments, throws.PROOF_MOMENTS, rtol=0.01)


def errors_of(found, model, group):
    """Errors of each throw's moments (throws, 3), and how many intervals hold the truth."""
    device = found[GROUPS[0]][model]
    factor, _ = throws.calibrate(device, found[GROUPS[1]][model])
    _, truth = throws.OBJECTS[group]
    errors, covered = [], 0
    for fit in found[group][model]:
        moments = throws.object_moments(group, fit.body.tensor, device, factor)
        errors.append(moments / truth - 1)
        # The wheel's calibration is itself known to about a per cent.
        reach = 2 * np.hypot(throws.relative_deviation(fit), 0.01)
        covered += int(np.sum(np.abs(errors[-1]) <= reach))
    return np.array(errors), covered


@pytest.mark.parametrize("group", GROUPS[2:])
def test_an_object_of_known_inertia_comes_out_as_well_as_measured(found, model, group):
    errors, covered = errors_of(found, model, group)
    print(group, "mean |error| %", 100 * np.abs(errors).mean(), "mean", 100 * errors.mean(axis=0))
    print("worst %", 100 * np.abs(errors).max(), "intervals that hold", covered, "of", errors.size)
    # What is reached, so that a loss is seen; the bars are below.
    assert np.abs(errors).mean() <= 0.025
    assert np.abs(errors.mean(axis=0)).max() <= 0.04
    assert np.abs(errors).max() <= 0.08
    assert covered >= 0.5 * errors.size


@pytest.mark.xfail(
    strict=True,
    reason="mean errors 2.15 and 2.03 % a throw (bar 2), worst 7.0 and 6.1 % (bar 5): something is "
    "missing in the model; quadratic drag in the place of linear is no better",
)
@pytest.mark.parametrize("group", GROUPS[2:])
def test_the_bars_of_a_published_method(found, model, group):
    errors, _ = errors_of(found, model, group)
    assert np.abs(errors).mean() <= 0.02 and np.abs(errors).max() <= 0.05


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location(
        "bench_throws", Path(__file__).parents[1] / "benchmarks" / "identify" / "bench_throws.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_intervals_of_all_throws_of_a_body_with_an_unknown_torque_hold(bench):
    # Every third sample: their noise is nearly white after the low-pass filter at 200 Hz.
    records, levers = bench.given(3, 0.53)
    joint = bench.together(records)
    held = bench.throws_with_torque("white", joint, records, levers, whole=True)
    assert held.size == 9 and held.mean() >= 0.9


def test_the_recipe_of_four_bodies_with_one_sensor_meets_its_bars(bench):
    # Every second sample: a third of the time, the same figures to a tenth.
    errors, alone, together = bench.main(every=2)
    assert errors.mean() <= 0.016 and errors.max() <= 0.05
    assert alone.mean() >= 0.9 and together.all()


def test_a_drag_that_can_drive_does_not_lose_a_throw():
    # Fitted to a quarter of this throw, quadratic drag and bias run away beyond it.
    record = throws.record(throws.FOLDER / "object_empty_log00184.csv")
    law = throws.law(rj.torques.QuadraticDamping)
    free = [
        identify.Free(lambda s: s.torque.parts[0].momentum.delay, "delay", scale=1e-3, each=True),
        identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=1e-6),
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
    ]
    found = identify.fit(
        identify.Model(record, identify.Tensor(3e-4), torque=law, free=free), starts=1
    )
    assert (
        found.search.word == "found" and found.explanation.word != "does not explain the readings"
    )
    # Linear drag explains the same throw with 0.05 rad/s.
    assert found.rms[0] < 0.1


def test_the_notebook_gives_the_figures(monkeypatch):
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(NOTEBOOK.parent)
    monkeypatch.syspath_prepend(NOTEBOOK.parent)
    monkeypatch.delenv("RIGIDJAX_SHORT", raising=False)
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    space = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), space)
    # With the wheel calibrated by least squares of the proof body's moments it was 1.09, and joint
    # intervals were wider by a quarter; by the trace it is 1.105.
    for name, mean in (("calibration_proof_body", 0.8), ("object_empty", 1.25), ("object_a", 1.11)):
        error = 100 * (space["singles"][name][0] - np.log(space["MOMENTS"][name]))
        assert np.abs(error).mean() < mean
        middle, reach = space["together"][name]
        assert (np.abs(middle - np.log(space["MOMENTS"][name])) < reach).all()
        assert reach.max() < 0.04
