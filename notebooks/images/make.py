"""The pictures of README and the guide: python notebooks/images/make.py"""

import io
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import rigidjax as rj
from rigidjax import identify
from rigidjax.workprecision.record import read_csv

jax.config.update("jax_enable_x64", True)
HERE = Path(__file__).parent


def save(figure, name):
    """With a palette of colours: a third of the bytes."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=90)
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(192).save(HERE / name, optimize=True)


def frames():
    """Body frame and world frame before and after a quarter turn about z."""
    figure = plt.figure(figsize=(7.0, 3.0), layout="constrained")
    turns = (
        ("q = (1, 0, 0, 0)", [0.0, 0, 0]),
        ("after a quarter turn about z", [0.0, 0, jnp.pi / 2]),
    )
    for place, (title, vector) in enumerate(turns, 1):
        q = rj.quaternion.exp(jnp.array(vector))
        ax = figure.add_subplot(1, 2, place, projection="3d", computed_zorder=False)
        for axis, colour, name in zip(jnp.eye(3), rj.plot.COLOURS, "xyz", strict=False):
            ax.plot(*zip([0, 0, 0], 1.35 * axis, strict=True), color="0.6", lw=1.2, ls="--")
            ax.text(*(1.5 * axis), name, color="0.45", ha="center", va="center")
            end = rj.quaternion.rotate(q, axis)
            ax.plot(*zip([0, 0, 0], end, strict=True), color=colour, lw=3)
            ax.text(
                *(0.85 * end + jnp.array([0, 0, 0.16 * (1 - end[2])])), f" {name}′", color=colour
            )
        ax.set(xlim=(-0.8, 1.2), ylim=(-0.8, 1.2), zlim=(-0.3, 1.7))
        ax.set_title(title, fontsize=10)
        ax.set_axis_off()
        ax.view_init(24, 35)
        ax.set_box_aspect((1, 1, 1), zoom=1.5)
    figure.supxlabel("dashed: world axes x, y, z;  full: body axes x′, y′, z′", fontsize=9)
    save(figure, "frames.png")


def draw_flip(inertia, sol, name):
    """Draw the polhode of a motion, and beside it its body rates against time."""
    figure = plt.figure(figsize=(8.4, 4.2), layout="constrained")
    ax = figure.add_subplot(1, 2, 1, projection="3d")
    rj.plot.polhode(inertia, sol.ys, ax=ax, title="the polhode")
    # Below the label of the axis, which reaches into the corner of a picture in three dimensions.
    ax.get_legend().set_bbox_to_anchor((0.5, -0.12))
    ax = figure.add_subplot(1, 2, 2)
    for index, style in enumerate(("-", "--", ":")):
        rate, label = sol.ys.omega[:, index], f"$\\Omega_{'xyz'[index]}$"
        ax.plot(sol.ts, rate, style, lw=1.8, color=rj.plot.COLOURS[index], label=label)
    ax.set(xlabel="time, s", ylabel="body rate, rad/s", title="the flip about the middle axis")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, fontsize=9, frameon=False)
    ax.grid(alpha=0.3)
    save(figure, name)


def flip():
    """README's simulation."""
    body = rj.shapes.box(1.0, [0.30, 0.20, 0.08])
    start = rj.Attitude(q=[1.0, 0, 0, 0], omega=[0.02, 6.0, 0.02])
    sol = rj.simulate(body.inertia, start, jnp.linspace(0.0, 9.0, 301))
    draw_flip(body.inertia, sol, "flip.png")


def start():
    """The simulation of Getting started."""
    body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    first = rj.Attitude(q=[1.0, 0, 0, 0], omega=[0.01, 1.0, 0.0])
    draw_flip(body, rj.simulate(body, first, jnp.linspace(0.0, 30.0, 301)), "start.png")


def fit():
    """README's fit."""
    truth = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    t = jnp.linspace(0.0, 10.0, 101)
    motion = rj.simulate(truth, rj.Spin([1.0, 0.5, 1.2]), t).ys
    rates = motion.omega + 0.05 * jax.random.normal(jax.random.key(0), (101, 3))
    record = identify.Recording(t, (identify.Gyro(noise=0.05), rates))
    found = identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)
    figure = rj.plot.fit(found)
    figure.set_size_inches(7.6, 4.8)
    save(figure, "fit.png")


def swing():
    """Draw the fit of the guide's page on swings."""
    friction = rj.suspensions.Friction(4e-3)
    law = rj.suspensions.Axle([0, 1, 0], [0, 0, 0.25], friction=friction)
    club, gyro = rj.shapes.box(0.8, [0.05, 0.1, 0.5]), identify.Gyro(0.2)
    t, start = jnp.linspace(0.0, 20.0, 801), rj.Turn(0.7, 0.0)
    log = identify.simulate_readings(gyro, club, start, t, law, key=jax.random.key(0))
    drag = identify.Free(lambda s: s.torque.friction.viscous, "friction", scale=1e-3)
    chart = identify.Moment(rj.shapes.box(0.8, [0.1, 0.1, 0.3]), law)
    record = identify.Recording(t, (gyro, log))
    figure = rj.plot.fit(identify.fit(identify.Model(record, chart, torque=law, free=[drag])))
    figure.set_size_inches(8.4, 4.8)
    save(figure, "swing.png")


def terms():
    """Draw the errors before and after the selection of the guide's page on terms."""
    ts = jnp.linspace(0.0, 4.0, 160)
    body = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    hidden = rj.torques.Damping([0.2, 0.3, 0.25])
    gyro = identify.Gyro(noise=0.02, bias=[0.05, -0.04, 0.06])
    read = identify.simulate_readings(
        gyro, body, rj.Spin([1.5, 0.8, 3.0]), ts, hidden, key=jax.random.key(0)
    )
    record = identify.Recording(ts, (identify.Gyro(noise=0.02), read))
    found = identify.select(identify.Model(record, identify.Ratios()))
    none = identify.fit(identify.Model(record, identify.Ratios()))
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained", sharey=True)
    for ax, one, word in zip(axes, (none, found.fit), ("no term", found.terms), strict=True):
        for k, colour in enumerate(rj.plot.COLOURS[:3]):
            ax.plot(ts, one.residuals[0][:, k], color=colour, lw=1, label=f"$Ω_{'xyz'[k]}$")
        ax.axvspan(3.0, 4.0, color="0.93", zorder=0)
        ax.set(xlabel="time, s", title=word if isinstance(word, str) else " + ".join(word))
    axes[0].set_ylabel("gyro − fit, rad/s")
    axes[0].legend(fontsize=8, frameon=False)
    save(figure, "terms.png")


def look():
    """Draw the phases of the guide's page on identification: two throws, between rests."""
    box, rng = rj.Inertia.from_principal(2.0e-4, 3.0e-4, 4.0e-4), np.random.default_rng(0)
    sensors = identify.Gyro(0.03), identify.Accelerometer(0.2, place=[0.02, 0.0, 0.01])
    up, s = np.array([0.0, 0.0, 9.81]), np.linspace(0.0, 1.0, 60)[:, None]
    rest, push = np.zeros((200, 3)), 1 + 1.5 * np.sin(np.pi * s)
    rates, forces = [rest], [rest + up]
    for key, (start, count) in enumerate((([8.0, 1.0, 2.0], 160), ([1.0, 9.0, -1.0], 140))):
        how, t = dict(key=jax.random.key(key)), 0.005 * jnp.arange(count)
        w, f = identify.simulate_readings(sensors, box, rj.Spin(start), t, **how)
        rates += [s * w[0], w, s[::-1] * w[-1], rest]
        forces += [push * up, f, push[::-1] * up, rest + up]
    w, f = np.concatenate(rates), np.concatenate(forces)
    w, f = w + 0.02 * rng.normal(size=w.shape), f + 0.1 * rng.normal(size=f.shape)
    readings = zip(sensors, (w, f), strict=True)
    record = identify.Recording(0.005 * np.arange(len(w)), *readings)
    save(rj.plot.phases(record, identify.find_phases(record))[0].figure, "look.png")


def predict():
    """Draw the prediction of the guide's page on predictions, from the same readings."""
    truth, first = rj.Inertia.from_principal(1.0, 1.6, 2.2), rj.Spin([1.0, 0.5, 1.2])
    gyro, t = identify.Gyro(noise=0.05), jnp.linspace(0.0, 10.0, 101)
    rates = identify.simulate_readings(gyro, truth, first, t, key=jax.random.key(0))
    record = identify.Recording(t, (gyro, rates))
    found = identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)
    ts = jnp.linspace(0.0, 80.0, 641)
    low, high = found.interval_of(lambda p: rj.simulate(p.body, p.state0, ts).ys.omega[:, 0])
    real = rj.simulate(truth, first, ts).ys.omega[:, 0]
    figure, sides = plt.subplots(1, 2, figsize=(8.4, 3.0), sharey=True, layout="constrained")
    for ax, ends, title in zip(
        sides,
        ((0.0, 20.0), (60.0, 80.0)),
        ("the readings end at 10 s", "a minute later"),
        strict=True,
    ):
        ax.fill_between(
            ts, low, high, color=rj.plot.COLOURS[1], alpha=0.6, lw=0, label="95 % interval"
        )
        ax.plot(ts, real, color="black", lw=1.0, label="true rate")
        ax.plot(t, rates[:, 0], ".", color=rj.plot.COLOURS[0], ms=4, label="readings")
        ax.set(xlabel="time, s", xlim=ends)
        ax.set_title(title, fontsize=10)
    sides[0].set_ylabel("$\\Omega_x$, rad/s")
    figure.legend(
        *sides[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
    )
    save(figure, "predict.png")


def simulators():
    """Draw the table of the guide's page on simulators, as it stands there."""
    page = (HERE.parent / "guide" / "check_simulator.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    figure, ax = plt.subplots(figsize=(8.4, 4.0), layout="constrained")
    steps = 1e3 * jnp.array([1.0 / 120.0, 2e-3, 1e-3])
    colours = dict(zip(("mujoco", "mujoco-mjx", "brax", "jsbsim"), rj.plot.COLOURS, strict=False))
    for (package, name, *numbers), marker in zip(rows[2:], "os^os^sDosD^", strict=True):
        angles = [float(number) for number in numbers[:3]]
        kind = package.split()[0]
        ax.loglog(
            steps, angles, color=colours[kind], marker=marker, ms=5, lw=1.2, label=f"{kind}, {name}"
        )
    ax.set(xlabel="step, ms", ylabel="angle to the exact attitude at 5 s, rad")
    ax.set_xticks([1, 2, 8.33], ["1", "2", "1000/120"])
    ax.minorticks_off()
    ax.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    save(figure, "simulators.png")


def workprecision():
    """Draw time against error on the heavy top, from the records stored beside this file."""
    records = read_csv(HERE / "workprecision.csv")
    # (label of the records, shown name, mark, line); what is ours is drawn full.
    panels = {
        "value": [
            ("simulate", "simulate", "o", "-"),
            ("DormandPrince8, equal steps", "equal steps (DormandPrince8)", "s", "-"),
            ("diffrax Dopri8", "diffrax Dopri8", "^", "--"),
            ("diffrax Tsit5", "diffrax Tsit5", "v", "--"),
            ("heyoka Taylor", "heyoka", "D", ":"),
            ("MuJoCo RK4", "MuJoCo RK4", "P", ":"),
            ("scipy DOP853, numba", "SciPy DOP853 with numba", "X", ":"),
        ],
        "gradient": [
            ("simulate, reverse", "simulate", "o", "-"),
            ("diffrax Dopri8, checkpointed", "diffrax Dopri8, checkpointed", "^", "--"),
            ("diffrax Dopri8, backsolve", "diffrax Dopri8, backsolve", "v", "--"),
            ("gradsolve Vern7, replay", "gradsolve, replay", "*", "--"),
            ("heyoka Taylor, variational", "heyoka, variational", "D", ":"),
        ],
    }
    figure, axes = plt.subplots(1, 2, figsize=(9.2, 4.9), layout="constrained")
    for ax, (kind, lines) in zip(axes, panels.items(), strict=True):
        for place, (label, name, mark, line) in enumerate(lines):
            of = [r for r in records if (r.scene, r.kind, r.label) == ("heavy-top", kind, label)]
            of.sort(key=lambda r: r.setting)
            ax.plot(
                [r.error for r in of], [1e3 * r.time for r in of], marker=mark, ls=line, ms=5,
                lw=2.2 if line == "-" else 1.2, color=rj.plot.COLOURS[place % len(rj.plot.COLOURS)],
                label=name,
            )  # fmt: skip
        ax.set(xscale="log", yscale="log", ylabel="time of one run, ms")
        ax.invert_xaxis()
        ax.grid(alpha=0.3)
        ax.legend(
            fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncol=2, frameon=False
        )
    axes[0].set(xlabel="error of the attitude after 50 s, rad", title="a value")
    axes[1].set(
        xlabel="relative error of the gradient", title="a gradient with respect to 13 numbers"
    )
    save(figure, "workprecision.png")


if __name__ == "__main__":
    drawn = (frames, flip, start, fit, swing, terms, look, predict, simulators, workprecision)
    for draw in drawn:
        draw()
