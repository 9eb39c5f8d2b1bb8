"""Several recordings, priors, comparison, design, checkpoints, reports."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.cli import spec
from rigidjax.cli.command import main
from rigidjax.cli.logs.errors import LogError
from rigidjax.identify.search import checkpoint
from rigidjax.identify.search.stages import Attempt, blocks_at
from rigidjax.identify.uncertainty import quantities

BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
DRAG = [0.05, 0.08, 0.02]
RATES = ([0.4, 1.2, -0.3], [1.0, 0.2, 0.5], [-0.3, 0.9, 1.1])


def law_of(speed, drag):
    wheel = rj.torques.Wheel(0.2, [0.0, 0.0, 1.0], speed)
    return rj.torques.Sum(rj.torques.Flywheel(wheel), rj.torques.Damping(drag))


LAW = law_of(rj.torques.Input("speed"), [0.0, 0.0, 0.0])


def throw(omega, bias, count=60, seed=0, sigma=0.005):
    """A damped body with a wheel inside, read by a gyro with a bias."""
    ts = jnp.asarray(np.arange(count) * 0.05)
    speed = rj.torques.Series(np.arange(80) * 0.05, 3.0 * np.tanh(np.arange(80) * 0.05))
    law = law_of(speed, DRAG)
    ys = rj.simulate(BODY, rj.Spin(omega), ts, law).ys.omega
    read = np.asarray(ys) + np.asarray(bias)
    read = read + sigma * np.random.default_rng(seed).normal(size=read.shape)
    gyro = identify.Gyro(sigma, bias=[0.0, 0.0, 0.0])
    return identify.Recording(ts, (gyro, read), inputs={"speed": speed})


FREE = [
    identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=0.05),
    identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05, each=True),
]
BIASES = ([0.02, -0.03, 0.01], [0.0, 0.05, 0.0], [-0.04, 0.0, 0.02])


@pytest.fixture(scope="module")
def records():
    counts = (60, 52, 60)
    return [
        throw(o, b, n, k) for k, (o, b, n) in enumerate(zip(RATES, BIASES, counts, strict=True))
    ]


@pytest.fixture(scope="module")
def joint(records):
    problem = identify.Model(records, identify.Tensor(1.5), torque=LAW, free=FREE)
    return identify.fit(problem, starts=1)


@pytest.mark.oldest
def test_three_throws_of_different_lengths_give_one_body_with_its_scale(joint):
    assert joint.ok
    bounds = joint.interval(0.999)
    truth = {"I1": 1.0, "I2": 1.6, "I3": 2.1, "Ixy": 0.0}
    truth |= {f"drag {a}": v for a, v in zip("xyz", DRAG, strict=True)}
    for record, bias in enumerate(BIASES):
        truth |= {f"bias {a} [{record}]": v for a, v in zip("xyz", bias, strict=True)}
    for name, value in truth.items():
        low, high = bounds[name]
        assert low <= value <= high, name
        assert high - low < 0.4
    assert joint.values["bias"].shape == (3, 3)
    assert joint.state0.omega.shape == (3, 3)
    assert joint.residuals[0].shape == (3, 60, 3)
    assert not np.asarray(joint.residuals[0])[1, 52:].any()
    assert 0.8 < joint.chi2 / joint.dof < 1.2


@pytest.mark.slow
def test_the_blocks_are_the_derivative(joint):
    model, x = joint.model, joint.x
    errors, blocks = blocks_at(model, x)
    where = np.asarray(model.index.places)
    for index in range(3):
        for column in (0, 1, 6, 10, 13):
            step = jnp.zeros(x.size).at[where[index, column]].set(1e-5)
            ends = (model.errors(x + sign * step)[0][index] for sign in (1, -1))
            slope = np.subtract(*ends) / 2e-5
            np.testing.assert_allclose(blocks[0][index, ..., column], slope, atol=1e-7)
    assert errors[0].shape == (3, 60, 3)


@pytest.mark.slow
def test_models_are_compared_and_the_right_one_wins(records, joint):
    plain = identify.Model(records, identify.Tensor(1.5), torque=LAW, free=FREE[1:])
    rows = identify.compare({"drag": joint, "no drag": identify.fit(plain, starts=1)})
    assert [row.name for row in rows] == ["drag", "no drag"]
    assert rows[0].information == 0 and rows[1].information > 10
    short = identify.Model(records[:1], identify.Tensor(1.5), torque=LAW, free=FREE[1:])
    short = identify.fit(short, starts=1)
    with pytest.raises(ValueError, match="wanted fits of the same readings"):
        identify.compare({"all": joint, "one": short})


@pytest.mark.slow
def test_the_left_out_throw_is_predicted_best_by_the_right_model(records):
    errors = []
    for free in (FREE, FREE[1:]):
        model = identify.Model(records, identify.Tensor(1.5), torque=LAW, free=free)
        fits = [identify.fit(model, starts=1, held_out=[index]) for index in range(3)]
        errors.append([pair.held_out for one in fits for pair in one.held_out.pairs])
    assert np.sum(np.square(errors[0])) < 0.8 * np.sum(np.square(errors[1]))


@pytest.mark.slow
def test_priors_hold_what_the_data_cannot_see(records):
    free = [
        identify.Free(
            lambda s: s.torque.parts[0].momentum.inertia,
            "wheel",
            scale=0.2,
            positive=True,
            prior=0.1,
        ),
        FREE[0],
        FREE[1],
    ]
    model = identify.Model(records, identify.Tensor(1.5), torque=LAW, free=free)
    found = identify.fit(model, starts=1)
    low, high = found.interval(0.95)["wheel"]
    # The scale of everything hangs on the wheel: its prior is all that is known of it.
    np.testing.assert_allclose(np.log(high / low) / (2 * 1.96), 0.1, rtol=0.1)


def test_the_entropic_prior_is_the_divergence():
    for chart, guess, other in (
        (identify.Tensor(1.0), BODY, rj.Inertia.from_principal(1.4, 1.5, 1.9)),
        (identify.Mass(rj.shapes.box(1.0, [1.0, 2.0, 3.0])), rj.shapes.box(1.0, [1.0, 2, 3]), None),
    ):
        prior = identify.Entropic(guess, 2.0)
        body = other if other is not None else chart.body(0.1 * jnp.arange(10.0))
        if isinstance(body, rj.MassProperties):
            wanted = rj.body.divergence(body, guess)
        else:
            ratio = np.linalg.solve(guess.second_moment, body.second_moment)
            wanted = np.trace(ratio) - np.log(np.linalg.det(ratio)) - 3
        np.testing.assert_allclose(0.5 * jnp.sum(prior.residuals(body) ** 2), 2 * wanted, rtol=1e-9)


@pytest.fixture(scope="module")
def free_record():
    ts = jnp.linspace(0.0, 30.0, 121)
    omega = rj.simulate(BODY, rj.Spin([0.4, 1.2, -0.3]), ts).ys.omega
    read = np.asarray(omega) + 0.01 * np.random.default_rng(9).normal(size=omega.shape)
    return identify.Recording(ts, (identify.Gyro(0.01), read))


@pytest.fixture(scope="module")
def short_record():
    """As many readings as in other files: one set of programs."""
    ts = jnp.linspace(0.0, 20.0, 80)
    omega = rj.simulate(BODY, rj.Spin([0.4, 1.2, -0.3]), ts).ys.omega
    read = np.asarray(omega) + 0.01 * np.random.default_rng(9).normal(size=omega.shape)
    return identify.Recording(ts, (identify.Gyro(0.01), read))


@pytest.mark.oldest
def test_a_design_expects_what_a_fit_then_finds(short_record):
    problem = identify.Model(short_record, identify.PrincipalRatios())
    found = identify.fit(problem, starts=1)
    plan = problem.start(BODY, [0.4, 1.2, -0.3])
    for before, after in zip(
        identify.expected_quantities(problem, plan), found.quantities, strict=True
    ):
        np.testing.assert_allclose(before.deviation, after.deviation, rtol=0.05)
    silent = identify.Recording(short_record.t, (identify.Gyro(), short_record.readings[0].values))
    with pytest.raises(ValueError, match="a Gyro with known noise"):
        identify.expected_quantities(identify.Model(silent, identify.PrincipalRatios()), plan)


def test_a_fit_killed_after_any_start_ends_at_the_same_bits(short_record, tmp_path, monkeypatch):
    """The starts to come depend on those that were, not on the process."""
    problem = identify.Model(short_record, identify.PrincipalRatios())
    path, save = tmp_path / "fit.npz", checkpoint.Checkpoint.save
    saved = []

    class KillError(Exception):
        pass

    def fit(last=None):
        def killed(self, done):
            save(self, done)
            saved.append(len(done))
            if len(saved) == last:
                raise KillError

        monkeypatch.setattr(checkpoint.Checkpoint, "save", killed)
        saved.clear()
        return identify.fit(problem, starts=4, max_steps=30, checkpoint=path)

    whole = fit().x
    assert saved == [1, 2, 3, 4]
    for last in range(1, 5):
        path.unlink()
        with pytest.raises(KillError):
            fit(last)
        np.testing.assert_array_equal(fit().x, whole, err_msg=f"killed after {last}")
        # Nothing is done twice.
        assert saved == list(range(last + 1, 5))
    other = identify.Model(short_record, identify.PrincipalRatios(), loss=identify.Huber(0.5))
    with pytest.raises(ValueError, match="wanted the checkpoint of this model"):
        identify.fit(other, starts=4, checkpoint=path)


def test_a_checkpoint_is_known_by_all_that_the_search_depends_on(short_record):
    """By the bytes, not by one sum of misfits: that of NaN equals none, that of ∞ any other."""
    reading = short_record.readings[0]

    def print_of(values, noise=0.01, body=None, count=2):
        record = identify.Recording(short_record.t, (identify.Gyro(noise), values))
        problem = identify.Model(record, body or identify.PrincipalRatios())
        odd = jnp.asarray([jnp.inf, jnp.nan])
        return checkpoint.fingerprint([problem.start()] * count, problem, odd, 1e-4)

    values = np.asarray(reading.values)
    near = values.copy()
    # A sum of misfits is the same for readings in another order.
    near[[3, 4]] = near[[4, 3]]
    found = [
        print_of(values),
        print_of(near),
        print_of(np.nextafter(values, np.inf)),
        print_of(values, noise=0.02),
        print_of(values, body=identify.Ratios()),
        print_of(values, count=3),
    ]
    assert len(set(found)) == len(found) and found[0] == print_of(values)


def test_a_checkpoint_of_other_options_is_refused(short_record, tmp_path):
    problem, path = identify.Model(short_record, identify.PrincipalRatios()), tmp_path / "fit.npz"
    found = identify.fit(problem, starts=1, max_steps=20, checkpoint=path)
    again = identify.fit(problem, starts=1, max_steps=20, checkpoint=path)
    np.testing.assert_array_equal(found.x, again.x)
    for other in ({"max_steps": 21}, {"tolerance": 1e-3}):
        with pytest.raises(ValueError, match="of this model and these options, got that of others"):
            identify.fit(problem, starts=1, checkpoint=path, **{"max_steps": 20, **other})


def test_sensors_and_wheels_of_one_kind_have_names_of_their_own(tmp_path):
    path, rng = tmp_path / "log.csv", np.random.default_rng(0)
    table = np.column_stack([np.arange(20.0) / 8, rng.normal(size=(20, 8))])
    np.savetxt(path, table, delimiter=",", header="t,a,b,c,d,e,f,s,r")
    channels = [spec.parse_channel(text) for text in ("gyro=a,b,c", "gyro=d,e,f")]
    wheels = [spec.parse_wheel(text) for text in ("s:1e-6:x", "r:1e-6:y")]
    free = ("bias", "delay")
    record = spec.read_log(path, channels, wheels=wheels, free=free)
    slots = spec.model_of([record], "tensor", wheels=wheels, free=free).slots
    names = ["gyro 1 bias", "gyro 2 bias", "wheel 1 delay", "wheel 2 delay"]
    assert [slot.name for slot in slots] == names


@pytest.mark.parametrize("kind", ["empty", "cut", "text", "table", "fewer"])
def test_a_damaged_checkpoint_is_told_in_words(short_record, tmp_path, kind):
    problem = identify.Model(short_record, identify.PrincipalRatios())
    path = tmp_path / "fit.npz"
    like = Attempt(problem.start(), jnp.asarray(1.0), jnp.asarray(True))
    checkpoint.Checkpoint(path, like, "2").save([like])
    whole = path.read_bytes()
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "text":
        path.write_text("t,wx,wy,wz")
    elif kind == "table":
        np.savez(path, t=np.arange(3))
    else:
        path.write_bytes(whole[:-8])
    before = path.read_bytes()
    with pytest.raises(
        ValueError, match="wanted the checkpoint of a fit, got another file or a damaged one"
    ):
        checkpoint.Checkpoint(path, like, "2")
    assert path.read_bytes() == before


def test_a_model_is_a_value(short_record):
    problem = identify.Model(short_record, identify.PrincipalRatios(), loss=identify.Huber())
    plain = dataclasses.replace(problem, loss=None)
    assert plain.loss is None and problem.loss is not None and plain.torque is None
    other = identify.Model(short_record, identify.PrincipalRatios())
    assert eqx.tree_equal(plain, other)
    assert eqx.tree_equal(dataclasses.replace(plain, loss=problem.loss), problem)
    with pytest.raises(TypeError, match="'torqe' is no argument of a Model"):
        identify.Model(short_record, identify.PrincipalRatios(), torqe=None)


def test_a_checkpoint_needs_its_folder_before_the_search_begins(short_record, tmp_path):
    problem = identify.Model(short_record, identify.PrincipalRatios())
    with pytest.raises(ValueError, match=r"there is no folder .*absent"):
        identify.fit(problem, starts=1, checkpoint=tmp_path / "absent" / "fit.npz")
    with pytest.raises(ValueError, match="wanted a file, got a folder"):
        identify.fit(problem, starts=1, checkpoint=tmp_path)


KILLED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import numpy as np, jax.numpy as jnp, rigidjax as rj
from rigidjax import identify
ts = jnp.linspace(0.0, 30.0, 121)
omega = rj.simulate(rj.Inertia.from_principal(1.0, 1.6, 2.1), rj.Spin([0.4, 1.2, -0.3]), ts).ys.omega
read = np.asarray(omega) + 0.01 * np.random.default_rng(9).normal(size=omega.shape)
problem = identify.Model(identify.Recording(ts, (identify.Gyro(0.01), read)), identify.Ratios())
found = identify.fit(problem, starts=int(sys.argv[2]), checkpoint=sys.argv[1], progress=print)
np.save(sys.argv[3], found.x)
"""


@pytest.mark.slow
def test_a_killed_fit_resumes_to_the_same_point(tmp_path):
    def run(name, **how):
        ends = str(tmp_path / f"{name}.npz"), "40", str(tmp_path / f"{name}.npy")
        return subprocess.Popen([sys.executable, "-c", KILLED, *ends], **how)

    assert run("whole").wait(600) == 0
    process = run("killed")
    while not (tmp_path / "killed.npz").exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert run("killed").wait(600) == 0
    np.testing.assert_array_equal(np.load(tmp_path / "killed.npy"), np.load(tmp_path / "whole.npy"))


# The fit of another test, or one of its own (another program).
@pytest.mark.parametrize("own", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_command_line_reads_wheels_and_writes_reports(
    records, joint, tmp_path, capsys, monkeypatch, own
):
    asked = []

    def fit(problem, **how):
        asked.append((problem, how))
        return joint

    if not own:
        monkeypatch.setattr(identify, "fit", fit)
    paths = []
    for index, record in enumerate(records[::2] if own else records):
        speed = 3.0 * np.tanh(np.asarray(record.t))
        rows = np.column_stack([record.t, record.readings[0].values, speed])
        paths.append(str(tmp_path / f"throw{index}.csv"))
        np.savetxt(paths[-1], rows, delimiter=",", header="t,wx,wy,wz,s", comments="")
    page, numbers = tmp_path / "out.html", tmp_path / "out.json"
    command = ["identify", *paths, "--wheel", "s:0.2:z", "--model", "tensor", "--typical", "1.5"]
    command += ["--free", "drag", "bias", "--starts", "1"]
    assert main([*command, "--report", str(page), "--json", str(numbers)]) == 0
    out = capsys.readouterr().out
    assert "status: ok" in out and "I3" in out and "drag x" in out
    held = json.loads(numbers.read_text())
    assert held["status"].startswith("ok") and held["files"] == [
        f"throw{i}.csv" for i in range(len(paths))
    ]
    low, high = held["quantities"]["I3"]["interval_95"]
    assert 0.9 * low < 2.1 < 1.1 * high
    text = page.read_text()
    # Data and fit of each throw, what is left over, the body with its uncertainty.
    assert text.count("data:image/png;base64,") == len(paths) + 2
    assert "http" not in text
    assert "throw1.csv" in text and "95 % interval" in text
    if not own:
        _asks_for(asked, joint.model)


def _asks_for(asked, wanted):
    """What was written is read: readings, wheel speeds, the model, what is free."""
    ((problem, how),) = asked
    assert how["starts"] == 1 and how["checkpoint"] is None
    assert isinstance(problem.charts[0], identify.Tensor) and problem.charts[0].typical == 1.5
    assert {slot.name: slot.each for slot in problem.slots} == {"drag": False, "gyro bias": True}
    for found, given in zip(problem.recordings, wanted.recordings, strict=True):
        np.testing.assert_array_equal(found.t, given.t)
        np.testing.assert_array_equal(found.readings[0].values, given.readings[0].values)
        np.testing.assert_array_equal(problem.torque.parts[1].coefficient, np.zeros(3))
        momentum = rj.torques.bind(problem.torque, found.inputs).parts[0].momentum(1.0)
        np.testing.assert_allclose(momentum, [0.0, 0.0, 0.6 * np.tanh(1.0)], rtol=1e-15)


WRONG = [
    (["--sensor", "gyro=wx,wy"], "wanted 3 columns, got 'wx,wy'"),
    (["--sensor", "compass=a,b,c"], "wanted gyro, accelerometer, quaternion or euler-SEQUENCE"),
    (
        ["--sensor", "gyro=wx,wy,wz:km/h"],
        "wanted the unit rad/s or deg/s or mdeg/s or rpm, got 'km/h'",
    ),
    (["--sensor", "gyro=wx,wy,wz:rad/s:-1"], "wanted a positive noise"),
    (["--sensor", "gyro=wx,wy,wz:rad/s:1,2"], "wanted one noise or three, got 2"),
    (["--noise", "0.1", "0.0", "0.1"], "--noise: wanted a positive noise, got 0"),
    (["--limit", "-2"], "--limit: wanted a positive number, got -2.0"),
    (["--wheel", "s"], "wanted COLUMN:INERTIA"),
    (["--wheel", "s:1:w"], "wanted an axis x, y or z"),
    (["--model", "tensor"], "free motion shows ratios only; a scale needs a --wheel"),
    (
        ["--window", "5", "6"],
        "wanted at least 4 samples between 5 and 6 s from the first stamp, got 0; the log goes from 0 to 1.1 s",
    ),
]


@pytest.mark.parametrize(("options", "words"), WRONG)
def test_mistakes_on_the_command_line(options, words, tmp_path, capsys):
    path = tmp_path / "log.csv"
    rows = "\n".join(f"{0.1 * k:.1f},1,0,{0.01 * k},3" for k in range(12))
    path.write_text("t,wx,wy,wz,s\n" + rows)
    assert main(["identify", str(path), *options]) == 2
    out = capsys.readouterr()
    assert words in out.err and out.err.count("\n") == 1 and out.out == ""


def test_logs_of_other_kinds(tmp_path):
    t = np.arange(6) * 0.1
    np.savez(tmp_path / "a.npz", t=t, w=np.ones(6))
    assert identify.read_table(tmp_path / "a.npz", ["t", "w"])["w"].shape == (6,)
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"t": t, "w": np.ones(5)})
    with pytest.raises(LogError, match="arrays of different lengths"):
        identify.read_table(tmp_path / "a.mat", ["t", "w"])
    with pytest.raises(LogError, match="no column 'q'; the columns are t, w"):
        identify.read_table(tmp_path / "a.npz", ["q"])


MISTAKES = [
    (lambda r: identify.Free(lambda s: s.sensors[0].scale, "scale"), "None is there; give it a starting value"),
    (lambda r: identify.Free(lambda s: s.sensors[3], "x"), "nothing is there"),
    (lambda r: identify.Free(lambda s: s.sensors[0], "x"), "wanted one array, got Gyro"),
    (lambda r: identify.Free(lambda s: s.sensors[0].bias, "x", positive=True), "wanted a positive starting value"),
    (lambda r: identify.Free(lambda s: s.sensors[0].scale[0], "scale"), "None is there; give it a starting value"),
    (lambda r: identify.Free(lambda s: 3 * s.sensors[0].bias, "x"), "a function of them is no place"),
    (lambda r: identify.Free(lambda s: -s.sensors[0].bias[1], "x"), "a function of them is no place"),
    (lambda r: identify.Free(lambda s: jnp.sum(s.sensors[0].bias), "x"), "a function of them is no place"),
    (lambda r: identify.Free(lambda s: s.sensors[0].bias.T, "x"), "a function of them is no place"),
    (lambda r: identify.Free(lambda s: s.sensors[0].bias[[0, 0]], "x"), r"each once, got \[0, 0\]"),
    (lambda r: identify.Free(lambda s: s.sensors[0].bias[3], "x"), "nothing is there .*out of bounds"),
    (lambda r: identify.Free(lambda s: s.body.com, "x"), "numbers of the body are those of the model's chart"),
    (lambda r: identify.Free(lambda s: s.body, "x"), "numbers of the body are those of the model's chart"),
    (lambda r: identify.Free(lambda s: s.body[0], "x"), "numbers of the body are those of the model's chart"),
    (lambda r: identify.Free(lambda s: s.start.omega, "x"), "the initial state needs no Free"),
]  # fmt: skip


@pytest.mark.parametrize(("free", "words"), MISTAKES)
@pytest.mark.usefixtures("unhooked")
def test_what_is_free_is_checked(records, free, words):
    with pytest.raises(ValueError, match=words):
        identify.Model(records, identify.Tensor(1.5), free=[free(records)])


@pytest.mark.usefixtures("unhooked")
def test_entries_of_an_array_are_free_by_themselves(records):
    """Some entries of a drag and a bias move, the others keep their values; no entry is free twice."""
    free = [
        identify.Free(lambda s: s.torque.parts[1].coefficient[2], "drag z", scale=0.05),
        identify.Free(
            lambda s: s.torque.parts[1].coefficient[:1], "drag", scale=0.05, positive=True
        ),
        identify.Free(lambda s: s.sensors[0].bias[jnp.array([2, 0])], "bias", scale=0.1, each=True),
    ]
    law = law_of(rj.torques.Input("speed"), [0.2, 0.3, 0.4])
    model = identify.Model(records, identify.Known(BODY), torque=law, free=free)
    assert model.size == 1 + 1 + 3 * 2 + 3 * 3
    x = model.start()
    drag_z, drag, bias = model.slots
    x = x.at[drag_z.shared[0]].set(2.0).at[drag.shared[0, 0]].set(10.0)
    x = x.at[bias.own].set(jnp.arange(6.0).reshape(3, 2))
    scenes = eqx.filter_jit(model.scenes)(x)
    moved = [0.2 * np.exp(0.5), 0.3, 0.5]
    np.testing.assert_allclose(scenes.torque.parts[1].coefficient, [moved] * 3, rtol=1e-12)
    biases = [[0.1, 0.0, 0.0], [0.3, 0.0, 0.2], [0.5, 0.0, 0.4]]
    np.testing.assert_allclose(scenes.sensors[0].bias, biases, atol=1e-12)
    values = eqx.filter_jit(model.values)(x)
    np.testing.assert_allclose(values["drag z"], 0.5)
    np.testing.assert_allclose(values["drag"], [moved[0]])
    np.testing.assert_allclose(values["bias"], np.array(biases)[:, [2, 0]])
    again = identify.Free(lambda s: s.torque.parts[1].coefficient, "drag again")
    with pytest.raises(ValueError, match="another Free already frees the same numbers"):
        identify.Model(records, identify.Known(BODY), torque=law, free=[*free, again])
    walk = identify.Walk(lambda s: s.sensors[0].bias[1], 0.1, 1e-3)
    drifting = identify.Model(records[1], identify.Known(BODY), torque=law, walks=walk)
    belief = identify.first_belief(drifting, rate=0.1)
    assert belief.walks[0].shape == () and belief.deviation.shape == (4,)


@pytest.mark.usefixtures("unhooked")
def test_other_mistakes_are_named(records, short_record):
    with pytest.raises(ValueError, match="the one at index 1 differs from the first"):
        identify.Model([records[0], short_record], identify.Tensor(1.5))
    with pytest.raises(ValueError, match="at least one Recording, got an empty sequence"):
        identify.Model([], identify.Tensor(1.5))
    with pytest.raises(ValueError, match="it reads 'speed', and recording 0 has no inputs; give"):
        identify.Model(short_record, identify.Tensor(1.5), torque=LAW)
    marker = identify.Recording([0.0, 1.0], (identify.Marker([0.0, 0, 0]), np.zeros((2, 3))))
    words = (
        r"Marker needs .*wanted Mass\(guess\) or Known.*take Mass\(guess, \['inertia'\]\).*origin="
    )
    for chart in (identify.Tensor(1.0), identify.Ratios()):
        with pytest.raises(ValueError, match=words):
            identify.Model(marker, chart)
    with pytest.raises(ValueError, match="wanted a positive moment of inertia"):
        identify.Tensor(-1.0)
    with pytest.raises(ValueError, match="substeps: wanted a whole number of at least 1, got 0"):
        identify.FixedSteps(0)
    with pytest.raises(ValueError, match="a positive number, got 0"):
        identify.Free(lambda r: r, "x", scale=0.0)


def test_free_numbers_are_reported_with_their_units():
    ts = jnp.linspace(0.0, 1.0, 20)
    speed = rj.torques.Series(ts, 100.0 + ts)
    wheel = rj.torques.Wheel(1e-6, [0, 0, 1], speed, delay=0.0, tilt=[0.0, 0.0])
    law = rj.torques.Sum(rj.torques.Flywheel(wheel), rj.torques.Damping([1e-6, 1e-6, 1e-6]))
    gyro = rj.identify.Gyro(0.01, bias=[0, 0, 0], scale=[1, 1, 1], offset=0.0)
    record = rj.identify.Recording(ts, (gyro, jnp.ones((20, 3))))
    sensor = lambda name: lambda s: getattr(s.sensors[0], name)
    free = [rj.identify.Free(sensor(name), name) for name in ("bias", "scale", "offset")]
    free += [
        rj.identify.Free(lambda s: s.torque.parts[0].momentum.tilt, "tilt"),
        rj.identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", unit="N m s"),
    ]
    problem = rj.identify.Model(record, rj.identify.Principal(1e-3), torque=law, free=free)
    units = {name.split()[0]: unit for name, unit, _ in quantities.labels(problem)}
    wanted = {"bias": "rad/s", "scale": "", "offset": "s", "tilt": "rad", "drag": "N m s"}
    assert {name: units[name] for name in wanted} == wanted


def test_steps_that_were_asked_for_are_kept_where_they_do():
    body, ts = rj.Inertia.from_principal(1.0, 2.0, 2.5), jnp.linspace(0.0, 2.0, 6)
    law = rj.torques.Damping([0.1, 0.2, 0.1])
    omega = rj.simulate(body, rj.Spin([0.3, 1.0, 0.2]), ts, law).ys.omega
    record = identify.Recording(ts, (identify.Gyro(0.01), omega))
    # More than a fit would take by itself before it goes on with steps as they are needed.
    steps = identify.FixedSteps(40)
    model = identify.Model(record, identify.Known(body), torque=law, integrator=steps)
    found = identify.fit(model, starts=1)
    assert found.model.integrator == steps
    np.testing.assert_allclose(found.state0.omega, omega[0], atol=1e-6)


@pytest.mark.parametrize("steps", [identify.FixedSteps(1), identify.Adaptive(1e-2, 1e-5)])
def test_steps_that_are_too_long_become_finer(steps):
    body, ts = rj.Inertia.from_principal(1.0, 2.0, 2.5), jnp.linspace(0.0, 8.0, 6)
    law, start = rj.torques.Damping([0.1, 0.2, 0.1]), rj.Spin([0.3, 2.0, 0.2])
    omega = rj.simulate(body, start, ts, law).ys.omega
    record = identify.Recording(ts, (identify.Gyro(1e-4), omega))
    problem = identify.Model(record, identify.Known(body), torque=law, integrator=steps)
    there = problem.start(omega=omega[0])
    assert np.abs(problem.errors(there)[0]).max() > 1e-4
    found = identify.fit(problem, starts=1)
    assert found.model.integrator != steps
    np.testing.assert_allclose(found.state0.omega, omega[0], atol=1e-5)


def test_a_motion_that_outlasts_its_digits_is_named():
    """No tolerance suffices for a chaotic top: without a word its fit would look like any other."""
    # The chaotic top of row D14.
    body, ts = rj.Inertia.from_principal(1.0, 1.6, 2.2), jnp.linspace(0.0, 200.0, 100)
    top = rj.torques.HeavyTop(1.0, [1.0, 0.4, 0.7], [0.0, 0.0, -1.0])
    q = np.array([0.29457358, 0.51677653, 0.16788989, 0.78611794])
    start = rj.Attitude(q / np.linalg.norm(q), [1.40904798, 2.72002574, -1.26857553])
    ys = rj.simulate(body, start, ts, top).ys
    sensors = ((identify.AttitudeSensor(0.01), ys.q), (identify.Gyro(0.01), ys.omega))
    record, steps = identify.Recording(ts, *sensors), identify.Adaptive()
    problem = identify.Model(record, identify.Known(body), torque=top, integrator=steps)
    found = identify.fit(problem, starts=1, max_steps=2)
    assert "the shortest steps still change readings by" in found.status
