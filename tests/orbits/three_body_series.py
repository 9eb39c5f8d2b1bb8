"""The restricted three-body problem by Taylor series at any number of digits: an oracle."""

import mpmath as mp


def coefficients(mu, state, order):
    """Taylor coefficients of x, y, z, vx, vy, vz about `state`."""
    x, y, z, vx, vy, vz = ([c] for c in state)
    # Distances along x from the bodies, squared distances and their powers −3/2, as series.
    along = [[x[0] + mu], [x[0] + mu - 1]]
    squares, cubes = [[], []], [[], []]

    def product(a, b, n):
        return mp.fdot(a[: n + 1], b[n::-1])

    for n in range(order):
        flat = product(y, y, n) + product(z, z, n)
        for d, s, p in zip(along, squares, cubes, strict=True):
            s.append(product(d, d, n) + flat)
            if n == 0:
                p.append(s[0] ** mp.mpf(-1.5))
            else:  # s p' = −(3/2) s' p
                total = mp.fsum(
                    (-k * mp.mpf(1.5) - (n - k)) * s[k] * p[n - k] for k in range(1, n + 1)
                )
                p.append(total / (n * s[0]))
        (d1, d2), (p1, p2) = along, cubes
        big, small = 1 - mu, mu
        pulls = [
            -big * product(p1, a, n) - small * product(p2, b, n)
            for a, b in ((d1, d2), (y, y), (z, z))
        ]
        rates = (
            vx[n],
            vy[n],
            vz[n],
            pulls[0] + x[n] + 2 * vy[n],
            pulls[1] + y[n] - 2 * vx[n],
            pulls[2],
        )
        for series, rate in zip((x, y, z, vx, vy, vz), rates, strict=True):
            series.append(rate / (n + 1))
        d1.append(x[-1])
        d2.append(x[-1])
    return x, y, z, vx, vy, vz


def solve(mu, state, late):
    """The state (6,) at `late`, to a few digits less than `mp.mp.dps`."""
    order = int(0.9 * mp.mp.dps)
    small = mp.mpf(10) ** (8 - mp.mp.dps)
    mu, late, state = mp.mpf(mu), mp.mpf(late), [mp.mpf(c) for c in state]
    while late > 0:
        series = coefficients(mu, state, order)
        step = min(
            (small / max(abs(s[k]) for s in series)) ** (mp.mpf(1) / k) for k in (order - 1, order)
        )
        step = min(step, late)
        powers = [step**k for k in range(order + 1)]
        state = [mp.fdot(s, powers) for s in series]
        late -= step
    return state
