"""Hold the Butcher tableaus of explicit Runge–Kutta methods, with error estimates and dense output.

Each row is sparse, `{stage: weight}`, so that a zero weight costs nothing.
"""

import functools
from typing import Any, NamedTuple

import diffrax as dfx
import numpy as np

Row = dict[int, float]
# Of the weights of one row at most this many may be rounded to the number that is not the nearest.
_MOST_CHOSEN = 12


class Tableau(NamedTuple):
    """Hold the numbers of an explicit Runge–Kutta method.

    Dense output, the state within a step, is a cubic polynomial in the fraction θ of the step that
    has passed, with the right state and slope at both ends, plus multiples of θ²(1−θ)², θ³(1−θ)²,
    θ³(1−θ)³, … (Hairer, Nørsett and Wanner 1993, II.6).
    """

    order: int  # of the solution
    c: tuple[float, ...]  # the nodes of the stages after the first
    a: tuple[Row, ...]  # the weights of these stages
    b: Row  # the weights of the solution
    # The weights of one or two error estimates, the one of higher order first. In these weights the
    # stage number `len(a) + 1` is the derivative at the end of the step.
    errors: tuple[Row, ...]
    # The nodes and the weights of the stages that only dense output needs. The first of them has
    # the number `len(a) + 2`.
    extra_c: tuple[float, ...] = ()
    extra_a: tuple[Row, ...] = ()
    dense: tuple[Row, ...] = ()  # the weights of all slopes in each of the multiples


def _parse_rows(text: str) -> tuple[Row, ...]:
    """Return the rows of a Butcher tableau from `stage:weight` pairs; a semicolon ends a row."""
    rows = [row.split() for row in text.split(";")]
    return tuple({int(i): float(w) for i, w in (part.split(":") for part in row)} for row in rows)


def parse_numbers(text: str) -> tuple[float, ...]:
    """Return the numbers of a text, which are separated by spaces."""
    return tuple(map(float, text.split()))


def round_weights(tableau: Tableau, dtype: Any) -> Tableau:
    """Return the tableau with weights rounded to `dtype` such that the row sums hardly change.

    The sum of a row is the time of its stage. If each weight is rounded to the nearest float32,
    those of DOP853 sum to 1 + 4e-7: every run is too fast by this fraction, however short its steps
    are. Weights of float64 are returned unchanged.
    """
    if np.dtype(dtype) == np.float64:
        return tableau
    nodes = (0.0, *tableau.c, 1.0, *tableau.extra_c)

    def rounded(row: Row) -> Row:
        times = tuple(nodes[stage] for stage in row)
        return dict(zip(row, _rounded_weights(tuple(row.values()), times, dtype), strict=True))

    a, extra_a = (tuple(map(rounded, rows)) for rows in (tableau.a, tableau.extra_a))
    return tableau._replace(a=a, b=rounded(tableau.b), extra_a=extra_a)


@functools.cache
def _rounded_weights(
    weights: tuple[float, ...], times: tuple[float, ...], dtype: Any
) -> tuple[float, ...]:
    """Return the weights of one row, each rounded up or down to a number of `dtype`.

    Of all such choices, the result changes least the sum of the weights wᵢ and that of wᵢcᵢ, where
    the `times` cᵢ are those of the stages, as fractions of the step.
    """
    exact = np.array(weights)
    near = exact.astype(dtype)
    error = near.astype(float) - exact
    # A weight that `dtype` holds exactly stays as it is.
    way = np.where(error == 0, near, np.where(error > 0, -np.inf, np.inf)).astype(dtype)
    step = np.nextafter(near, way).astype(float) - near.astype(float)
    # Each row of `choice` is one choice: 1 for each weight that is not rounded to the nearest
    # number, but to the next one on the other side. In a long row these are weights whose
    # rounding matters most.
    chosen = np.argsort(-np.abs(step))[:_MOST_CHOSEN]
    choice = np.arange(2**chosen.size)[:, None] >> np.arange(chosen.size) & 1
    sums = np.stack([np.ones(exact.size), times], axis=1)
    changes = error @ sums + (choice * step[chosen]) @ sums[chosen]
    near = near.astype(float)
    near[chosen] += choice[np.argmin(np.sum(changes**2, axis=1))] * step[chosen]
    return tuple(near.tolist())


def _sparse_row(row: np.ndarray) -> Row:
    """Return a row (s,) without its zeros."""
    return {i: float(w) for i, w in enumerate(row) if w != 0}


# Kutta's method of 1901. The error estimate is the difference between the result of the method and
# a second result, in which the slope at the end of the step takes the place of the fourth stage.
# The second result fulfils all order conditions up to order 3, but not all those of order 4. For it
# the sum Σ b_i a_ij c_j² is 7/72, where order 4 needs 1/12.
KUTTA4 = Tableau(
    order=4,
    c=(0.5, 0.5, 1.0),
    a=({0: 0.5}, {1: 0.5}, {2: 1.0}),
    b={0: 1 / 6, 1: 1 / 3, 2: 1 / 3, 3: 1 / 6},
    errors=({3: 1 / 6, 4: -1 / 6},),
)

# Tsitouras' method of order 5 (2011), doi:10.1016/j.camwa.2011.06.002. The numbers are those of
# `diffrax.Tsit5`.
_TSIT5 = dfx.Tsit5.tableau
TSITOURAS5 = Tableau(
    order=5,
    c=tuple(float(c) for c in _TSIT5.c[:-1]),
    a=tuple(_sparse_row(row) for row in _TSIT5.a_lower[:-1]),
    b=_sparse_row(_TSIT5.b_sol),
    errors=(_sparse_row(_TSIT5.b_error),),
    # The dense output of Tsitouras' paper is a polynomial of degree 4 in θ, the fraction of the
    # step that has passed. These are the weights of the slopes at the stages in its coefficient of
    # θ⁴. The other coefficients follow from the states and slopes at both ends of the step.
    dense=_parse_rows("""
    0:-1.0530884977290216 1:0.1017 2:2.490627285651252793 3:-16.54810288924490272
      4:47.37952196281928122 5:-34.87065786149660974 6:2.5
    """),
)

# DOP853: Hairer, Nørsett and Wanner, Solving Ordinary Differential Equations I (1993), II.5 and
# II.6, doi:10.1007/978-3-540-78862-1, after Prince and Dormand 1981,
# doi:10.1016/0771-050X(81)90010-3.
# It has twelve stages, order 8, error estimates of orders 5 and 3, and dense output of order 7. It
# has fewer stages and smaller constants than the 8(7) pair of 1981 that `diffrax.Dopri8` uses.
(_B,) = _parse_rows("""
    0:0.054293734116568765 5:4.450312892752409 6:1.8915178993145003 7:-5.801203960010585
      8:0.3111643669578199 9:-0.1521609496625161 10:0.20136540080403034 11:0.04471061572777259
""")
# The second error estimate of DOP853 is the difference from a method of order 3 with the same
# stages. These are the three weights of this method that are not zero.
_THIRD = {0: 0.2440944881889764, 8: 0.7338466882816118, 11: 0.022058823529411766}
DORMAND_PRINCE8 = Tableau(
    order=8,
    c=parse_numbers("""
    0.05260015195876773 0.0789002279381516 0.1183503419072274 0.2816496580927726 0.3333333333333333
    0.25 0.3076923076923077 0.6512820512820513 0.6 0.8571428571428571 1.0
    """),
    a=_parse_rows("""
    0:0.05260015195876773;
    0:0.0197250569845379 1:0.0591751709536137;
    0:0.02958758547680685 2:0.08876275643042054;
    0:0.2413651341592667 2:-0.8845494793282861 3:0.924834003261792;
    0:0.037037037037037035 3:0.17082860872947386 4:0.12546768756682242;
    0:0.037109375 3:0.17025221101954405 4:0.06021653898045596 5:-0.017578125;
    0:0.03709200011850479 3:0.17038392571223998 4:0.10726203044637328 5:-0.015319437748624402
      6:0.008273789163814023;
    0:0.6241109587160757 3:-3.3608926294469414 4:-0.868219346841726 5:27.59209969944671
      6:20.154067550477894 7:-43.48988418106996;
    0:0.47766253643826434 3:-2.4881146199716677 4:-0.590290826836843 5:21.230051448181193
      6:15.279233632882423 7:-33.28821096898486 8:-0.020331201708508627;
    0:-0.9371424300859873 3:5.186372428844064 4:1.0914373489967295 5:-8.149787010746927
      6:-18.52006565999696 7:22.739487099350505 8:2.4936055526796523 9:-3.0467644718982196;
    0:2.273310147516538 3:-10.53449546673725 4:-2.0008720582248625 5:-17.9589318631188
      6:27.94888452941996 7:-2.8589982771350235 8:-8.87285693353063 9:12.360567175794303
      10:0.6433927460157636
    """),
    b=_B,
    errors=(
        *_parse_rows("""
        0:0.01312004499419488 5:-1.2251564463762044 6:-0.4957589496572502 7:1.6643771824549864
          8:-0.35032884874997366 9:0.3341791187130175 10:0.08192320648511571
          11:-0.022355307863886294
        """),
        {i: _B.get(i, 0.0) - _THIRD.get(i, 0.0) for i in (0, 5, 6, 7, 8, 9, 10, 11)},
    ),
    extra_c=(0.1, 0.2, 0.7777777777777778),
    extra_a=_parse_rows("""
    0:0.056167502283047954 6:0.25350021021662483 7:-0.2462390374708025 8:-0.12419142326381637
      9:0.15329179827876568 10:0.00820105229563469 11:0.007567897660545699 12:-0.008298;
    0:0.03183464816350214 5:0.028300909672366776 6:0.053541988307438566 7:-0.05492374857139099
      10:-0.00010834732869724932 11:0.0003825710908356584 12:-0.00034046500868740456
      13:0.1413124436746325;
    0:-0.42889630158379194 5:-4.697621415361164 6:7.683421196062599 7:4.06898981839711
      8:0.3567271874552811 12:-0.0013990241651590145 13:2.9475147891527724 14:-9.15095847217987
    """),
    dense=_parse_rows("""
    0:-8.428938276109013 5:0.5667149535193777 6:-3.0689499459498917 7:2.38466765651207
      8:2.117034582445028 9:-0.871391583777973 10:2.2404374302607883 11:0.6315787787694688
      12:-0.08899033645133331 13:18.148505520854727 14:-9.194632392478356 15:-4.436036387594894;
    0:10.427508642579134 5:242.28349177525817 6:165.20045171727028 7:-374.5467547226902
      8:-22.113666853125306 9:7.733432668472264 10:-30.674084731089398 11:-9.332130526430229
      12:15.697238121770845 13:-31.139403219565178 14:-9.35292435884448 15:35.81684148639408;
    0:19.985053242002433 5:-387.0373087493518 6:-189.17813819516758 7:527.8081592054236
      8:-11.57390253995963 9:6.8812326946963 10:-1.0006050966910838 11:0.7777137798053443
      12:-2.778205752353508 13:-60.19669523126412 14:84.32040550667716 15:11.99229113618279;
    0:-25.69393346270375 5:-154.18974869023643 6:-231.5293791760455 7:357.6391179106141
      8:93.40532418362432 9:-37.45832313645163 10:104.0996495089623 11:29.8402934266605
      12:-43.53345659001114 13:96.32455395918828 14:-39.17726167561544 15:-149.72683625798564
    """),
)
