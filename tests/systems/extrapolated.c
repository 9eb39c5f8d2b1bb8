// Bodies and three-body orbits in more digits than JAX has: Gragg, Bulirsch and Stoer's extrapolation of order 20
// (Hairer, Norsett and Wanner 1993, II.9), with adaptive steps. Equations written apart from the library's.
#include <math.h>
#include <string.h>
#ifdef QUAD
#include <quadmath.h>
typedef __float128 Real;
#define sqrtr sqrtq
#define powr powq
#else
typedef long double Real;
#define sqrtr sqrtl
#define powr powl
#endif
#define ROWS 10
#define PULSES 6

// A row of numbers, as Python packs it; T is where a run ends. A body: all but mu; an orbit: mu, T.
enum { MU, TENSOR, COM = 10, GRAVITY = 13, DAMPING = 16, WHEEL = 19, GRADIENT = 22, TOWARDS = 23, EDGES = 26, TORQUES = 33, T = 51, WIDTH };
typedef struct { int size; const double *p; Real inverse[9], torque[3]; } Scene;

static Real absolute(Real x) { return x < 0 ? -x : x; }

static void cross(const Real *a, const Real *b, Real *out) {
  out[0] = a[1] * b[2] - a[2] * b[1], out[1] = a[2] * b[0] - a[0] * b[2], out[2] = a[0] * b[1] - a[1] * b[0];
}

static void product(const double *a, const Real *x, Real *out) {
  for (int i = 0; i < 3; i++) out[i] = a[3 * i] * x[0] + a[3 * i + 1] * x[1] + a[3 * i + 2] * x[2];
}

// A vector of the world in body axes.
static void seen(const Real *q, const double *v, Real *out) {
  Real back[3] = {-q[1], -q[2], -q[3]}, w[3] = {v[0], v[1], v[2]}, t[3], s[3];
  cross(back, w, t);
  for (int i = 0; i < 3; i++) t[i] *= 2;
  cross(back, t, s);
  for (int i = 0; i < 3; i++) out[i] = w[i] + q[0] * t[i] + s[i];
}

static void slope(const Scene *s, const Real *y, Real *out) {
  const double *p = s->p;
  if (s->size == 6) {  // x, v in the rotating axes of two bodies
    const Real *v = y + 3, mu = p[MU], a = y[0] + mu, b = a - 1, flat = y[1] * y[1] + y[2] * y[2];
    Real d1 = a * a + flat, d2 = b * b + flat, one = (1 - mu) / (d1 * sqrtr(d1)), two = mu / (d2 * sqrtr(d2));
    for (int i = 0; i < 3; i++) out[i] = v[i];
    out[3] = 2 * v[1] + y[0] - one * a - two * b, out[4] = -2 * v[0] + y[1] - (one + two) * y[1], out[5] = -(one + two) * y[2];
    return;
  }
  const Real *q = y, *w = y + 4, com[3] = {p[COM], p[COM + 1], p[COM + 2]};
  Real momentum[3], torque[3], g[3], more[3];
  out[0] = -(q[1] * w[0] + q[2] * w[1] + q[3] * w[2]) / 2, out[1] = (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]) / 2;
  out[2] = (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]) / 2, out[3] = (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]) / 2;
  product(p + TENSOR, w, momentum);
  for (int i = 0; i < 3; i++) momentum[i] += p[WHEEL + i];
  cross(momentum, w, torque);
  seen(q, p + GRAVITY, g), cross(com, g, more);
  for (int i = 0; i < 3; i++) torque[i] += more[i] - p[DAMPING + i] * w[i] + s->torque[i];
  if (p[GRADIENT] != 0) {
    Real r[3], turned[3], d = 0;
    for (int i = 0; i < 3; i++) d += (Real)p[TOWARDS + i] * p[TOWARDS + i];
    seen(q, p + TOWARDS, r), product(p + TENSOR, r, turned), cross(r, turned, more);
    for (int i = 0; i < 3; i++) torque[i] += 3 * (Real)p[GRADIENT] / (d * d * sqrtr(d)) * more[i];
  }
  for (int i = 0; i < 3; i++) out[4 + i] = s->inverse[3 * i] * torque[0] + s->inverse[3 * i + 1] * torque[1] + s->inverse[3 * i + 2] * torque[2];
}

static int run(const Scene *s, Real *y, Real t, Real end, Real tol) {
  int n = s->size, half = n == 7 ? 4 : 3;
  Real f[7], table[ROWS][7], a[7], b[7], k[7], before[7], h, large = 0, rate = 0;
  slope(s, y, f);
  for (int i = 0; i < n; i++) large = fmax(large, absolute(y[i])), rate = fmax(rate, absolute(f[i]));
  h = 0.3 * large / (rate + 1e-30);
  for (long count = 0; t < end; count++) {
    if (count > 1000000) return 1;
    int last = h >= end - t;
    Real step = last ? end - t : h, error = 0;
    slope(s, y, f);
    for (int m = 0; m < ROWS; m++) {
      int parts = 2 * (m + 1);
      Real small = step / parts;
      for (int i = 0; i < n; i++) a[i] = y[i], b[i] = y[i] + small * f[i];
      for (int j = 1; j < parts; j++) {
        slope(s, b, k);
        for (int i = 0; i < n; i++) { Real next = a[i] + 2 * small * k[i]; a[i] = b[i], b[i] = next; }
      }
      slope(s, b, k);
      for (int i = 0; i < n; i++) {
        Real e = (a[i] + b[i] + small * k[i]) / 2;
        for (int j = 0; j < m; j++) {
          Real ratio = (Real)parts / (2 * (m - j)), old = table[j][i];
          table[j][i] = e, e += (e - old) / (ratio * ratio - 1);
        }
        before[i] = m ? table[m - 1][i] : 0, table[m][i] = e;
      }
    }
    for (int part = 0; part < 2; part++) {
      Real off = 0, size = 0;
      for (int i = part ? half : 0; i < (part ? n : half); i++) {
        Real e = table[ROWS - 1][i] - before[i];
        off += e * e, size += table[ROWS - 1][i] * table[ROWS - 1][i];
      }
      off = sqrtr(off / size);
      if (!(off <= error)) error = off;
    }
    if (!(error < 1e30)) error = 1e30;
    Real factor = 0.85 * powr(tol / (error + 1e-40), (Real)1 / (2 * ROWS - 1));
    factor = factor > 3 ? 3 : factor < 0.2 ? 0.2 : factor;
    if (error <= 8 * tol) {
      memcpy(y, table[ROWS - 1], n * sizeof(Real));
      t = last ? end : t + step;
      if (!last || factor < 1) h = step * factor;
    } else h = step * factor;
  }
  return 0;
}

// y0 (many, size) → out (many, size, 2), the state at the end as a sum of two doubles. Returns how many failed.
int solved(long many, const double *rows, const double *y0, int size, double *out, double tol) {
  int failed = 0;
  for (long k = 0; k < many; k++, rows += WIDTH) {
    Scene s = {size, rows, {0}, {0}};
    Real y[7], length = 0, t = 0;
    int bad = 0;
    for (int i = 0; i < size; i++) y[i] = y0[k * size + i];
    if (size == 7) {
      Real A[9], c[9], det = 0;
      for (int i = 0; i < 9; i++) A[i] = rows[TENSOR + i];
      cross(A + 3, A + 6, c), cross(A + 6, A, c + 3), cross(A, A + 3, c + 6);
      for (int i = 0; i < 3; i++) det += A[i] * c[i];
      for (int i = 0; i < 9; i++) s.inverse[i] = c[3 * (i % 3) + i / 3] / det;
      for (int i = 0; i < 4; i++) length += y[i] * y[i];
      for (int i = 0; i < 4; i++) y[i] /= sqrtr(length);
    }
    if (rows[EDGES + PULSES] > 0) {
      for (int j = 0; j <= PULSES; t = rows[EDGES + j++]) {
        bad |= run(&s, y, t, rows[EDGES + j], tol);
        for (int i = 0; i < 3; i++) s.torque[i] = j < PULSES ? rows[TORQUES + 3 * j + i] : 0;
      }
    }
    bad |= run(&s, y, t, rows[T], tol);
    for (int i = 0; i < size; i++) {
      double high = (double)y[i];
      out[2 * (k * size + i)] = bad ? NAN : high, out[2 * (k * size + i) + 1] = (double)(y[i] - (Real)high);
    }
    failed += bad;
  }
  return failed;
}
