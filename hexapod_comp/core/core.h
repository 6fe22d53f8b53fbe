/* SPDX-License-Identifier: Apache-2.0
 *
 * What the files of the core share: constants and three-vectors. hexapod_comp.c takes them together as one unit, so
 * everything is static and the compiler sees through all calls; nothing but the functions of hexapod_comp.h is visible.
 */
#ifndef HEXAPOD_CORE_H
#define HEXAPOD_CORE_H

#include "hexapod_comp.h"

#include <math.h>
#include <stddef.h>

#define PI 3.14159265358979323846

#define STEP_TOLERANCE 1e-8    /* Newton stops after a shorter step, m and rad: its square is below rounding */
#define MAX_ITERATIONS 30
#define MAX_ROTATION_STEP 0.6  /* rad: a linearisation means nothing beyond */
#define CLOSURE 1e-13          /* m, what rounding may leave in the six loop closures ... */
#define CLOSURE_RELATIVE 1e-14 /* ... and its part relative to the lengths */
#define ROTATION_ROUNDING 1e-13
#define COPLANAR 1e-3          /* smaller volumes of three unit struts need pivoting */
#define SMALLEST_PIVOT 1e-14
#define LONGEST_RAMP_STEP 0.02 /* s */
#define AHEAD_BY_STAMP 5e-3    /* s of motion at the largest speed that a command may be ahead by its stamp ... */
#define AHEAD_BY_RECEIPT 8e-4  /* ... and by its receipt */
#define SHORTEST_PERIOD 1e-4   /* s */
#define SMOOTHED_OVER 0.02     /* s */
#define QUATERNION_TOLERANCE 1e-3
#define REFERENCE_TEMPERATURE 20.0
#define REFERENCE_HUMIDITY 0.5
#define LOWEST_HUMIDITY 0.01
#define SAME_PLACE 1e-5 /* m: nominal lengths that differ by no more are the same place, but for a controller's decimals */
#define LARGEST_GRAVITY 100.0 /* m/s2 */
#define LOWEST_TEMPERATURE (-40.0)
#define HIGHEST_TEMPERATURE 120.0
#define FIELD_ITERATIONS 50
#define COMMAND_ITERATIONS 8
#define SMALL_ANGLE (1.0 / 64.0) /* rad */
#define SLIDING 0.02 /* share of the motion below which a bearing turns too little to resist in full */
#define TURN_ITERATIONS 20 /* of lengths against what depends on the pose: turning screws, load */

/* What loops over lanes (lanes.c) call, and a loop of six in it: calls and loops would keep them from becoming vector code. */
#ifdef __GNUC__
#define INLINED static inline __attribute__((always_inline))
#else
#define INLINED static inline
#endif
#if defined(__GNUC__) && !defined(__clang__)
#define UNROLLED _Pragma("GCC unroll 6")
#else
#define UNROLLED
#endif

typedef struct { double x, y, z; } vec;
typedef struct { vec row[3]; } mat;

INLINED vec vector(double x, double y, double z) { return (vec){x, y, z}; }
INLINED vec row_of(const double a[3]) { return (vec){a[0], a[1], a[2]}; }
INLINED mat three_rows(const double r[3][3]) { return (mat){{row_of(r[0]), row_of(r[1]), row_of(r[2])}}; }

INLINED vec add(vec a, vec b) { return (vec){a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINED vec subtract(vec a, vec b) { return (vec){a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINED vec scale(double factor, vec a) { return (vec){factor * a.x, factor * a.y, factor * a.z}; }
INLINED vec cross(vec a, vec b) { return (vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
INLINED double dot(vec a, vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINED double norm(vec a) { return sqrt(dot(a, a)); }

/* k.x a + k.y b + k.z c */
INLINED vec combine(vec k, vec a, vec b, vec c)
{
    return vector(k.x * a.x + k.y * b.x + k.z * c.x, k.x * a.y + k.y * b.y + k.z * c.y, k.x * a.z + k.y * b.z + k.z * c.z);
}

INLINED vec combine_rows(vec k, const vec rows[3]) { return combine(k, rows[0], rows[1], rows[2]); }

/* The matrix times v: the dot products of three rows with it. */
INLINED vec times(const vec rows[3], vec v) { return vector(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v)); }

INLINED void store(vec v, double to[3])
{
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
}

INLINED void copy_six(const double from[6], double to[6])
{
    store(row_of(from), to);
    store(row_of(from + 3), to + 3);
}

static inline int finite_number(double a) { return a - a == 0.0; }

#endif
