"""What the pictures show is what they were given: lines against closed forms, words on mistakes."""

import io
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from once import once

import rigidjax as rj

mpl.use("Agg")
import matplotlib.pyplot as plt

from rigidjax.plot.residuals import power_spectrum

BODY = rj.Inertia.from_principal(1.0, 2.0, 3.0)
SOLID = rj.Inertia.from_principal(1.0, 2.0, 2.5)
TS = jnp.linspace(0.0, 20.0, 101)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def flip():
    return rj.simulate(BODY, rj.Attitude([1.0, 0, 0, 0], [0.2, 1.0, 0.1]), TS)


def spun(omega, body=BODY):
    return rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], omega), TS).ys


def batch(states):
    return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), states)


def line(ax, label):
    return next(one for one in ax.lines if one.get_label() == label)


def test_motion_shows_rates_and_attitude_in_the_units_it_names(flip):
    above, below = rj.plot.motion(flip.ts, flip.ys, time_unit="min", rate_unit="deg/s")
    for axis, one in enumerate(below.lines):
        np.testing.assert_allclose(one.get_xdata(), TS / 60)
        np.testing.assert_allclose(one.get_ydata(), np.degrees(flip.ys.omega[:, axis]))
    assert (below.get_xlabel(), below.get_ylabel()) == ("time, min", "body rate Ω, deg/s")
    assert [one.get_label() for one in above.lines] == ["qw", "qx", "qy", "qz"]
    # The lines can be told apart in grey.
    assert [one.get_linestyle() for one in above.lines] == [":", "-", "--", "-."]
    assert [one.get_linestyle() for one in below.lines] == ["-", "--", "-."]
    (only,) = rj.plot.motion(flip.ts, rj.Spin(flip.ys.omega))
    assert len(only.lines) == 3


@pytest.mark.parametrize("name", [r"m$\badcmd{$", r"a\$b$c$", "_hidden", "$x$"])
def test_names_are_shown_as_they_are(name, flip):
    """No formula, which may not even be one, and no label that matplotlib leaves out."""
    ax = rj.plot.motion(flip.ts, flip.ys, title=name)[0]
    turning = rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0.0, 1.0]))
    path = rj.frames.Point(jnp.ones((5, 3)), jnp.zeros((5, 3)))
    here = rj.plot.frames(turning, TS[:5], path, marks={name: [1.0, 0, 0]})
    for drawn in (ax, here[1]):
        drawn.figure.savefig(io.BytesIO(), format="png")
    texts = here[1].get_legend().get_texts()
    assert any(name in parsed(text) for text in texts)
    assert parsed(ax.title).strip() == name


def parsed(text):
    """What matplotlib draws of a text that is no formula."""
    raw = text.get_text()
    assert (raw.count("$") - raw.count(r"\$")) == 0
    return raw.replace(r"\$", "$")


def test_motion_shows_the_angles_of_the_notes(flip):
    above, _ = rj.plot.motion(flip.ts, flip.ys, attitude="angles")
    shown = np.stack([one.get_ydata() for one in above.lines], axis=-1)
    wanted = np.degrees(once(jax.vmap(rj.euler.from_quaternion))(flip.ys.q))
    kept = np.isfinite(shown)
    assert kept.mean() > 0.9
    np.testing.assert_allclose(shown[2:][kept[2:]], wanted[2:][kept[2:]], atol=1e-8)


def test_the_polhode_lies_on_the_sphere_and_on_the_ellipsoid(flip):
    # Axes in another order and turned: the picture is along the ascending principal axes.
    turn = rj.quaternion.exp(jnp.array([0.3, -0.5, 0.2]))
    turned = rj.Spin(once(jax.vmap(lambda w: rj.quaternion.rotate(turn, w)))(flip.ys.omega))
    ax = rj.plot.polhode(BODY.rotate(turn), turned)
    path = np.stack(line(ax, "this motion").get_data_3d(), axis=-1)
    hidden = np.isnan(path[:, 0])
    assert 0 < hidden.sum() < len(path)
    np.testing.assert_allclose(np.linalg.norm(path[~hidden], axis=1), 1.0, atol=1e-12)
    first = flip.ys.omega[0] * jnp.array([1.0, 2.0, 3.0])
    twice_energy = float(flip.ys.omega[0] @ first / (first @ first))
    np.testing.assert_allclose(path[~hidden] ** 2 @ (1 / np.array([1, 2, 3])), twice_energy)
    assert line(ax, "separatrix") is not None


def test_a_sphere_has_no_family_of_polhodes():
    ball = rj.Inertia.from_principal(2.0, 2.0, 2.0)
    ax = rj.plot.polhode(ball, spun([0.3, 1.0, 0.2], ball))
    assert [one.get_label() for one in ax.lines if one.get_lw() < 1] == []


def test_the_herpolhode_of_a_symmetric_body_is_a_circle():
    ax = rj.plot.herpolhode(
        rj.Inertia.from_principal(1.0, 1.0, 2.0),
        spun([0.3, 0.0, 1.0], rj.Inertia.from_principal(1.0, 1.0, 2.0)),
    )
    # |L| = √(0.3² + 2²); what is left of |ω|² after (2T/h)² is the square of the radius.
    momentum = 0.3**2 + 4.0
    radius = np.sqrt(0.3**2 + 1.0 - (0.3**2 + 2.0) ** 2 / momentum)
    np.testing.assert_allclose(np.hypot(*ax.lines[0].get_data()), radius, rtol=1e-10)


def test_body_axes_start_where_the_attitude_says():
    ax = rj.plot.body_axes(spun([0.0, 0.0, 1.0]))
    starts = [one for one in ax.lines if one.get_marker() == "o" and one.get_label() != "start"]
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert names == ["body x axis", "body y axis", "body z axis", "start", "end"]
    np.testing.assert_allclose(
        [np.stack(one.get_data_3d())[:, 0] for one in starts], np.eye(3), atol=1e-15
    )


TOP = rj.torques.HeavyTop(1.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
TOP_BODY = rj.Inertia.from_principal(0.4, 0.4, 0.1)


def spinning_top(spin):
    start = rj.Attitude(rj.quaternion.exp(jnp.array([0.5, 0.0, 0.0])), spin)
    return rj.simulate(TOP_BODY, start, jnp.linspace(0.0, 1.0, 40), TOP).ys


def test_a_top_keeps_to_its_curve_of_energy():
    states = spinning_top([0.0, 0.0, 30.0])
    ax = rj.plot.phase_portrait(TOP_BODY, TOP, states)
    tilt, rate = line(ax, "this motion").get_data()
    tilt = np.radians(tilt)
    up, axis = 3.0 * np.cos(0.5), 3.0
    energy = 0.2 * rate**2 + (up - axis * np.cos(tilt)) ** 2 / (0.8 * np.sin(tilt) ** 2)
    energy = energy + 9.81 * 0.5 * np.cos(tilt)
    np.testing.assert_allclose(energy, energy[0], atol=1e-8)
    assert np.ptp(tilt) > 0.1
    # Steady precession at the cross: the least energy for these momenta.
    cross = np.radians(line(ax, "steady").get_xdata()[0])
    fine = np.linspace(cross - 0.05, cross + 0.05, 20001)
    least = (up - axis * np.cos(fine)) ** 2 / (0.8 * np.sin(fine) ** 2) + 4.905 * np.cos(fine)
    assert abs(fine[np.argmin(least)] - cross) < 0.01


def test_the_outline_of_an_ellipsoid_is_its_own():
    body = rj.shapes.ellipsoid(2.0, [1.0, 2.0, 3.0])
    for one, (i, j) in zip(rj.plot.inertia_ellipsoid(body), ((0, 1), (0, 2), (1, 2)), strict=True):
        x, y = line(one, "body").get_data()
        np.testing.assert_allclose([x.max(), y.max()], [i + 1, j + 1], rtol=1e-3)


def stand_in():
    """What the pictures ask of a fit, without a fit: one reading is wild, λ known to 10 %."""
    errors = 0.01 * np.random.default_rng(2).standard_normal((101, 3))
    errors[7] = 1.0
    reading = SimpleNamespace(
        sensor=rj.identify.Gyro(0.01), host_mask=np.ones(101, dtype=bool), jitter_error=None
    )
    shaped = lambda p: rj.Inertia.from_second_moment(jnp.diag(jnp.exp(p)))
    return SimpleNamespace(
        model=SimpleNamespace(
            recordings=(SimpleNamespace(t=TS, readings=(reading,)),),
            count=1,
            parts=(),
            unpack=lambda x: SimpleNamespace(body=shaped(x), state0=None),
            bodies=shaped,
        ),
        residuals=(errors,),
        noise=(np.full(3, 0.01),),
        x=jnp.zeros(3),
        point=SimpleNamespace(derivative_point=jnp.zeros(3)),
        determined_covariance=0.01 * np.eye(3),
        body=shaped(jnp.zeros(3)),
    )


def test_a_wild_reading_is_counted_and_does_not_press_the_others():
    over_time, spread, *_ = rj.plot.residuals(stand_in())[0]
    assert over_time.get_ylim()[0] == -8.0
    assert np.isnan(over_time.lines[0].get_ydata()).sum() == 1
    # At the edge there, a row for each axis.
    at_the_edge = [one.get_xydata() for one in over_time.lines if one.get_marker() == "^"][:3]
    np.testing.assert_allclose(at_the_edge, [[[TS[7], y]] for y in (7.6, 6.88, 6.16)])
    assert spread.get_legend().get_texts()[0].get_text() == "3 beyond"
    area = sum(bar.get_width() * bar.get_height() for bar in spread.patches)
    np.testing.assert_allclose(area, 300 / 303)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_the_spectrum_of_white_noise_is_one_and_a_line_stands_out(jitter):
    random = np.random.default_rng(0)
    t = 0.01 * (np.arange(2000) + random.uniform(-jitter, jitter, 2000))
    noise = random.standard_normal(2000)
    frequencies, level = power_spectrum(t, noise)
    # 2000 readings, about 1000 independent powers, each with a relative spread of one.
    np.testing.assert_allclose(level.mean(), 1.0, atol=0.1)
    np.testing.assert_allclose(frequencies[-1], 50.0, rtol=0.05)
    frequencies, lined = power_spectrum(t, noise + np.sin(2 * np.pi * 7.0 * t))
    assert abs(frequencies[lined.argmax()] - 7.0) < 0.25
    assert lined.max() > 20
    # As much power as the sine's variance, 1/2, more: over all frequencies up to 50 Hz it is 1.
    gained = (lined - level).sum() * (frequencies[1] - frequencies[0]) / 50.0
    np.testing.assert_allclose(gained, 0.5, atol=0.15)


def test_a_short_record_has_no_spectrum():
    assert power_spectrum(np.arange(5.0), np.ones(5))[0].size == 0


def test_the_cloud_of_outlines_is_as_wide_as_the_covariance_says():
    ax = rj.plot.inertia_ellipsoid(stand_in(), samples=400)
    reach = [one.get_xdata().max() for one in ax[0].lines if one.get_alpha() == 0.25]
    assert len(reach) == 400
    # Semi-axis √(λ/3), log λ with a standard deviation of 0.1: that of its logarithm is 0.05.
    np.testing.assert_allclose(np.std(np.log(reach)), 0.05, rtol=0.15)
    np.testing.assert_allclose(np.mean(np.log(reach)), np.log(3**-0.5), atol=0.01)


@pytest.fixture(scope="module")
def found():
    # Not BODY: a plate lies at the rim of what a fit can reach, some noise would push it beyond.
    rates = rj.simulate(SOLID, rj.Spin([1.0, 0.2, 0.8]), TS).ys.omega
    noise = 0.01 * np.random.default_rng(1).standard_normal(rates.shape)
    record = rj.identify.Recording(TS, (rj.identify.Gyro(0.01), rates + noise))
    return rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=1)


@pytest.mark.slow
def test_the_pictures_of_a_fit(found):
    assert found.ok
    ax = rj.plot.inertia_ellipsoid(found, truth=SOLID, samples=50)
    best, truth = (np.stack(line(ax[0], name).get_data()) for name in ("body", "truth"))
    # The data fix the ratios to a percent or so: the two outlines lie on each other.
    np.testing.assert_allclose(best, truth, atol=0.02)
    cloud = np.stack([one.get_data() for one in ax[0].lines if one.get_alpha() == 0.25])
    assert cloud.shape[0] == 50
    assert 1e-4 < np.abs(cloud - best).max() < 0.05
    over_time, spread, memory, _ = rj.plot.residuals(found)[0]
    shown = np.stack([one.get_ydata() for one in over_time.lines], axis=-1)
    np.testing.assert_allclose(shown, np.asarray(found.residuals[0]) / 0.01)
    area = sum(bar.get_width() * bar.get_height() for bar in spread.patches)
    np.testing.assert_allclose(area, 1.0)
    # White noise: nearly all of the correlations lie in the band of two standard deviations.
    inside = np.abs(np.stack([one.get_ydata() for one in memory.lines[:3]])) < 2 / np.sqrt(101)
    assert inside.mean() > 0.85
    figure = rj.plot.fit(found, title="a log")
    assert figure.axes[0].get_ylabel() == "body rate, rad/s"
    upper = figure.axes[0].lines
    assert [one.get_linestyle() for one in upper if one.get_marker() == "None"] == ["-", "--", "-."]
    assert [one.get_marker() for one in upper if one.get_linestyle() == "None"] == ["o", "s", "^"]


@pytest.mark.parametrize(
    "turntable",
    [rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0.0, 1.5])), rj.scenes.turntable(1.5)],
    ids=["frame", "scene"],
)
def test_a_free_particle_goes_straight_on_the_right(turntable):
    ts = jnp.linspace(0.0, 3.0, 30)
    seen = rj.simulate(None, rj.Point([1.0, 0, 0], [0.0, 0.2, 0.0]), ts, turntable).ys
    left, right = rj.plot.frames(turntable, ts, seen, marks={"post": [0.5, 0.0, 0.0]})
    x, y = right.lines[0].get_data()
    np.testing.assert_allclose(x, 1.0, atol=1e-7)
    np.testing.assert_allclose(y, 1.7 * ts, atol=1e-7)
    np.testing.assert_allclose(left.lines[0].get_xdata(), seen.x[:, 0])
    np.testing.assert_allclose(np.hypot(*line(right, "post").get_data()), 0.5)


def test_a_film_has_its_pictures(flip, tmp_path):
    from PIL import Image

    states = jax.tree.map(lambda a: a[:26], flip.ys)
    film = rj.plot.tumble(
        rj.shapes.box(1.0, [0.1, 0.2, 0.3]), flip.ts[:26], states, seconds=0.4, fps=10
    )
    path = film.save(tmp_path / "tumble.gif")
    with Image.open(path) as picture:
        assert picture.n_frames == 4
        first = np.asarray(picture.convert("RGB"), dtype=float)
        picture.seek(2)
        assert np.abs(np.asarray(picture.convert("RGB"), dtype=float) - first).mean() > 1
    assert film._repr_html_().startswith("<img")
    with pytest.raises(ValueError, match=r"ends in \.gif or \.html or \.mp4, got tumble\.png"):
        film.save(tmp_path / "tumble.png")
    assert not plt.get_fignums()


def test_the_box_of_a_box_is_itself():
    from rigidjax.plot.animation import equal_box

    half, turn = equal_box(rj.shapes.box(3.0, [0.2, 0.6, 0.4]))
    np.testing.assert_allclose(half, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(np.abs(turn), [[1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)


def test_between_saved_times_a_film_stays_on_the_group():
    from rigidjax.plot.animation import resampled_attitudes

    ts = jnp.linspace(0.0, 6.0, 40)
    turning = once(jax.vmap(lambda t: rj.quaternion.exp(jnp.array([0.0, 0.0, 1.0]) * t)))(ts)
    # The same attitudes with signs as they may come out of a logarithm.
    signs = jnp.where(jnp.arange(40) % 3 == 0, -1.0, 1.0)[:, None]
    states = rj.Attitude(turning * signs, jnp.zeros((40, 3)))
    times, q = resampled_attitudes(ts, states, 23)
    exact = np.stack([np.cos(times / 2), 0 * times, 0 * times, np.sin(times / 2)], axis=-1)
    apart = np.abs(np.einsum("ti,ti->t", q, exact))
    np.testing.assert_allclose(apart, 1.0, atol=1e-6)


def test_the_player_is_one_page_without_a_network(flip, capsys):
    pytest.importorskip("viser", exc_type=ImportError)
    body = rj.shapes.box(1.0, [0.1, 0.2, 0.3])
    film = rj.plot.player(body, flip.ts, flip.ys, seconds=1, fps=20)
    page = film.data.decode("utf-8")
    assert 'window.__VISER_EMBED_DATA__="' in page
    assert "<script src=" not in page
    assert 'href="http' not in page
    assert capsys.readouterr().out == ""
    assert len(page) < 1_200_000


def test_words_on_mistakes(flip, monkeypatch):
    still = spun([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="draw one body of a batch at a time"):
        rj.plot.polhode(BODY, batch(flip.ys))
    with pytest.raises(ValueError, match="wanted one of s, min, h, day, got 'days'"):
        rj.plot.motion(flip.ts, flip.ys, time_unit="days")
    with pytest.raises(
        ValueError, match="attitude: wanted one of quaternion, axes, angles, got 'euler'"
    ):
        rj.plot.motion(flip.ts, flip.ys, attitude="euler")
    with pytest.raises(ValueError, match=r"ts: wanted \(101,\) as the states have, got \(100,\)"):
        rj.plot.motion(flip.ts[1:], flip.ys)
    with pytest.raises(ValueError, match="got one at rest, which has no sphere"):
        rj.plot.polhode(BODY, still)
    with pytest.raises(ValueError, match="got one at rest; it has no invariable plane"):
        rj.plot.herpolhode(BODY, still)
    with pytest.raises(TypeError, match="wanted 3-D axes, got flat ones"):
        rj.plot.polhode(BODY, flip.ys, ax=plt.subplots()[1])
    with pytest.raises(ValueError, match="a torque acts, and there is no invariable plane"):
        rj.plot.herpolhode(TOP_BODY, spinning_top([0.0, 0.0, 30.0]))
    with pytest.raises(ValueError, match="wanted a body symmetric about the axis"):
        rj.plot.phase_portrait(BODY, TOP, flip.ys)
    with pytest.raises(TypeError, match="wanted an Inertia, a MassProperties or a Fit, got list"):
        rj.plot.inertia_ellipsoid([1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="wanted two of x, y, z such as 'xz', got 'xyz'"):
        rj.plot.frames(
            rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0, 1])),
            flip.ts,
            rj.Point(flip.ys.omega, flip.ys.omega),
            plane="xyz",
        )
    with pytest.raises(TypeError, match="frame: wanted a MovingFrame, or a scene with one"):
        rj.plot.frames(rj.scenes.earth(0.5), flip.ts, rj.Point(flip.ys.omega, flip.ys.omega))
    with pytest.raises(ValueError, match="fps: wanted a positive number, got 0"):
        rj.plot.tumble(BODY, flip.ts, flip.ys, fps=0)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install '.\[view\]'"):
        rj.plot.motion(flip.ts, flip.ys)


def test_a_state_without_attitude_is_named(flip, unhooked):
    with pytest.raises(TypeError, match=r"wanted states with an attitude .*, got Spin"):
        rj.plot.body_axes(rj.Spin(flip.ys.omega))  # pyright: ignore[reportArgumentType]


def test_nothing_of_this_is_imported_before_it_is_called():
    code = "import sys, rigidjax; print([m for m in ('matplotlib', 'viser', 'PIL') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_a_film_shows_the_surface_that_it_gets():
    from rigidjax.plot.animation import SHADES, _solid

    body = rj.shapes.box(2.0, [0.2, 0.6, 0.4])
    # A box of triangles, whose corner is at the origin: a body on a pivot.
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    size = np.array([0.2, 0.6, 0.4])
    shown = _solid(body, [(corners * size, faces), (corners * size + 1.0, faces)])
    assert shown.polygons.shape == (24, 3, 3)
    np.testing.assert_allclose(shown.polygons.min((0, 1)), 0, atol=1e-12)
    np.testing.assert_allclose(shown.polygons.max((0, 1)), 1 + size)
    np.testing.assert_allclose(shown.colours[:12], np.repeat(SHADES, 2, axis=0), atol=1e-12)
    # The end of the longest axis, y.
    np.testing.assert_allclose(shown.tip, [0, 1.6, 0], atol=1e-12)
    # The box of a box is drawn as itself.
    box = _solid(body, None)
    np.testing.assert_allclose(np.sort(np.abs(box.polygons).max((0, 1))), [0.1, 0.2, 0.3])
    with pytest.raises(TypeError, match=r"surface: wanted \(vertices, faces\)"):
        _solid(body, 3.0)


def test_a_film_says_when_its_pictures_show_another_motion():
    ts = jnp.linspace(0.0, 2.0, 81)
    spin = jnp.stack([jax.vmap(lambda t: 9.0 + 0 * t)(ts), 0 * ts, 0 * ts], axis=1)
    q = once(jax.vmap(rj.quaternion.exp))(spin * ts[:, None])
    states, body = rj.Attitude(q, spin), rj.shapes.box(1.0, [1.0, 2.0, 3.0])
    # 18 rad in 2 s: 0.41 turns between 8 pictures, 0.57 between 6.
    rj.plot.tumble(body, ts, states, seconds=2, fps=4, size=64)
    with pytest.warns(UserWarning, match=r"0\.57 turns between two pictures"):
        rj.plot.tumble(body, ts, states, seconds=2, fps=3, size=64)
    few = jax.tree.map(lambda a: a[::10], states)
    with pytest.warns(UserWarning, match="turns between two of ts"):
        rj.plot.tumble(body, ts[::10], few, seconds=2, fps=8, size=64)
