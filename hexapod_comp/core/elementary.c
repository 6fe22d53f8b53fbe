/* SPDX-License-Identifier: Apache-2.0
 *
 * Sine, cosine, exponential, arc tangent and arc cosine in IEEE arithmetic, so that no bit of a result depends on the C
 * library. Errors are below one unit in the last place: the argument is reduced to a pair of doubles (high + low;
 * Dekker 1971, Cody and Waite 1980), and on the small remaining interval the error of Taylor's series is below rounding. The
 * functions of <math.h> that the core calls (sqrt, fabs, floor, rint, fmod, ldexp, ...) are exact by definition.
 */
#include "core.h"

/* A number high + low with twice the digits of a double. */
typedef struct {
    double high, low;
} pair;

/* a + b without rounding. */
static pair sum_of(double a, double b)
{
    pair s;
    double part;
    s.high = a + b;
    part = s.high - a;
    s.low = (a - (s.high - part)) + (b - part);
    return s;
}

/* The upper half of the digits of a. */
static double upper_half(double a)
{
    const double c = 134217729.0 * a; /* 2^27 + 1 */
    return c - (c - a);
}

/* a b without rounding. */
static pair product_of(double a, double b)
{
    const double a1 = upper_half(a), a2 = a - a1, b1 = upper_half(b), b2 = b - b1;
    pair p;
    p.high = a * b;
    p.low = a2 * b2 - (((p.high - a1 * b1) - a2 * b1) - a1 * b2);
    return p;
}

static pair quotient_of(pair a, pair b)
{
    const double q = a.high / b.high;
    const pair p = product_of(q, b.high);
    pair out;
    out.high = q;
    out.low = (((a.high - p.high) - p.low) + a.low - q * b.low) / b.high;
    return out;
}

/* Angles beyond 2^20 quarter turns (1.3 km of a screw with 5 mm pitch) are first reduced modulo the double nearest to 2 pi:
 * the result has the same bits on all machines, but is no longer accurate to the last place. */
static void sine_cosine(double angle, double *sine, double *cosine)
{
    /* pi / 2 in four pieces; the first three have at most 33 bits, so that their products with n are exact */
    static const double piece[] = {0x1.921fb544p+0, 0x1.0b4611a6p-34, 0x1.3198a2ep-69, 0x1.b839a252049c1p-104};
    const double x = fabs(angle) < 0x1.9p+20 ? angle : fmod(angle, 2.0 * PI);
    const double n = rint(x * (2.0 / PI));
    const pair first = sum_of(x - n * piece[0], -(n * piece[1])), second = sum_of(first.high, -(n * piece[2]));
    const double low = second.low + first.low - n * piece[3];
    const double y = second.high + low, rest = (second.high - y) + low, z = y * y, half = 0.5 * z, whole = 1.0 - half;
    const double s = 1 / 6.0 - z * (1 / 120.0 - z * (1 / 5040.0 - z * (1 / 362880.0 - z * (1 / 39916800.0
                     - z * (1 / 6227020800.0 - z * (1 / 1307674368e3 - z * (1 / 355687428096e3)))))));
    const double c = 1 / 24.0 - z * (1 / 720.0 - z * (1 / 40320.0 - z * (1 / 3628800.0 - z * (1 / 479001600.0
                     - z * (1 / 87178291200.0 - z * (1 / 20922789888e3))))));
    const double sine_y = y - (z * y * s - rest * whole);
    const double cosine_y = whole + (((1.0 - whole) - half) + (z * z * c - y * rest));
    const int quarter = x - x == 0.0 ? (int)n & 3 : 0;
    *sine = quarter & 1 ? cosine_y : sine_y;
    *cosine = quarter & 1 ? sine_y : cosine_y;
    *sine = quarter & 2 ? -*sine : *sine;
    *cosine = quarter == 1 || quarter == 2 ? -*cosine : *cosine;
}

/* e^x - less, with `less` 0 or 1. */
static double exponential(double x, double less)
{
    const double held = fmin(fmax(x, less == 0.0 ? -750.0 : -50.0), 710.0), n = rint(held * 1.44269504088896340736);
    const double high = held - n * 0x1.62e42fefp-1, low = n * 0x1.473de6af278edp-34; /* log 2 in two pieces */
    const double r = high - low, rest = (high - r) - low;
    const pair start = sum_of(1.0, -ldexp(less, -(int)n)), line = sum_of(start.high, r);
    const pair square = product_of(r, 0.5 * r), parabola = sum_of(line.high, square.high);
    const double lows = parabola.low + line.low + start.low + square.low + rest;
    double series = 0.0;
    int k;
    for (k = 14; k > 2; k--) {
        series = (series * r + 1.0) / k;
    }
    series *= square.high * r;
    return x != x ? x : ldexp(parabola.high + (lows + series), (int)n);
}

/* The angle, 0 to pi, of the vector (x, y) with y >= 0; x and y are finite, moderate in size, and not both 0. Computed as
 * atan(k / 8) + atan(t) with |t| <= 1/16. */
static double angle_of(pair y, double x)
{
    static const pair eighths[] = {
        {0.0, 0.0},
        {0x1.fd5ba9aac2f6ep-4, -0x1.cd37686760c17p-59},
        {0x1.f5b75f92c80ddp-3, 0x1.8ab6e3cf7afbdp-57},
        {0x1.6f61941e4def1p-2, -0x1.c63aae6f6e918p-56},
        {0x1.dac670561bb4fp-2, 0x1.a2b7f222f65e2p-56},
        {0x1.1e00babdefeb4p-1, -0x1.928df287a668fp-58},
        {0x1.4978fa3269ee1p-1, 0x1.2419a87f2a458p-56},
        {0x1.700a7c5784634p-1, -0x1.8c34d25aadef6p-56},
        {0x1.921fb54442d18p-1, 0x1.1a62633145c07p-55},
    };
    const pair flat = {fabs(x), 0.0};
    const int steep = y.high > flat.high;
    const pair small = steep ? flat : y, large = steep ? y : flat;
    const double k = rint(8.0 * (small.high / large.high)), c = 0.125 * k;
    const pair shadow = product_of(c, large.high), along = product_of(c, small.high);
    pair over = sum_of(small.high, -shadow.high), under = sum_of(large.high, along.high), t, angle;
    double z, bend;
    over.low += small.low - shadow.low - c * large.low;
    under.low += large.low + along.low + c * small.low;
    t = quotient_of(over, under);
    z = t.high * t.high;
    bend = t.high * z * (1 / 3.0 - z * (1 / 5.0 - z * (1 / 7.0 - z * (1 / 9.0 - z * (1 / 11.0 - z * (1 / 13.0))))));
    angle = sum_of(eighths[(int)k].high, t.high);
    angle.low += eighths[(int)k].low + (t.low - bend);
    if (steep || x < 0.0) { /* the angle is pi / 2 - or + `angle`, or pi - `angle` */
        const double eighth = steep ? 2.0 : 4.0, way = steep && x < 0.0 ? 1.0 : -1.0;
        const pair turned = sum_of(eighth * eighths[8].high, way * angle.high);
        angle.high = turned.high;
        angle.low = turned.low + (eighth * eighths[8].low + way * angle.low);
    }
    return angle.high + angle.low;
}

/* atan2(y, x); NaN if an argument is not finite. */
static double arc_tangent(double y, double x)
{
    const double largest = fmax(fabs(x), fabs(y));
    pair up = {fabs(y), 0.0};
    if (!(finite_number(x) && finite_number(y))) {
        return NAN;
    }
    if (up.high < 0x1p-60 * x) {
        return y / x;
    }
    if (largest == 0.0) {
        x = copysign(1.0, x);
    } else if (!(largest < 0x1p500 && largest > 0x1p-500)) {
        int exponent;
        frexp(largest, &exponent);
        x = ldexp(x, -exponent);
        up.high = ldexp(up.high, -exponent);
    }
    return copysign(angle_of(up, x), y);
}

/* acos(x); NaN outside -1...1. */
static double arc_cosine(double x)
{
    const pair square = product_of(x, x), left = sum_of(1.0, -square.high);
    const double root = sqrt(left.high);
    const pair back = product_of(root, root);
    pair y = {root, 0.0};
    if (!(fabs(x) <= 1.0)) {
        return NAN;
    }
    if (root > 0.0) {
        y.low = (((left.high - back.high) - back.low) + (left.low - square.low)) / (2.0 * root);
    }
    return angle_of(y, x);
}
