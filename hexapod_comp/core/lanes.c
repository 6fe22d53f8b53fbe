/* SPDX-License-Identifier: Apache-2.0
 *
 * Inverse and forward kinematics of many poses, eight at once, each in its own lane. Compilers turn the loops over lanes into
 * vector instructions. A lane does the same operations in the same order as kinematics.c for a single pose, so both give the
 * same bits. A lane that fails the checks of a solution is solved again with pivoting, which also finds the reason.
 */
#include "core.h"

#define LANES 8 /* one register of AVX-512, two of AVX2 */

/* A WIDE function is compiled for each of these instruction sets, and the processor's is chosen at run time; the arithmetic is
 * IEEE in all of them. */
#ifndef WIDE
#if defined(__GNUC__) && defined(__x86_64__) && defined(__GLIBC__)
#define WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define WIDE
#endif
#endif

/* In each lane a pose, its strut lengths, and the state of its solution. */
typedef struct {
    double position[3][LANES];
    double rotation[9][LANES];
    double lengths[6][LANES];
    double step[LANES];      /* size of the last Newton step, m and rad */
    double count[LANES];     /* number of Newton steps */
    double condition[LANES]; /* this and the next three: see `certificate` */
    double sign[LANES];
    double misfit[LANES];
    double flaw[LANES];
} lanes;

INLINED vec lane_position(const lanes *a, int n)
{
    return vector(a->position[0][n], a->position[1][n], a->position[2][n]);
}

INLINED mat lane_rotation(const lanes *a, int n)
{
    return (mat){{vector(a->rotation[0][n], a->rotation[1][n], a->rotation[2][n]),
                  vector(a->rotation[3][n], a->rotation[4][n], a->rotation[5][n]),
                  vector(a->rotation[6][n], a->rotation[7][n], a->rotation[8][n])}};
}

INLINED void store_lane(vec v, double to[3][LANES], int n)
{
    to[0][n] = v.x;
    to[1][n] = v.y;
    to[2][n] = v.z;
}

INLINED void set_lane(lanes *a, int n, vec p, const mat *r)
{
    store_lane(p, a->position, n);
    store_lane(r->row[0], a->rotation, n);
    store_lane(r->row[1], a->rotation + 3, n);
    store_lane(r->row[2], a->rotation + 6, n);
}

INLINED void lane_lengths(const lanes *a, int n, double lengths[6])
{
    UNROLLED
    for (int i = 0; i < 6; i++) {
        lengths[i] = a->lengths[i][n];
    }
}

/* a if `first`, else b. */
INLINED vec chosen(int first, vec a, vec b)
{
    return vector(first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z);
}

/* Write the strut lengths of each lane's pose. */
WIDE static void measure_lanes(const double base[6][3], const double platform[6][3], lanes *restrict a)
{
    for (int n = 0; n < LANES; n++) {
        const vec p = lane_position(a, n);
        const mat r = lane_rotation(a, n);
        UNROLLED
        for (int i = 0; i < 6; i++) {
            a->lengths[i][n] = norm(strut_between(row_of(base[i]), row_of(platform[i]), p, &r));
        }
    }
}

/* Take a Newton step in every lane that has not converged. */
WIDE static void step_lanes(const double base[6][3], const double platform[6][3], lanes *restrict a)
{
    for (int n = 0; n < LANES; n++) {
        const vec p = lane_position(a, n);
        const mat r = lane_rotation(a, n);
        const int moves = a->step[n] >= STEP_TOLERANCE;
        vec next = p;
        mat turned_on_to = r;
        double lengths[6];
        lane_lengths(a, n, lengths);
        const double step = newton_step(base, platform, lengths, &next, &turned_on_to);
        next = chosen(moves, next, p);
        turned_on_to.row[0] = chosen(moves, turned_on_to.row[0], r.row[0]);
        turned_on_to.row[1] = chosen(moves, turned_on_to.row[1], r.row[1]);
        turned_on_to.row[2] = chosen(moves, turned_on_to.row[2], r.row[2]);
        set_lane(a, n, next, &turned_on_to);
        a->step[n] = moves ? step : a->step[n];
        a->count[n] += moves ? 1.0 : 0.0;
    }
}

/* Make each lane's rotation orthonormal, and write the values by which the lane's solution is accepted. */
WIDE static void certify_lanes(const double base[6][3], const double platform[6][3], double characteristic_length,
                               lanes *restrict a)
{
    for (int n = 0; n < LANES; n++) {
        const vec p = lane_position(a, n);
        const mat turned_to = lane_rotation(a, n), r = straightened(&turned_to);
        double lengths[6];
        lane_lengths(a, n, lengths);
        const certificate found_here = certify(base, platform, lengths, p, &r, characteristic_length);
        set_lane(a, n, p, &r);
        a->condition[n] = found_here.condition;
        a->sign[n] = found_here.sign;
        a->misfit[n] = found_here.misfit;
        a->flaw[n] = found_here.flaw;
    }
}

static void fill_lane(lanes *a, int n, const double position[3], const double rotation[9])
{
    for (int k = 0; k < 3; k++) {
        a->position[k][n] = position[k];
    }
    for (int k = 0; k < 9; k++) {
        a->rotation[k][n] = rotation[k];
    }
}

/* Inverse kinematics: write the lengths |P + R t - b|. */
void hc_strut_lengths_many(const double *base, const double *platform, size_t count, const double *positions,
                      const double *rotations, double *lengths)
{
    const double(*b)[3] = (const double(*)[3])base, (*t)[3] = (const double(*)[3])platform;
    lanes a;
    for (size_t first = 0; first < count; first += LANES) {
        const int here = count - first < LANES ? (int)(count - first) : LANES;
        const double *p = positions + 3 * first, *r = rotations + 9 * first;
        for (int n = 0; n < LANES; n++) {
            const int row = n < here ? n : here - 1; /* unused lanes repeat the last pose */
            fill_lane(&a, n, p + 3 * row, r + 9 * row);
        }
        measure_lanes(b, t, &a);
        for (int n = 0; n < here; n++) {
            lane_lengths(&a, n, lengths + 6 * (first + (size_t)n));
        }
    }
}

/* Take Newton steps until all lanes have converged or reached MAX_ITERATIONS. */
static void iterate_lanes(const double base[6][3], const double platform[6][3], lanes *a)
{
    int moving = 1;
    while (moving) {
        step_lanes(base, platform, a);
        moving = 0;
        for (int n = 0; n < LANES; n++) {
            moving = moving || (a->step[n] >= STEP_TOLERANCE && a->count[n] < MAX_ITERATIONS);
        }
    }
}

/* Forward kinematics: Newton from the given poses, which the solutions overwrite. A solution must have a condition number of at
 * most `largest_condition`, and det J of the sign `home_sign`; 0 accepts both. Writes `outcomes`, hc_status, and `conditions`,
 * NaN if not computed. */
void hc_solve_pose_many(const double *base, const double *platform, size_t count, const double *lengths, double *positions,
                        double *rotations, double characteristic_length, double home_sign, double largest_condition,
                        int *outcomes, int *iterations, double *conditions)
{
    const double(*b)[3] = (const double(*)[3])base, (*t)[3] = (const double(*)[3])platform;
    const judge by = {characteristic_length, home_sign, largest_condition};
    lanes a;
    for (size_t first = 0; first < count; first += LANES) {
        const int here = count - first < LANES ? (int)(count - first) : LANES;
        for (int n = 0; n < LANES; n++) {
            const size_t row = first + (size_t)(n < here ? n : here - 1);
            fill_lane(&a, n, positions + 3 * row, rotations + 9 * row);
            for (int i = 0; i < 6; i++) {
                a.lengths[i][n] = lengths[6 * row + (size_t)i];
            }
            a.step[n] = HUGE_VAL;
            a.count[n] = 0.0;
        }
        iterate_lanes(b, t, &a);
        certify_lanes(b, t, characteristic_length, &a);
        for (int n = 0; n < here; n++) {
            const size_t row = first + (size_t)n;
            const certificate c = {a.condition[n], a.sign[n], a.misfit[n], a.flaw[n]};
            hc_pose pose = pose_of(positions + 3 * row, rotations + 9 * row);
            solution found_here = {HC_OK, (int)a.count[n], c.condition};
            if (certified(&c, a.step[n], lengths + 6 * row, &by)) {
                const mat r = lane_rotation(&a, n);
                store(lane_position(&a, n), pose.position);
                set_rotation(pose.rotation, &r);
            } else {
                found_here = solve_carefully(b, t, lengths + 6 * row, &by, &pose);
            }
            write_pose(&pose, positions + 3 * row, rotations + 9 * row); /* without a solution: the guess */
            outcomes[row] = (int)found_here.status;
            iterations[row] = found_here.iterations;
            conditions[row] = found_here.condition;
        }
    }
}
