"""The free body in mpmath: Taylor series of Π' = Π × KΠ, q' = ½ q ⊗ KΠ, to any number of digits."""

import functools

import mpmath as mp


def attitude_and_rate(inertia, q0, omega0, t, *, digits=50, order=32, longest=0.1):
    """Quaternion (4) and body rate (3) at time t, as lists of mpf.

    `inertia` 3×3 nested list, `q0` (w, x, y, z) of any length (it is scaled to one), `omega0`.
    """
    with mp.workdps(digits):
        tensor = mp.matrix(inertia)
        inverse = tensor**-1
        length = mp.sqrt(sum(mp.mpf(c) ** 2 for c in q0))
        # Whole numbers of 2⁻ᵇ, 64 bits beyond the digits: a tenth of the time that mpf takes.
        bits = mp.mp.prec + 64

        def whole(numbers):
            return [int(mp.nint(mp.ldexp(mp.mpf(c), bits))) for c in numbers]

        def real(numbers):
            return [mp.ldexp(mp.mpf(c), -bits) for c in numbers]

        q = whole([mp.mpf(c) / length for c in q0])
        momentum = whole(tensor * mp.matrix(omega0))
        rows = [whole(inverse[i, :]) for i in range(3)]
        steps = max(1, int(mp.ceil(mp.mpf(t) / longest)))
        (h,) = whole([mp.mpf(t) / steps])
        for _ in range(steps):
            q, momentum = _step(q, momentum, rows, h, order, bits)
        return real(q), list(inverse * mp.matrix(real(momentum)))


def _step(q, momentum, inverse, h, order, bits):
    qs, ps, ws = [q], [momentum], []
    for k in range(order):
        ws.append([sum(a * b for a, b in zip(row, ps[k], strict=True)) >> bits for row in inverse])
        turn, flow = [0] * 3, [0] * 4
        for j in range(k + 1):
            turn = [a + b for a, b in zip(turn, _cross(ps[j], ws[k - j]), strict=True)]
            flow = [a + b for a, b in zip(flow, _times(qs[j], ws[k - j]), strict=True)]
        ps.append([(c >> bits) // (k + 1) for c in turn])
        qs.append([(c >> bits) // (2 * (k + 1)) for c in flow])
    return [_horner(qs, i, h, bits) for i in range(4)], [_horner(ps, i, h, bits) for i in range(3)]


def _horner(series, i, h, bits):
    total = 0
    for term in reversed(series):
        total = (total * h >> bits) + term[i]
    return total


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _times(q, w):
    """q ⊗ (0, w)."""
    a, x, y, z = q
    return [
        -x * w[0] - y * w[1] - z * w[2],
        a * w[0] + y * w[2] - z * w[1],
        a * w[1] + z * w[0] - x * w[2],
        a * w[2] + x * w[1] - y * w[0],
    ]


@functools.cache
def jacobian(inertia, q0, omega0, t, *, step="1e-10"):
    """d(q, Ω)/d(Ixx, Iyy, Izz, Ixy, Ixz, Iyz, Ωx, Ωy, Ωz, w, x, y, z): 7 × 13, by differences.

    Hashable arguments: nested tuples.
    """
    with mp.workdps(50):
        places = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]

        def run(index, change):
            tensor = [[mp.mpf(c) for c in row] for row in inertia]
            rate, q = [mp.mpf(c) for c in omega0], [mp.mpf(c) for c in q0]
            if index < 6:
                i, j = places[index]
                tensor[i][j] += change
                tensor[j][i] = tensor[i][j]
            elif index < 9:
                rate[index - 6] += change
            else:
                q[index - 9] += change
            q, rate = attitude_and_rate(tensor, q, rate, t)
            return [*q, *rate]

        d = mp.mpf(step)
        columns = []
        for index in range(13):
            up, down = run(index, d), run(index, -d)
            columns.append([float((a - b) / (2 * d)) for a, b in zip(up, down, strict=True)])
        return [[columns[c][r] for c in range(13)] for r in range(7)]
