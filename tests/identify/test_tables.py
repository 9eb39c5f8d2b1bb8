"""Recordings of tables that other libraries hold."""

import numpy as np
import pytest

import rigidjax as rj
from rigidjax.identify import Gyro, Recording

T = 0.05 * np.arange(8)
W = np.stack([np.cos(T), 2 * T, 1 - T], axis=1)
NAMES = ["wx", "wy", "wz"]


def columns(t="t", times=T, values=W):
    return {t: times} | dict(zip(NAMES, values.T, strict=True))


def check(frame, t="t", **how):
    recording = Recording.from_frame(frame, t=t, gyro=NAMES, **how)
    np.testing.assert_allclose(recording.t, T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(recording.readings[0].values, W, rtol=1e-12)
    assert isinstance(recording.sensors[0], Gyro)


def test_units_dates_and_gaps():
    check(columns())
    check(columns(values=np.degrees(W)), unit="deg/s")
    check(columns("time (ms)", 1e3 * T), t="time (ms)")
    when = np.datetime64("2024-05-01T10:00", "us") + (1e6 * T).round().astype("timedelta64[us]")
    check(columns(times=when))
    recording = Recording.from_frame(columns(values=np.where(T[:, None] == T[3], np.nan, W)), t="t", gyro=NAMES, noise=0.1)  # fmt: skip
    assert recording.t.size == 7 and recording.sensors[0].noise.shape == (3,)
    with pytest.raises(ValueError, match="wanted rad/s or deg/s or mdeg/s or rpm, got 'Hz'"):
        check(columns(), unit="Hz")
    with pytest.raises(ValueError, match=r"in deg/s by its name, and rad/s is stated"):
        Recording.from_frame({"t": T, "a (deg/s)": T, "b": T, "c": T}, t="t", gyro=["a (deg/s)", "b", "c"], unit="rad/s")  # fmt: skip


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frames(library):
    check(pytest.importorskip(library).DataFrame(columns()))


def test_xarray():
    xarray = pytest.importorskip("xarray")
    check(xarray.Dataset({name: ("t", column) for name, column in columns().items()}))


def test_a_fit_is_a_frame():
    pytest.importorskip("pandas")
    fit = rj.identify.fit(rj.datasets.toutatis.model(), starts=1)
    frame = fit.to_frame("deg/day")
    assert list(frame.columns) == ["value", "low", "high", "unit"]
    for name, *numbers, unit in rj.identify.report.rows(fit, "deg/day"):
        assert frame.loc[name, ["value", "low", "high"]].tolist() == numbers
        assert frame.loc[name, "unit"] == unit


def test_a_run_is_a_dataset():
    pytest.importorskip("xarray")
    body, start = rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Attitude([1.0, 0, 0, 0], [1.0, 2, 3])
    run = rj.simulate(body, start, T)
    data = run.to_xarray()
    np.testing.assert_array_equal(data.t, T)
    np.testing.assert_array_equal(data.omega.sel(axis="z"), run.ys.omega[:, 2])
    np.testing.assert_array_equal(data.q.sel(part="w").isel(t=3), run.ys.q[3, 0])
    axle = rj.suspensions.TorsionBar([0, 0, 1], 2.0)
    swing = rj.simulate(body, rj.Turn(0.1, 0.2), T, torque=axle)
    np.testing.assert_array_equal(swing.to_xarray().angle, swing.ys.angle)
    assert swing.to_xarray().angle.dims == ("t",)
