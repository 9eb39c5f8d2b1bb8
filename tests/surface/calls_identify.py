"""Good calls: sensors, recordings, fits, pictures, work and precision."""

import functools
import tempfile
from pathlib import Path

import jax
import numpy as np
import optax
from surface import scenes as s
from surface.calls import KINDS, leave_out, row
from surface.scenes import TS, M, V, W, Y

import rigidjax as rj

HOST = dict(host=True, transforms=())
vectors = dict(bias=V, scale=np.ones(3) + 0.1 * V, mounting=0.1 * W, limit=np.array([5.0, 6, 7]))

# Sensors.
row(
    "identify.Gyro",
    dict(noise=0.1, **vectors, offset=0.01, g_sensitivity=1e-3 * M, place=Y, gravity=W),
)
row("identify.Accelerometer", dict(noise=0.1, place=Y, gravity=W, **vectors, offset=0.01))
row(
    "identify.ForceTorque",
    dict(
        noise=np.full(6, 0.1), gravity=W, place=Y, mounting=0.1 * V, bias=np.r_[V, W], offset=0.01
    ),
)
row("identify.Magnetometer", dict(noise=0.1, field=Y, **vectors, offset=0.01))
row("identify.AttitudeSensor", dict(noise=np.array([0.1, 0.2, 0.3]), mounting=V, offset=0.01))
row(
    "identify.Direction", dict(world=Y, noise=np.array([0.1, 0.2]), mounting=V, offset=0.01), **HOST
)
row("identify.Marker", dict(place=Y, noise=0.1, origin=V, offset=0.01))
row(
    "identify.Recording",
    lambda: dict(
        t=TS,
        sensor=rj.identify.Gyro(0.1),
        values=np.stack([V, W, Y, V]),
        mask=np.array([True, True, False, True]),
        inputs={"speed": np.ones(4)},
    ),
    run=lambda t, sensor, values, mask, inputs: rj.identify.Recording(
        t, (sensor, values, mask), inputs=inputs
    ),
    says=("reading",),
    **HOST,
)
leave_out("a table of another library, by names", "identify.Recording.from_frame")


def wobble(inputs: dict | None = None) -> rj.identify.Recording:
    """Of a disc in the air, for a second."""
    t = 0.02 * np.arange(50)
    rates = np.stack([np.cos(4 * t), np.sin(4 * t), 5.0 + 0 * t], axis=1)
    return rj.identify.Recording(t, (rj.identify.Gyro(0.1), rates), inputs=inputs)


row(
    "identify.find_phases",
    lambda: dict(recording=wobble({"m1": np.zeros(50)}), motors=["m1"]),
    groups=("stranger",),
    **HOST,
)
leave_out("find_phases makes it", "identify.Phase")
row(
    "identify.simulate_readings",
    lambda: dict(
        sensor=rj.identify.Gyro(0.1, bias=V), body=s.inertia(), state0=s.spin(), ts=TS,
        torque=s.damping(), key=jax.random.key(0),
    ),
    groups=("stranger", "shape", "nan"),
    traced=("body", "state0"),
    transforms=("jit", "vmap", "jacfwd"),
)  # fmt: skip
leave_out("a fit makes it", "identify.Combination")
leave_out("a fit hands it to a sensor", "identify.SensorInput")
abstract = ("AbstractBodyChart", "AbstractLoss", "AbstractSensor")
leave_out("abstract: made by subclassing", *(f"identify.{name}" for name in abstract))

# What a fit is asked.
for name in ("Ratios", "PrincipalRatios"):
    row(f"identify.{name}", transforms=())
for name in ("Tensor", "Principal"):
    row(f"identify.{name}", dict(typical=2.0), **HOST)
row("identify.Known", lambda: dict(known=s.inertia()))
row("identify.Mass", lambda: dict(guess=s.body()))
for name in ("Huber", "SoftL1"):
    row(f"identify.{name}", dict(scale=3.0), **HOST)
row("identify.Entropic", lambda: dict(guess=s.inertia(), weight=2.0), **HOST)
row(
    "identify.Measured",
    dict(of=lambda point: point.body.mass, value=0.5, sigma=0.1, name="weight"),
    arguments=("of", "value", "sigma"),
    **HOST,
)
row("identify.Adaptive", dict(rtol=1e-6, atol=1e-9), **HOST)
row("identify.FixedSteps", dict(substeps=2), transforms=())
row(
    "identify.Free",
    dict(where=lambda s: s.sensors[0].noise, name="noise", scale=0.1, prior=0.5),
    arguments=("where", "scale", "prior"),
    **HOST,
)
row("identify.Tolerance", dict(scale=0.01, cross_axis=0.02, bias=0.1, clock=1e-3), **HOST)
row("identify.Descent", lambda: dict(optimiser=optax.adam(1e-2), steps=3, batch=1), transforms=())
row(
    "identify.descend",
    lambda: dict(model=s.model(), descent=rj.identify.Descent(optax.adam(1e-2), steps=1, batch=1)),
    groups=("stranger",),
    transforms=(),
)
row(
    "identify.Model",
    lambda: dict(
        recording=s.recording(),
        chart=rj.identify.PrincipalRatios(),
        torque=s.damping(),
        loss=rj.identify.Huber(),
        prior=rj.identify.Entropic(s.inertia(), 1.0),
        integrator=rj.identify.FixedSteps(1),
    ),
    **HOST,
)
row(
    "identify.Model.start",
    lambda: dict(self=s.model(), body=s.inertia(), omega=W),
    arguments=("body", "omega"),
)
plan = lambda: s.model().start(s.inertia())
for name in ("unpack", "values", "scenes", "motion", "errors"):
    row(
        f"identify.Model.{name}",
        lambda: dict(self=s.model(), x=plan()),
        arguments=("x",),
        traced=("x",),
        says=("inertia",),
    )
row(
    "identify.fisher",
    lambda: dict(model=s.model(), x=plan()),
    traced=("x",),
    groups=("stranger", "nan"),
    transforms=("jit", "grad"),
)
row(
    "identify.expected_quantities",
    lambda: dict(model=s.model(), x=plan()),
    groups=("stranger", "nan"),
    **HOST,
)
row(
    "identify.fit",
    lambda: dict(
        model=s.model(), starts=1, initial=plan(), key=jax.random.key(0), tolerance=1e-4,
        max_steps=30,
    ),
    groups=("stranger",),
    **HOST,
)  # fmt: skip
row("identify.compare", lambda: dict(fits={"a": s.found(), "b": s.found()}), transforms=())
leave_out("select makes it", "identify.Candidates", "identify.Selection", "identify.Step")
leave_out("a search of many fits: tests/identify/inference/test_selection.py", "identify.select")
row("identify.usual_terms", lambda: dict(model=s.model()), transforms=())
row("identify.Fit.interval", lambda: dict(self=s.found(), level=0.9), arguments=("level",), **HOST)
row(
    "identify.Fit.interval_of",
    lambda: dict(self=s.found(), function=lambda point: point.state0.omega, level=0.9),
    arguments=("of", "level"),
    **HOST,
)
row(
    "identify.Fit.bodies",
    lambda: dict(self=s.found(), key=jax.random.key(0), count=20),
    arguments=("key", "count"),
    transforms=(),
)
row(
    "identify.Fit.to_frame",
    lambda: dict(self=s.found(), rate_unit="deg/s"),
    arguments=("rate_unit",),
    transforms=(),
)
records = (
    "Fit",
    "Answer",
    "Cause",
    "Start",
    "Quantity",
    "Comparison",
    "Limit",
    "Freedom",
    "BestPoint",
    "Uncertainty",
    "Assessment",
    "HeldOut",
    "Pair",
    "Linearisation",
    "Scene",
    "Unpacked",
    "Consideration",
)
leave_out("a record that the library fills", *(f"identify.{name}" for name in records))
leave_out(
    "a record that windows and predict_windows fill: tests/identify/test_windows.py",
    *(f"identify.{name}" for name in ("Horizons", "Windows")),
)


def cut() -> rj.identify.Windows:
    t = np.arange(7.0) / 8
    spins = rj.Spin(np.stack([0 * t, 0 * t, np.exp(-0.5 * t)], 1))
    return rj.identify.windows(t, spins, length=3, stride=3)


@functools.cache
def found_windows() -> rj.identify.Fit:
    damping = rj.torques.Damping(0.1 * np.ones(3))
    free = [rj.identify.Free(lambda s: s.torque.coefficient, "drag")]
    model = rj.identify.Model(cut(), rj.identify.Known(s.inertia()), torque=damping, free=free)
    return rj.identify.fit(model)


row(
    "identify.windows",
    lambda: dict(
        t=np.arange(7.0) / 8,
        states=rj.Spin(np.arange(21.0).reshape(7, 3)),
        inputs={"u": np.ones((7, 2))},
        length=3,
        stride=2,
    ),
    **HOST,
)
row(
    "identify.predict_windows",
    lambda: dict(fit=found_windows(), windows=cut()),
    groups=("stranger",),
    **HOST,
)


# Reports and files.
def log() -> Path:
    path = Path(tempfile.mkdtemp()) / "log.csv"
    rows = [f"{t},{t},1.0,{2 - t}" for t in (0.0, 0.5, 1.0, 1.5)]
    path.write_text("\n".join(["t,wx,wy,wz", *rows]) + "\n")
    return path


row(
    "identify.read_table",
    lambda: dict(path=str(log()), columns=["t", "wx"]),
    transforms=(),
    says=("no such file",),
)


def robot() -> str:
    path = Path(tempfile.mkdtemp()) / "robot.urdf"
    inertia = '<mass value="2"/><inertia ixx="3" iyy="2.5" izz="1.5"/>'
    path.write_text(f'<robot><link name="arm"><inertial>{inertia}</inertial></link></robot>')
    return str(path)


row("body.read_inertials", lambda: dict(path=robot()), transforms=(), says=("no such file",))
row(
    "body.write_inertials",
    lambda: dict(path=robot() + ".new", bodies={"arm": s.body()}, source=robot()),
    arguments=("bodies", "source"),
    transforms=(),
    says=("no such file",),
)
row("identify.report.as_dict", lambda: dict(fit=s.found()), groups=KINDS, transforms=())
row("identify.report.as_html", lambda: dict(fit=s.found()), groups=KINDS, transforms=())
row("identify.report.numbers", dict(value=1.0, low=0.9, high=1.2), transforms=())
row(
    "identify.report.rows",
    lambda: dict(fit=s.found(), rate_unit="rad/s"),
    groups=KINDS,
    transforms=(),
)
row("identify.report.table", dict(lines=[("a", 1.0, 0.9, 1.1, "s")]), transforms=())
row("identify.report.verdict", lambda: dict(fit=s.found()), groups=KINDS, transforms=())
for name in ("write_html", "write_json"):
    row(
        f"identify.report.{name}",
        lambda: dict(fit=s.found(), path=Path(tempfile.mkdtemp()) / "report"),
        arguments=("fit",),
        groups=KINDS,
        transforms=(),
    )
for name in ("model", "recording"):
    row(f"datasets.toutatis.{name}", transforms=())
leave_out(
    "reads an ephemeris that is no dependency: tests/datasets/test_moon.py", "datasets.moon.Moon"
)
leave_out(
    "for the fit of one example: tests/datasets/test_toutatis.py",
    *(f"datasets.toutatis.{name}" for name in ("remarks", "rms_degrees", "rows")),
)

# Pictures.
states = lambda: s.motion().ys
times = lambda: np.asarray(s.motion().ts)
row(
    "plot.motion",
    lambda: dict(ts=times(), states=states(), attitude="axes", time_unit="s", rate_unit="rad/s"),
    transforms=(),
)
row("plot.polhode", lambda: dict(inertia=s.inertia(), states=states(), energies=2), transforms=())
row("plot.herpolhode", lambda: dict(inertia=s.inertia(), states=states()), transforms=())
row("plot.body_axes", lambda: dict(states=states()), transforms=())
row("plot.inertia_ellipsoid", lambda: dict(body=s.inertia(), samples=3), transforms=())
row(
    "plot.phase_portrait",
    lambda: dict(
        inertia=rj.Inertia.from_principal(0.4, 0.4, 0.1),
        top=rj.torques.HeavyTop(1.0, [0.0, 0, 0.5], [0.0, 0, -9.81]),
        states=states(),
        levels=2,
    ),
    groups=KINDS,
    transforms=(),
)
row(
    "plot.frames",
    lambda: dict(
        frame=s.frame(), ts=TS, plane="xy",
        inside=rj.Point(np.stack([V, W, Y, V]), np.stack([V, W, Y, V])),
    ),
    transforms=(),
)  # fmt: skip
row(
    "plot.fit",
    lambda: dict(fit_result=s.found(), index=0, time_unit="s"),
    groups=KINDS,
    transforms=(),
)
row(
    "plot.residuals",
    lambda: dict(fit_result=s.found(), index=0, time_unit="s"),
    groups=KINDS,
    transforms=(),
)
row(
    "plot.phases",
    lambda: dict(recording=wobble(), rate_unit="rad/s"),
    run=lambda recording, **how: rj.plot.phases(
        recording, rj.identify.find_phases(wobble()), **how
    ),
    groups=("stranger",),
    transforms=(),
)
row(
    "plot.tumble",
    lambda: dict(body=s.body(), ts=times(), states=states(), fps=20.0, seconds=0.1),
    groups=KINDS,
    transforms=(),
)
leave_out("opens a server for a browser: tests/plot/test_pictures.py", "plot.player")
leave_out("tumble and player return it", "plot.Film")

# Work and precision.
wp = rj.workprecision
row(
    "workprecision.BenchmarkScene",
    lambda: dict(
        name="mine",
        title="words",
        body=s.inertia(),
        state0=s.attitude(),
        torque=s.damping(),
        end=1.0,
    ),
    arguments=("body", "state0", "end"),
    groups=("same", *KINDS, "nan"),
    transforms=(),
)
for name in ("choose", "table"):
    lines = "lines" if name == "table" else "records"
    row(
        f"workprecision.{name}",
        lambda lines=lines: {
            lines: list(wp.choose(s.records()) if lines == "lines" else s.records())
        },
        groups=KINDS,
        transforms=(),
    )
row("workprecision.draw", lambda: dict(records=list(s.records())), groups=KINDS, transforms=())
row("workprecision.methods", dict(group="ours"), transforms=())
row("workprecision.scenes", transforms=())
row(
    "workprecision.diffrax_method",
    lambda: dict(solver=__import__("diffrax").Tsit5()),
    transforms=(),
)
leave_out("minutes of measuring: tests/workprecision", "workprecision.measure")
leave_out(
    "a record that is filled as it comes",
    *(
        f"workprecision.{n}"
        for n in ("Choice", "Measurement", "PreparedMethod", "Reference", "TimedMethod")
    ),
)
