"""The exact free body judges other simulators: `python tests/exact/simulators.py`.

Each simulator that is installed turns the body (10, 20, 26) kg m² for 5 s from Ω = (1, 15, 1) rad/s, with
no force, contact or damping, in float64. Its attitude is compared with the closed form. Printed as the
table of the guide's page "Check your simulator": the angle between both at the end, rad, at a step of
1/120 s, 2 ms and 1 ms; the order that the last two show; and the relative change of the kinetic energy at
2 ms. Written down with mujoco 4.0.0, mujoco-mjx 3.17.0, brax 0.14.2 and jsbsim 1.3.3: install them
beside the project. Not a test.
"""

import importlib.metadata
import importlib.util
import math
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax as rj

MOMENTS, OMEGA, END = np.array([10.0, 20.0, 26.0]), np.array([1.0, 15.0, 1.0]), 5.0
STEPS = (600, 2500, 5000)
BODY = rj.Inertia.from_principal(*MOMENTS)
START = rj.Attitude([1.0, 0, 0, 0], OMEGA)

MUJOCO = """<mujoco><option gravity="0 0 0" timestep="{}" integrator="{}"/><worldbody><body>
<freejoint/><geom type="sphere" size="0.1" contype="0" conaffinity="0"/>
<inertial pos="0 0 0" mass="1" diaginertia="10 20 26"/></body></worldbody></mujoco>"""

JSBSIM = """<?xml version="1.0"?><fdm_config name="body" version="2.0" release="ALPHA"><fileheader/>
<metrics><wingarea unit="FT2">0</wingarea><wingspan unit="FT">0</wingspan><chord unit="FT">0</chord>
<location name="AERORP" unit="M"><x>0</x><y>0</y><z>0</z></location></metrics>
<mass_balance><ixx unit="KG*M2">10</ixx><iyy unit="KG*M2">20</iyy><izz unit="KG*M2">26</izz>
<emptywt unit="KG">10</emptywt>
<location name="CG" unit="M"><x>0</x><y>0</y><z>0</z></location></mass_balance>
<ground_reactions/><propulsion/><flight_control name="none"/><aerodynamics/></fdm_config>"""
# A planet that does not turn: the local axes of the body's place stay fixed in space.
PLANET = """<?xml version="1.0"?><planet name="still"><equatorial_radius unit="M">6378137
</equatorial_radius><polar_radius unit="M">6378137</polar_radius><rotation_rate unit="RAD/SEC">0
</rotation_rate><GM unit="M3/SEC2">3.986e14</GM><J2>0</J2></planet>"""


def by_mujoco(integrator):
    import mujoco

    def run(steps):
        model = mujoco.MjModel.from_xml_string(MUJOCO.format(END / steps, integrator))
        data = mujoco.MjData(model)
        data.qvel[3:] = OMEGA
        for _ in range(steps):
            mujoco.mj_step(model, data)
        return data.qpos[3:], data.qvel[3:]

    return run


def by_mjx(integrator):
    import mujoco
    from mujoco import mjx

    def run(steps):
        model = mjx.put_model(
            mujoco.MjModel.from_xml_string(MUJOCO.format(END / steps, integrator))
        )
        data = mjx.make_data(model).replace(qvel=jnp.append(jnp.zeros(3), OMEGA))
        data = jax.jit(
            lambda data: jax.lax.fori_loop(0, steps, lambda _, d: mjx.step(model, d), data)
        )(data)
        return data.qpos[3:], data.qvel[3:]

    return run


def by_brax(pipeline):
    from brax.io import mjcf

    motion = importlib.import_module(f"brax.{pipeline}.pipeline")

    def run(steps):
        system = mjcf.loads(MUJOCO.format(END / steps, "Euler"))
        first = motion.init(
            system, jnp.array([0, 0, 0, 1.0, 0, 0, 0]), jnp.append(jnp.zeros(3), OMEGA)
        )
        last = jax.jit(
            lambda state: jax.lax.fori_loop(
                0, steps, lambda _, s: motion.step(system, s, jnp.zeros(0)), state
            )
        )(first)
        q = last.x.rot[0]
        return q, rj.quaternion.rotate_inverse(q, last.xd.ang[0])

    return run


def by_jsbsim(*integrators):
    """The rates and the attitude by the named methods of JSBSim; none for its defaults."""
    import jsbsim

    def run(steps):
        with tempfile.TemporaryDirectory() as folder:
            home = Path(folder)
            (home / "aircraft" / "body").mkdir(parents=True)
            (home / "aircraft" / "body" / "body.xml").write_text(JSBSIM)
            (home / "planet.xml").write_text(PLANET)
            quiet = jsbsim.DefaultLogger()
            quiet.set_min_level(jsbsim.LogLevel.ERROR)
            jsbsim.set_logger(quiet)
            flight = jsbsim.FGFDMExec(f"{home}/")
            flight.set_debug_level(0)
            flight.load_planet(str(home / "planet.xml"), False)
            flight.load_model("body")
        flight.set_dt(END / steps)
        for kind, number in zip(("rate", "position"), integrators, strict=False):
            flight[f"simulation/integrator/{kind}/rotational"] = number
        flight["ic/h-sl-ft"] = 3e6
        for name, rate in zip("pqr", OMEGA, strict=True):
            flight[f"ic/{name}-rad_sec"] = float(rate)
        flight.run_ic()
        for _ in range(steps):
            flight.run()
        angles = [flight[f"attitude/{name}-rad"] for name in ("psi", "theta", "phi")]
        q = rj.euler.to_quaternion(jnp.array(angles), "ZYX")
        return q, [flight[f"velocities/{name}i-rad_sec"] for name in "pqr"]

    return run


# The numbers of JSBSim's methods: 1 Euler, 2 trapezoidal, 3 to 5 Adams-Bashforth 2 to 4, 9 of order 5.
SIMULATORS = {
    "mujoco": [(name, by_mujoco, (name,)) for name in ("Euler", "implicitfast", "RK4")],
    "mujoco-mjx": [(name, by_mjx, (name,)) for name in ("Euler", "RK4")],
    "brax": [(name, by_brax, (name,)) for name in ("generalized", "positional", "spring")],
    "jsbsim": [
        ("its defaults", by_jsbsim, ()),
        ("AB2", by_jsbsim, (3, 3)),
        ("AB4", by_jsbsim, (5, 5)),
        ("AB5", by_jsbsim, (9, 9)),
    ],
}


def judge(run, steps):
    """The angle to the exact attitude at the end, rad, and the relative change of energy."""
    q, omega = map(jnp.asarray, run(steps))
    exact = rj.exact.free_body(BODY, START, jnp.asarray(END))
    off = rj.quaternion.multiply(rj.quaternion.conjugate(exact.q), q / jnp.linalg.norm(q))
    energy = rj.kinetic_energy(BODY, omega) / rj.kinetic_energy(BODY, START.omega) - 1.0
    return float(rj.quaternion.angle(off)), float(energy)


def main():
    print("| simulator | integrator | 1/120 s | 2 ms | 1 ms | order | energy, 2 ms |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for package, ways in SIMULATORS.items():
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
        for name, make, arguments in ways:
            results = [judge(make(*arguments), steps) for steps in STEPS]
            angles = [angle for angle, _ in results]
            order = math.log2(angles[1] / angles[2])
            shown = " | ".join(f"{angle:.1e}" for angle in angles)
            print(
                f"| {package} {version} | {name} | {shown} | {order:.1f} | {results[1][1]:+.1e} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
