"""Good calls: states, laws, frames, closed form, solvers, batches."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
from surface import scenes as s
from surface.calls import KINDS, leave_out, row
from surface.scenes import DOWN, SYMMETRIC, TS, Q, V, W, Y

import rigidjax as rj

REVERSE = ("jit", "vmap", "grad", "scan", "checkpoint")

# States.
row("Spin", dict(omega=W))
row("Attitude", dict(q=Q, omega=W))
row("Rigid", dict(x=Y, v=V, q=Q, omega=W))
row("Point", dict(x=Y, v=V))
row("lagrangian.Coordinates", dict(q=V, rate=W))
row("lagrangian.Momentum", dict(pi=W))
row("lagrangian.MomentumAndDirection", dict(pi=W, gamma=V))

# Vector fields.
row(
    "equations_of_motion",
    lambda: dict(body=s.inertia(), state0=s.attitude(), torque=s.top()),
    says=("inertia", "needs a state"),
)
row(
    "lagrangian.equations_of_motion",
    lambda: dict(lagrangian=s.Kinetic(jnp.asarray(9.8)), force=lambda t, q, rate: -0.1 * rate),
)
row("lagrangian.EulerAngleTop", lambda: dict(inertia=s.inertia(), torque=s.top()))
row("lagrangian.HeavyTopHamiltonian", lambda: dict(inertia=s.inertia(), top=s.top()))
row("lagrangian.RotationalHamiltonian", lambda: dict(inertia=s.inertia()))
row("lagrangian.lie_poisson", dict(hamiltonian=lambda p: jnp.sum(p * p)))
row("lagrangian.lie_poisson_with_direction", dict(hamiltonian=lambda p, g: jnp.sum(p * g)))
row("lagrangian.from_attitude", lambda: dict(state=s.attitude()))
row(
    "lagrangian.to_attitude",
    lambda: dict(y=rj.lagrangian.Coordinates(V, W)),
    says=("angles",),
)
leave_out(
    "made by equations_of_motion, lie_poisson and lie_poisson_with_direction",
    *(f"lagrangian.{n}" for n in ("LagrangeEquations", "LiePoisson", "LiePoissonWithDirection")),
)

# What is conserved.
row("energy", lambda: dict(body=s.inertia(), state=s.attitude(), torque=s.top(), t=0.3))
row("conserved", lambda: dict(body=s.inertia(), state=s.attitude(), torque=s.top(), t=0.3))
row(
    "drift",
    lambda: dict(ts=np.asarray(s.motion().ts), ys=s.motion().ys, body=s.inertia()),
    transforms=("jit", "vmap", "scan"),
)

# Laws: made, and asked for their value.
LAWS = {
    "CentralGravity": dict(mu=3.1),
    "ConstantTorque": dict(torque=V),
    "Damping": dict(coefficient=np.abs(V)),
    "QuadraticDamping": dict(coefficient=np.abs(V)),
    "Drag": dict(coefficient=0.2, centre=V, wind=W),
    "Flywheel": dict(momentum=V),
    "GravityGradient": dict(mu=3.1, position=Y),
    "HeavyTop": dict(mass=2.0, com=V, gravity=DOWN),
    "InSpace": dict(torque=V),
    "MagneticDipole": dict(moment=V, field=W),
    "UniformGravity": dict(gravity=DOWN),
    "Linear": dict(times=TS, values=np.stack([V, W, Y, V])),
    "Tabulated": dict(times=TS, torques=np.stack([V, W, Y, V])),
    "Pulses": dict(edges=TS, torques=np.stack([V, W, Y])),
    "Wrench": dict(force=V, torque=W),
    "BodyDrag": dict(linear=np.abs(V), quadratic=np.abs(W), centre=Y, wind=V),
    "Chebyshev": dict(start=-1.0, step=0.7, coefficients=np.arange(45.0).reshape(3, 3, 5) / 10),
    "Tide": dict(response=0.1, delay=0.2, mu=3.1, position=Y, mean_rate=0.3),
    "Held": dict(times=TS, values=np.stack([V, W, Y, V])),
    "Rotors": dict(
        positions=np.stack([V, W]),
        directions=np.eye(3)[:2],
        spins=np.array([1.0, -1.0]),
        thrust=0.1,
        drag=np.array([0.2, 0.3]),
        speeds=np.array([2.0, 3.0]),
        inertia=0.3,
    ),
}
for name, given in LAWS.items():
    row(f"motion.torques.{name}", given)
row(
    "motion.torques.Series",
    dict(times=np.linspace(0.0, 2.0, 5), values=np.cos(np.arange(15.0)).reshape(5, 3)),
    host=True,
    transforms=(),
)
row(
    "motion.torques.Wheel",
    lambda: dict(inertia=0.2, axis=np.eye(3)[2], speed=s.Quadratic(jnp.asarray(3.0)), delay=0.1),
    traced=("inertia", "speed", "delay"),
)
_LOG = dict(
    x=np.cos(np.arange(45.0)).reshape(15, 3),
    q=np.stack([np.cos(0.1 * np.arange(15)), *(3 * [np.sin(0.1 * np.arange(15)) / 3**0.5])], 1),
)
row(
    "motion.torques.LoggedMotion",
    dict(t=np.linspace(0.0, 2.0, 15), **_LOG, omega=np.sin(np.arange(45.0)).reshape(15, 3)),
    host=True,
    transforms=(),
)
row(
    "motion.torques.LoggedMotion.from_poses",
    dict(t=np.linspace(0.0, 2.0, 15), **_LOG),
    host=True,
    transforms=(),
)
row("motion.torques.Carried", lambda: dict(motion=s.Quadratic(jnp.asarray(3.0))), transforms=())
leave_out("what a given motion returns", "motion.torques.Kinematics")
leave_out("a name, and no number", "motion.torques.Input", "motion.torques.bind")
row("motion.torques.FromPotential", lambda: dict(potential=s.Spring(jnp.asarray(2.0))))
row(
    "motion.torques.Sum",
    lambda: dict(one=s.damping(), other=s.top()),
    run=lambda one, other: rj.torques.Sum(one, other),
)
leave_out("abstract: made by subclassing", "motion.torques.AbstractTorque")

# Moving frames.
row("frames.Uniform", dict(omega=W))
row("frames.AboutAxis", lambda: dict(axis=V, angle=s.Quadratic(jnp.asarray(3.0))))
row(
    "frames.MovingFrame",
    lambda: dict(rotation=s.turning(), origin=s.Place(jnp.asarray(V)), rate=lambda t: W),
)
for name, given in {
    "matrix": {},
    "at": {},
    "angular_velocity": {},
    "place": {},
    "translational_acceleration": {},
    "centrifugal": dict(x=Y),
    "coriolis": dict(v=V),
    "euler_acceleration": dict(x=Y),
    "acceleration": dict(x=Y, v=V, force=W),
    "acceleration_to_inertial": dict(x=Y, v=V, a=W),
    "force_from_inertial": dict(force=V),
    "force_to_inertial": dict(force=V),
}.items():
    row(
        f"frames.MovingFrame.{name}",
        lambda given=given: dict(self=s.frame(), t=0.3, **given),
        arguments=("t", *given),
    )
for name in ("to_inertial", "from_inertial"):
    row(
        f"frames.MovingFrame.{name}",
        lambda: dict(self=s.frame(), state=s.rigid(), t=0.3),
        arguments=("state", "t"),
    )
row(
    "frames.MovingFrame.jacobi_integral",
    lambda: dict(self=s.frame(), state=s.point(), t=0.3, potential=0.7),
    arguments=("state", "t", "potential"),
)
row(
    "frames.MovingFrame.compose",
    lambda: dict(self=s.frame(), inner=s.frame()),
    arguments=("inner",),
)
row("frames.MovingFrame.inverse", lambda: dict(self=s.frame()), arguments=())
for name, given in {
    "centrifugal": dict(x=Y),
    "coriolis": dict(v=V),
    "euler_acceleration": dict(x=Y),
    "fictitious": dict(x=Y, v=V),
    "from_inertial_axes": dict(y=Y),
    "to_inertial_axes": dict(y=Y),
}.items():
    row(
        f"frames.Instant.{name}",
        lambda given=given: dict(self=s.frame().at(0.3), **given),
        arguments=tuple(given),
    )
for name in ("to_inertial", "from_inertial"):
    row(
        f"frames.Instant.{name}",
        lambda: dict(self=s.frame().at(0.3), state=s.rigid()),
        arguments=("state",),
    )
row("frames.Instant.translational_acceleration", lambda: dict(self=s.frame().at(0.3)), arguments=())
row(
    "frames.InFrame",
    lambda: dict(
        frame=s.frame(), inside=lambda t, state: -state.x, potential=lambda x: jnp.sum(x * x)
    ),
)
row("frames.BodyInFrame", lambda: dict(frame=s.frame(), torque=s.damping()))
row("frames.Force", dict(force=lambda t, state, body: -state.x), transforms=())
leave_out("made by MovingFrame.at", "frames.Instant")
leave_out("made by BodyInFrame and by adaptive", "frames.FrameWrench", "solve.AdaptiveRun")
leave_out("abstract: made by subclassing", "frames.AbstractScene")

# Scenes of particles.
row("orbits.cr3bp", dict(mu=0.3, radii=np.array([0.01, 0.02])))
row("frames.scenes.earth", dict(latitude=0.7, gravity=9.8, rate=7e-5))
row("frames.scenes.foucault", dict(latitude=0.7, length=10.0, gravity=9.8, rate=7e-5))
row("orbits.hill", dict(radius=0.01))
row("frames.scenes.hoop", dict(radius=0.7, rate=5.0, gravity=9.8))
row("frames.scenes.libration", dict(rate=0.3))
row(
    "frames.scenes.libration_integral",
    lambda: dict(state=s.attitude(), body=s.inertia(), rate=0.3),
)
row("frames.scenes.turntable", dict(rate=0.7, growth=0.2))
row("orbits.PeriodicOrbit", lambda: dict(state=s.point(), period=2.5))
made = "made by the function of its name in small letters"
leave_out(made, *(f"frames.scenes.{n}" for n in ("Earth", "Foucault", "Hoop")))
leave_out(made, "orbits.Hill", "orbits.ThreeBody")
for name, given in {
    "potential": dict(x=Y),
    "distances": dict(x=Y),
    "hessian": dict(x=Y),
    "exponents": dict(x=np.array([0.2, 0.8660254, 0.0])),
    "speed_squared": dict(x=Y, jacobi=1.5),
    "zero_velocity": dict(xs=np.array([0.1, 0.6]), ys=np.array([0.2, 0.3, 0.4])),
    "lyapunov_guess": dict(point=1, amplitude=0.01),
    "halo_guess": dict(point=1, amplitude=0.01),
}.items():
    row(
        f"orbits.ThreeBody.{name}",
        lambda given=given: dict(self=rj.orbits.cr3bp(0.3), **given),
        arguments=tuple(given),
        transforms=()
        if name == "exponents"
        else ("jit", "vmap", "grad", "jacfwd", "hessian", "scan", "checkpoint"),
    )
row(
    "orbits.ThreeBody.jacobi_constant",
    lambda: dict(self=rj.orbits.cr3bp(0.3), state=s.point()),
    arguments=("state",),
)
row(
    "orbits.Hill.jacobi_constant",
    lambda: dict(self=rj.orbits.hill(), state=s.point()),
    arguments=("state",),
    traced=("state",),
)
row(
    "frames.scenes.Earth.eastward_deflection",
    lambda: dict(self=rj.scenes.earth(0.7), height=10.0),
    arguments=("height",),
)
row(
    "frames.scenes.Earth.jacobi_integral",
    lambda: dict(self=rj.scenes.earth(0.7), state=s.point()),
    arguments=("state",),
)
row("frames.scenes.Earth.angular_velocity", lambda: dict(self=rj.scenes.earth(0.7)), arguments=())
pendulum = lambda: rj.scenes.foucault(0.7, 10.0)
row("frames.scenes.Foucault.precession_rate", lambda: dict(self=pendulum()), arguments=())
row(
    "frames.scenes.Foucault.start",
    lambda: dict(self=pendulum(), east=1.0, north=0.5),
    arguments=("east", "north"),
)
row(
    "frames.scenes.Foucault.state",
    lambda: dict(self=pendulum(), east=1.0, north=0.5, east_speed=0.2, north_speed=0.3),
    arguments=("east", "north", "east_speed", "north_speed"),
)
row(
    "frames.scenes.Foucault.small_swing",
    lambda: dict(self=pendulum(), state=s.point(), t=0.3),
    arguments=("state", "t"),
)
row(
    "frames.scenes.Hoop.equilibrium_angle",
    lambda: dict(self=rj.scenes.hoop(1.0, 5.0)),
    arguments=(),
)
row(
    "frames.scenes.Hoop.side_push",
    lambda: dict(self=rj.scenes.hoop(1.0, 5.0), state=s.point()),
    arguments=("state",),
)
row(
    "frames.scenes.Hoop.state",
    lambda: dict(self=rj.scenes.hoop(1.0, 5.0), angle=0.3, speed=0.2),
    arguments=("angle", "speed"),
)

# Closed form.
# Minutes of compiling for the rest, which the sweep of derivatives goes through.
EXACT = ("jit", "vmap", "grad", "scan")
row(
    "exact.free_body",
    lambda: dict(inertia=s.inertia(), state0=s.attitude(), t=0.7),
    transforms=EXACT,
)
row(
    "exact.FreeBody",
    lambda: dict(inertia=s.inertia(), state0=s.attitude()),
    transforms=("jit", "vmap", "scan"),
)
for name in ("body_period", "precession_period"):
    row(f"exact.{name}", lambda: dict(inertia=s.inertia(), omega0=W), transforms=EXACT)

# Solvers.
for name in ("DormandPrince8", "Magnus4", "RungeKutta4", "Splitting2", "Splitting4", "Splitting6"):
    row(f"solve.solvers.{name}", transforms=())
row("solve.solvers.Tsitouras5", transforms=())
row("solve.solvers.FreeSolver", transforms=())
row("solve.solvers.ReplayAdjoint", transforms=())
row("solve.solvers.Projected", lambda: dict(solver=dfx.Tsit5()), transforms=())
row(
    "simulate",
    lambda: dict(
        body=s.inertia(), state0=s.attitude(), ts=TS, torque=s.top(), rtol=1e-6, atol=1e-8, dt0=0.01,
        max_steps=1000,
    ),
    arguments=("body", "state0", "ts", "torque", "dt0"),
    says=("inertia", "needs a state"),
    # Forward mode through a forced run is being redone: issue K, item 3.
    transforms=REVERSE,
    traced=("body", "state0", "torque"),
)  # fmt: skip
row(
    "simulate (options)",
    lambda: dict(
        body=s.inertia(), state0=s.attitude(), ts=TS, torque=s.top(), rtol=1e-6, atol=1e-8,
        max_steps=1000,
    ),
    run=rj.simulate,
    arguments=("rtol", "atol", "max_steps"),
    groups=(*KINDS, "nan", "inf"),
    transforms=(),
)  # fmt: skip
row(
    "solve.Solution.evaluate",
    lambda: dict(self=s.motion(), t=0.7),
    arguments=("t",),
    traced=("t",),
    transforms=("jit", "vmap", "grad"),
)
row(
    "simulate (accuracy)",
    lambda: dict(body=s.inertia(), state0=s.attitude(), ts=TS, torque=s.top(), accuracy=1e-6),
    run=rj.simulate,
    arguments=("accuracy",),
    traced=("accuracy", "state0"),
    groups=(*KINDS, "nan", "inf"),
    # Stated errors are not repeated to the last digit; tests/solve/answer/test_error.py has them.
    transforms=(),
)
row(
    "error_of",
    lambda: dict(f=lambda x, **tolerances: jnp.sum(x * x), x=V, rtol=1e-6, atol=1e-9),
    arguments=("f", "rtol", "atol"),
    traced=("x",),
    groups=(*KINDS, "nan", "inf"),
    transforms=(),
)
row("solve.Solution.to_xarray", lambda: dict(self=s.motion()), arguments=(), transforms=())
leave_out("simulate returns it", "solve.Solution", "solve.Error")
leave_out("error_of returns it", "solve.FunctionError")
leave_out(
    "inner loops: simulate and rollout run them",
    *(f"solve.{n}" for n in ("adaptive", "fixed")),
)

# Batches.
row("batch.Steps", dict(size=0.1, number=4, save_every=2, t0=0.0), groups=("same",), transforms=())
row(
    "batch.rollout",
    lambda: dict(
        bodies=rj.Inertia(SYMMETRIC), states0=s.attitudes(), step_size=0.1, num_steps=4,
        torque=s.top(), save_every=2, t0=0.0, chunk=2,
    ),
    traced=("bodies", "states0"),
)  # fmt: skip
forced = lambda: dict(
    bodies=rj.Inertia(SYMMETRIC), states0=s.attitudes(), ts_or_steps=TS, torque=s.top(),
    rtol=1e-6, atol=1e-8, max_steps=1000, chunk=2,
)  # fmt: skip
row(
    "batch.simulate",
    forced,
    arguments=("bodies", "states0", "ts_or_steps", "torque"),
    groups=("stranger", "nan", "inf"),
    transforms=("jit", "grad"),
    traced=("bodies", "states0"),
)
row(
    "batch.simulate (options)",
    forced,
    run=rj.batch.simulate,
    arguments=("rtol", "atol", "max_steps", "chunk"),
    groups=("stranger", "nan", "inf"),
    transforms=(),
)
row("batch.compiler_options", transforms=())
row("set_xla_flags", transforms=())
for name in ("share", "gather", "total"):
    row(
        f"batch.distributed.{name}",
        lambda: dict(tree=s.attitudes()),
        host=True,
        groups=("same", "single", *KINDS),
    )
leave_out(
    "joins other processes, or writes: tests/batch/test_devices.py",
    *(f"batch.distributed.{n}" for n in ("connect", "save", "recover")),
)
leave_out("batch.simulate returns it", "batch.Batch")
