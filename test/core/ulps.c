/* SPDX-License-Identifier: Apache-2.0
 *
 * Compare the core's elementary functions with the C library's in long double, whose 64 bits make the reference exact to less
 * than a thousandth of a unit in the last place. Print the largest error of each function, in units in the last place.
 */
#include "elementary.c" /* of the core */

#include <float.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double EDGES[] = {0.0, 0x1p-1074, 1e-310, DBL_MIN, 0x1p-600, 0x1p-500, 1e-100, 1e-20, 1e-8, 1e-3, 0.0625, 0.1875,
                               0.25, 0.5, 0.7071067811865476, 0.78539816339744828, 0.99, 1.0, 1.5707963267948966, 1.9, 2.0,
                               3.1415926535897931, 10.0, 22.0, 355.0, 710.0, 745.0, 103993.0, 1e6, 1638399.0, 1e20, 0x1p500,
                               0x1p600, 1e308, DBL_MAX};
#define EDGE_COUNT ((int)(sizeof EDGES / sizeof EDGES[0]))

static unsigned long long seed = 1;

static double uniform(void)
{
    seed = seed * 6364136223846793005ULL + 1442695040888963407ULL;
    return (double)(seed >> 11) * 0x1p-53;
}

/* A finite number of any size and sign. */
static double any_number(void)
{
    return (uniform() < 0.5 ? -1.0 : 1.0) * ldexp(1.0 + uniform(), (int)(2040.0 * uniform()) - 1020);
}

static void note(double got, long double right, double *worst)
{
    const double nearest = (double)right, magnitude = fabs(nearest);
    double unit = nextafter(magnitude, HUGE_VAL) - magnitude, error;
    if (magnitude == HUGE_VAL || nearest != nearest) {
        error = got == nearest || (got != got && nearest != nearest) ? 0.0 : HUGE_VAL;
    } else {
        error = (double)(fabsl((long double)got - right) / (long double)unit);
        error = nearest == 0.0 && signbit(got) != signbit(nearest) ? HUGE_VAL : error;
    }
    if (!(error <= *worst)) {
        *worst = error;
    }
}

static double worst[6];

static void sine_at(double x)
{
    double s, c;
    sine_cosine(x, &s, &c);
    note(s, sinl((long double)x), &worst[0]);
    note(c, cosl((long double)x), &worst[1]);
}

static void exponential_at(double x)
{
    note(exponential(x, 0.0), expl((long double)x), &worst[2]);
    note(exponential(x, 1.0), expm1l((long double)x), &worst[5]);
}

static void angle_at(double y, double x)
{
    note(arc_tangent(y, x), atan2l((long double)y, (long double)x), &worst[3]);
}

static void arc_cosine_at(double x)
{
    note(arc_cosine(x), acosl((long double)x), &worst[4]);
}

int main(int count_of_words, char **words)
{
    const long count = count_of_words > 1 ? atol(words[1]) : 1000000;
    long n;
    int i, j;
    for (i = -EDGE_COUNT + 1; i < EDGE_COUNT; i++) {
        const double x = i < 0 ? -EDGES[-i] : EDGES[i];
        if (fabs(x) < 0x1.9p+20) {
            sine_at(x);
        }
        exponential_at(x);
        arc_cosine_at(x);
        arc_cosine_at(nextafter(x, 0.0));
        for (j = -EDGE_COUNT + 1; j < EDGE_COUNT; j++) {
            const double y = j < 0 ? -EDGES[-j] : EDGES[j];
            angle_at(y, x);
            angle_at(nextafter(y, HUGE_VAL), x);
            angle_at(y, -0.0);
            angle_at(-0.0, x);
        }
    }
    for (n = 0; n < count; n++) {
        const double near = rint(1e6 * uniform()) * 1.5707963267948966; /* multiples of pi / 2: the hardest */
        const double radius = ldexp(1.0, (int)(40.0 * uniform())), angle = 7.0 * uniform();
        sine_at(4.0 * uniform() - 2.0);
        sine_at(0x1.9p+20 * (2.0 * uniform() - 1.0));
        sine_at(near);
        sine_at(ldexp(uniform(), (int)(-1000.0 * uniform())));
        exponential_at(2.0 * uniform() - 1.0);
        exponential_at(100.0 * uniform() - 60.0);
        exponential_at(ldexp(uniform(), (int)(-60.0 * uniform())));
        exponential_at(1500.0 * uniform() - 750.0);
        angle_at(2.0 * uniform() - 1.0, 2.0 * uniform() - 1.0);
        angle_at(radius * sin(angle), radius * cos(angle));
        angle_at(any_number(), any_number());
        arc_cosine_at(2.0 * uniform() - 1.0);
        arc_cosine_at(1.0 - ldexp(uniform(), (int)(-52.0 * uniform())));
    }
    {
        double s, c;
        sine_cosine(NAN, &s, &c);
        sine_cosine(s == s ? NAN : HUGE_VAL, &s, &c);
        if (s == s || c == c || exponential(NAN, 0.0) == 0.0 || arc_tangent(NAN, 1.0) == 0.0 || arc_cosine(NAN) == 0.0) {
            return 1;
        }
        sine_cosine(DBL_MAX, &s, &c);
        if (!(fabs(s * s + c * c - 1.0) < 1e-15)) {
            return 1;
        }
    }
    printf("%.3f %.3f %.3f %.3f %.3f %.3f\n", worst[0], worst[1], worst[2], worst[3], worst[4], worst[5]);
    return 0;
}
