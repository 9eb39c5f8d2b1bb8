"""A body in a hand: the motion is logged, a sensor reads the wrench, the ten numbers are fitted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import filter_once, once
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax import identify
from rigidjax.cli import command, spec
from rigidjax.cli.logs.errors import LogWarning
from rigidjax.identify.data.stacking import pad_to_few
from rigidjax.motion.torques import Carried, LoggedMotion

G = np.array([0.0, 0.0, -9.81])
NOISE = np.array([0.05, 0.05, 0.05, 0.0025, 0.0025, 0.0025])
T = np.linspace(0.0, 6.0, 301)


def path(t):
    """A wrist's motion in closed form: a about z, then b about the new x (as in motion)."""
    a, da, dda = 1.1 * np.sin(2 * t), 2.2 * np.cos(2 * t), -4.4 * np.sin(2 * t)
    b, db, ddb = 0.9 * np.sin(3 * t + 1), 2.7 * np.cos(3 * t + 1), -8.1 * np.sin(3 * t + 1)
    x = np.stack([0.2 * np.sin(2 * t), 0.1 * np.cos(3 * t), 0.1 * np.sin(t)], -1)
    acc = np.stack([-0.8 * np.sin(2 * t), -0.9 * np.cos(3 * t), -0.1 * np.sin(t)], -1)
    q = Rotation.from_euler("ZX", np.stack([a, b], -1)).as_quat(scalar_first=True)
    s, c = np.sin(b), np.cos(b)
    omega = np.stack([db, s * da, c * da], -1)
    alpha = np.stack([ddb, s * dda + c * db * da, c * dda - s * db * da], -1)
    return x, acc, q, omega, alpha


X, ACC, Q, OMEGA, ALPHA = path(T)
TURN = Rotation.from_quat(Q, scalar_first=True)
LOG = LoggedMotion(T, X, Q, OMEGA, TURN.inv().apply(ACC), ALPHA)


@once
def bodies():
    turn = rj.so3.exp(jnp.array([0.3, 0.2, -0.5]))
    tensor = turn @ jnp.diag(jnp.array([3e-4, 1.1e-3, 4e-5])) @ turn.T
    tool = rj.MassProperties(0.7, [0.02, -0.03, 0.11], tensor)
    return tool, rj.shapes.box(1.0, [0.1, 0.1, 0.1])


TOOL, GUESS = bodies()


def wrench_of(body, place=(0.0, 0.0, 0.0), gravity=G):
    """What the hand exerts at `place`, body axes: Newton and Euler in NumPy, about the place."""
    mass, com, tensor = float(body.mass), np.asarray(body.com), np.asarray(body.inertia.tensor)
    arm = com - place
    felt = TURN.inv().apply(ACC - gravity)
    felt = felt + np.cross(ALPHA, com) + np.cross(OMEGA, np.cross(OMEGA, com))
    force = mass * felt
    turning = ALPHA @ tensor + np.cross(OMEGA, OMEGA @ tensor)
    return np.concatenate([force, turning + np.cross(arm, force)], axis=1)


def model_of(readings, chart=None, free=(), **sensor):
    sensor = identify.ForceTorque(**{"noise": NOISE, "gravity": G, **sensor})
    record = identify.Recording(T, (sensor, readings), inputs={"motion": LOG})
    chart = identify.Mass(GUESS) if chart is None else chart
    return identify.Model(record, chart, torque=Carried(), free=free)


def ten_numbers(body):
    return np.r_[body.mass, body.com, np.asarray(body.inertia.tensor)[np.triu_indices(3)]]


def test_an_exact_record_gives_the_body():
    fit = identify.fit(model_of(wrench_of(TOOL)))
    assert fit.ok and fit.model.size == 10
    scale = np.r_[0.7, 1, 1, 1, np.full(6, float(TOOL.inertia.moments[2]))]
    off = np.abs(ten_numbers(fit.body) - ten_numbers(TOOL)) / scale
    assert off[:4].max() < 1e-11
    assert off[4:].max() < 1e-9
    names = [quantity.name for quantity in fit.quantities]
    assert not any("Ω" in name for name in names)


def test_noise_gives_intervals_and_a_possible_body():
    rng = np.random.default_rng(5)
    readings = wrench_of(TOOL) + NOISE * rng.normal(size=(T.size, 6))
    fit = identify.fit(model_of(readings))
    assert fit.ok
    assert (np.linalg.eigvalsh(fit.body.second_moment) > -1e-12).all()
    low, high = fit.interval_of(lambda point: jnp.r_[point.body.mass, point.body.com])
    truth = ten_numbers(TOOL)[:4]
    for quantity in fit.quantities:
        low_end, high_end = quantity.interval()
        assert low_end < quantity.value < high_end
    # Two of these four 95 % intervals may miss at once in one of seventy sets.
    assert ((low <= truth) & (truth <= high)).sum() >= 3
    assert ((high - low) < [0.02, 0.005, 0.005, 0.005]).all()


def test_the_readings_of_a_simulated_sensor_are_the_wrench():
    place, turn = np.array([0.01, 0.02, -0.05]), np.array([0.2, -0.4, 0.1])
    sensor = identify.ForceTorque(
        NOISE, gravity=G, place=place, mounting=turn, bias=np.arange(6.0), scale=np.full(6, 1.1)
    )
    start = rj.Rigid(np.zeros(3), np.zeros(3), [1.0, 0, 0, 0], np.zeros(3))
    got = identify.simulate_readings(sensor, TOOL, start, T, Carried(LOG))
    whole = wrench_of(TOOL, place).reshape(-1, 2, 3)
    seen = Rotation.from_rotvec(turn).inv().apply(whole.reshape(-1, 3)).reshape(-1, 6)
    np.testing.assert_allclose(got, 1.1 * seen + np.arange(6.0), rtol=0, atol=1e-11)


def test_bias_gravity_and_clock_are_found_beside_the_body():
    bias = np.array([0.3, -0.2, 0.5, 0.01, 0.02, -0.03])
    free = [
        identify.Free(lambda s: s.sensors[0].bias, "bias"),
        identify.Free(lambda s: s.sensors[0].offset, "clock", unit="s", scale=0.01),
    ]
    late = np.stack([np.interp(T + 0.004, T, row) for row in wrench_of(TOOL).T], axis=1)
    model = model_of(late + bias, free=free, bias=np.zeros(6), offset=0.0)
    found = identify.fit(model)
    np.testing.assert_allclose(found.values["bias"], bias, rtol=0, atol=0.02)
    np.testing.assert_allclose(found.values["clock"], 0.004, rtol=0, atol=2e-4)
    np.testing.assert_allclose(found.body.mass, 0.7, rtol=2e-3)


def test_padding_a_record_leaves_its_last_accelerations():
    """A fit pads records to few lengths, and their tables: the end of the log stays where it was."""
    poses = filter_once(LoggedMotion)(T, X, Q)
    sensor = identify.ForceTorque(NOISE, gravity=G)
    start = rj.Rigid(np.zeros(3), np.zeros(3), [1.0, 0, 0, 0], np.zeros(3))
    readings = identify.simulate_readings(sensor, TOOL, start, T, Carried(poses))
    record = identify.Recording(T, (sensor, readings), inputs={"motion": poses})
    model = identify.Model(record, identify.Mass(GUESS), torque=Carried())
    longer = pad_to_few(model)
    assert longer.records.t.shape[1] > T.size
    errors = filter_once(longer.errors)(model.start(TOOL))[0][0]
    np.testing.assert_allclose(errors, 0.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lengths", [[0.0, 0.0, 0.3], [0.0, 0.0, 0.0]])
def test_a_rod_and_a_point_need_no_inverse(lengths):
    second = jnp.diag(jnp.asarray(lengths) ** 2 * 0.4 / 12)
    thin = rj.MassProperties(0.4, [0.0, 0.1, 0.2], second)
    bias = 0.01 * np.arange(6.0)
    model = model_of(
        wrench_of(thin) + bias, identify.Known(thin), bias=np.zeros(6),
        free=[identify.Free(lambda s: s.sensors[0].bias, "bias")],
    )  # fmt: skip
    fit = identify.fit(model)
    np.testing.assert_allclose(fit.values["bias"], bias, rtol=0, atol=1e-9)


def test_two_tools_and_two_records_of_one_share_one_program():
    other = rj.MassProperties(0.3, [0.0, 0.05, 0.02], jnp.diag(jnp.array([2e-4, 3e-4, 1e-4])))
    record = lambda body: identify.Recording(
        T,
        (identify.ForceTorque(NOISE, gravity=G), wrench_of(body)),
        inputs={"motion": LOG},
    )
    charts = {"tool": identify.Mass(GUESS), "other": identify.Mass(GUESS)}
    recordings = {"tool": [record(TOOL), record(TOOL)], "other": record(other)}
    fit = identify.fit(identify.Model(recordings, charts, torque=Carried()))
    for name, body in (("tool", TOOL), ("other", other)):
        np.testing.assert_allclose(fit.body[name].mass, body.mass, rtol=1e-10)
        tensor = fit.body[name].inertia.tensor
        np.testing.assert_allclose(tensor, body.inertia.tensor, rtol=0, atol=1e-11)


def test_the_derivative_of_the_readings_is_that_of_differences():
    model = model_of(wrench_of(TOOL), free=[identify.Free(lambda s: s.sensors[0].gravity, "g")])
    x = model.start(TOOL)
    along = np.random.default_rng(1).normal(size=x.size)
    errors = jax.jit(lambda s: model.errors(x + s * along)[0])
    _, tangent = jax.jvp(errors, (jnp.zeros(()),), (jnp.ones(()),))
    difference = (errors(1e-5) - errors(-1e-5)) / 2e-5
    np.testing.assert_allclose(tangent, difference, rtol=0, atol=1e-8 * np.abs(tangent).max())


@pytest.mark.parametrize("turned", ["gravity", "readings"])
def test_the_wrong_sign_is_named(turned):
    readings = wrench_of(TOOL) + NOISE * np.random.default_rng(2).normal(size=(T.size, 6))
    wrong = model_of(readings, gravity=-G) if turned == "gravity" else model_of(-readings)
    fit = identify.fit(wrong)
    assert not fit.ok
    assert [cause.name for cause in fit.causes] == ["sign"]


@pytest.mark.usefixtures("unhooked")
def test_gravity_is_asked_for():
    with pytest.raises(ValueError, match="gravity"):
        identify.ForceTorque(NOISE)
    assert identify.ForceTorque((0.1, 0.2), gravity=G).noise.tolist() == [0.1] * 3 + [0.2] * 3


@pytest.mark.slow
def test_intervals_hold_over_many_records():
    """95 % intervals of mass, centre and the six components, over 200 records of one tool."""
    from rigidjax.identify.model.charts import COMPONENTS

    def numbers(point):
        tensor = point.body.inertia.tensor
        six = jnp.stack([tensor[k] for k in COMPONENTS])
        return jnp.concatenate([point.body.mass[None], point.body.com, six])

    truth = np.r_[0.7, np.asarray(TOOL.com), [float(TOOL.inertia.tensor[k]) for k in COMPONENTS]]
    held, exact = [], wrench_of(TOOL)
    for seed in range(200):
        noise = NOISE * np.random.default_rng(seed).normal(size=exact.shape)
        low, high = identify.fit(model_of(exact + noise)).interval_of(numbers)
        held.append((low <= truth) & (truth <= high))
    # 2 000 intervals, of which ten share a record: three standard deviations are about 2 %.
    assert 0.93 < np.mean(held) < 0.97


def test_the_command_line_reads_poses_and_a_wrench(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(11)
    readings = wrench_of(TOOL) + NOISE * rng.normal(size=(T.size, 6))
    names = "t,x,y,z,qw,qx,qy,qz,fx,fy,fz,tx,ty,tz"
    rows = np.column_stack([1e3 * T, X, Q, readings])
    np.savetxt("tool.csv", rows, delimiter=",", header=names, comments="", fmt="%.10g")
    wrench = ["--wrench", "fx", "fy", "fz", "tx", "ty", "tz", "--time-unit", "ms"]
    noise = ["--noise", "0.05", "0.0025", "--figure", "tool.png", "--no-cache"]
    (tmp_path / "arm.urdf").write_text(ARM)
    place, turn = np.array([0.1, -0.2, 0.05]), Rotation.from_euler("xyz", [0.4, 1.0, -0.7])
    mount = ["--mount", *map(str, [*place, *turn.as_quat(scalar_first=True)])]
    write = ["--write", "arm.urdf", *mount, "--yes"]
    assert command.main(["identify", "tool.csv", *wrench, *noise, *write]) == 0
    said = capsys.readouterr().out
    assert "status: ok" in said
    low, high = (
        float(number)
        for number in said.split("\nmass")[1].split("kg")[0].split(maxsplit=1)[1].split("…")
    )
    assert low < 0.7 < high < low + 0.01
    assert (tmp_path / "tool.png").stat().st_size > 10_000
    # The file has the tool in its own frame, whose axes are turned and whose origin is elsewhere.
    body, turning = rj.body.read_inertials("arm.urdf")["tool"], turn.as_matrix()
    np.testing.assert_allclose(body.mass, 0.7, atol=2e-3)
    np.testing.assert_allclose(body.com, place + turning @ np.asarray(TOOL.com), atol=2e-3)
    wanted = turning @ np.asarray(TOOL.inertia.tensor) @ turning.T
    np.testing.assert_allclose(body.inertia.tensor, wanted, atol=8e-5)
    new, old = said.split("error of the ForceTorque: ")[1].split("\n")[0].rsplit(", ", 1)
    assert 0.08 < float(new.split()[0]) < 0.1 < 1.0 < float(old.split()[0])
    assert "no body" not in said and 'rpy="0.3 0.2 0.1"' in (tmp_path / "arm.urdf").read_text()


ARM = """<robot name="arm"><link name="base"/><link name="tool"><inertial>
  <origin xyz="0 0 0" rpy="0.3 0.2 0.1"/><mass value="1"/>
  <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/>
</inertial></link></robot>
"""


def test_rows_with_empty_cells_are_gaps(tmp_path):
    rows = np.column_stack([T, X, Q, wrench_of(TOOL)])
    rows[40, 9] = np.nan  # of the wrench
    rows[70, 2] = np.nan  # of the pose
    names = "t,x,y,z,qw,qx,qy,qz,fx,fy,fz,tx,ty,tz"
    np.savetxt(tmp_path / "tool.csv", rows, delimiter=",", header=names, comments="", fmt="%.10g")
    text = (tmp_path / "tool.csv").read_text()
    (tmp_path / "tool.csv").write_text(text.replace("nan", ""))
    columns = ["fx", "fy", "fz", "tx", "ty", "tz"], ["x", "y", "z", "qw", "qx", "qy", "qz"]
    with pytest.warns(LogWarning, match="1 rows without a pose"):
        record = spec.read_held(tmp_path / "tool.csv", *columns, gravity=G)
    assert record.t.shape == (T.size - 2,)  # a time at which nothing was read is dropped
    assert record.readings[0].mask.all()
    np.testing.assert_allclose(record.t[69], T[71], rtol=0, atol=1e-12)


def test_poses_without_a_wrench_are_refused(capsys):
    assert command.main(["identify", "tool.csv", "--gravity", "0", "0", "9.81", "--no-cache"]) == 2
    assert "--gravity: wanted a --wrench" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--noise", "0.1"], "two numbers"),
        (["--pose", *"abcdefg"], "no column"),
        (["--unit", "deg/s"], "--unit: not together with --wrench"),
        (["--free", "drag"], "--free drag"),
    ],
)
def test_mistakes_on_the_command_line_are_answered(more, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = "t,x,y,z,qw,qx,qy,qz,fx,fy,fz,tx,ty,tz"
    rows = np.column_stack([T, X, Q, wrench_of(TOOL)])[:20]
    np.savetxt("tool.csv", rows, delimiter=",", header=names, comments="", fmt="%.10g")
    wrench = ["--wrench", "fx", "fy", "fz", "tx", "ty", "tz"]
    assert command.main(["identify", "tool.csv", *wrench, *more, "--no-cache"]) == 2
    assert words in capsys.readouterr().err
