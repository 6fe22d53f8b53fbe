/* SPDX-License-Identifier: Apache-2.0
 *
 * Constants and three-vectors for all files of the core. hexapod_comp.c includes the files as one unit, so all functions
 * are static and can be inlined; only the functions of hexapod_comp.h are visible outside.
 */
#ifndef HEXAPOD_CORE_H
#define HEXAPOD_CORE_H

#include "hexapod_comp.h"

#include <math.h>
#include <stddef.h>

#define PI 3.14159265358979323846

#define STEP_TOLERANCE 1e-8    /* Newton ends after a shorter step than this, m and rad; its error is about the step's square */
#define MAX_ITERATIONS 30      /* of Newton's method in forward kinematics */
#define MAX_ROTATION_STEP 0.6  /* largest turn in one Newton step, rad */
#define CLOSURE 1e-13          /* largest misfit of the six loop closures that counts as rounding: this, m, ... */
#define CLOSURE_RELATIVE 1e-14 /* ... plus this share of the strut lengths */
#define ROTATION_ROUNDING 1e-13 /* largest deviation of a rotation matrix from orthonormality by rounding */
#define COPLANAR 1e-3          /* determinant of three unit strut vectors below which the elimination uses pivoting */
#define SMALLEST_PIVOT 1e-14   /* a matrix with a smaller pivot counts as singular */
#define LONGEST_RAMP_STEP 0.02 /* longest time since the last command that a ramp of the correction counts, s */
#define AHEAD_BY_STAMP 5e-3    /* time, s, by which a strut may be ahead of a motion at the speed limit: by the stamps ... */
#define AHEAD_BY_RECEIPT 8e-4  /* ... and by the times of receipt of the commands */
#define SHORTEST_PERIOD 1e-4   /* s; in the check of the acceleration, a shorter time between commands counts as this time */
#define SMOOTHED_OVER 0.02     /* time constant of the smoothed strut speed, s */
#define QUATERNION_TOLERANCE 1e-3 /* largest deviation of a quaternion's norm from 1 */
#define REFERENCE_TEMPERATURE 20.0 /* degrees Celsius; geometry and model state lengths at this temperature */
#define REFERENCE_HUMIDITY 0.5     /* relative humidity at which geometry and model state lengths */
#define LOWEST_HUMIDITY 0.01
#define SAME_PLACE 1e-5 /* m: nominal lengths that differ by at most this count as equal, as controllers round commands */
#define LARGEST_GRAVITY 100.0 /* m/s2 */
#define LOWEST_TEMPERATURE (-40.0) /* degrees Celsius */
#define HIGHEST_TEMPERATURE 120.0  /* degrees Celsius */
#define FIELD_ITERATIONS 50   /* most iterations to undo the field */
#define COMMAND_ITERATIONS 8  /* most Newton steps from a strut's length to its command */
#define SMALL_ANGLE (1.0 / 64.0) /* rad; a smaller change of a screw's angle updates its sine and cosine by Taylor series */
#define SLIDING 0.02 /* a bearing that turns by less than this share of the platform's motion has less than full friction */
#define TURN_ITERATIONS 20 /* most iterations of the forward model: screw rotation and load depend on the pose that is sought */

/* The loops over lanes (lanes.c) call INLINED functions, which contain UNROLLED loops of six: so the compiler can make vector
 * code of the loops over lanes. */
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

/* The matrix with these rows, times v. */
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
