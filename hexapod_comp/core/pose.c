/* SPDX-License-Identifier: Apache-2.0
 *
 * Rotations and poses. Equations: doc/theory.md, 2.
 */
#include "core.h"

/* _turned: the Cayley rotation of w times R, exp(w) to second order and exactly orthogonal */
INLINED mat turned(const mat *r, vec w)
{
    const double x = 0.5 * w.x, y = 0.5 * w.y, z = 0.5 * w.z;
    const double square = x * x + y * y + z * z;
    const double two = 2.0 / (1.0 + square);
    const double one = 0.5 * two * (1.0 - square);
    mat out;
    out.row[0] = combine_rows(vector(one + two * x * x, two * (x * y - z), two * (x * z + y)), r->row);
    out.row[1] = combine_rows(vector(two * (x * y + z), one + two * y * y, two * (y * z - x)), r->row);
    out.row[2] = combine_rows(vector(two * (x * z - y), two * (y * z + x), one + two * z * z), r->row);
    return out;
}

/* The rotation nearest to a nearly orthonormal matrix: one Newton step. */
INLINED mat straightened(const mat *r)
{
    const vec *g = r->row;
    const double g01 = dot(g[0], g[1]), g02 = dot(g[0], g[2]), g12 = dot(g[1], g[2]);
    mat out;
    out.row[0] = combine_rows(vector(1.5 - 0.5 * dot(g[0], g[0]), -0.5 * g01, -0.5 * g02), g);
    out.row[1] = combine_rows(vector(-0.5 * g01, 1.5 - 0.5 * dot(g[1], g[1]), -0.5 * g12), g);
    out.row[2] = combine_rows(vector(-0.5 * g02, -0.5 * g12, 1.5 - 0.5 * dot(g[2], g[2])), g);
    return out;
}

INLINED double rotation_error(const mat *r)
{
    const vec hand = subtract(cross(r->row[0], r->row[1]), r->row[2]);
    const double first = dot(r->row[0], r->row[0]) - 1.0, second = dot(r->row[1], r->row[1]) - 1.0;
    const double skew = dot(r->row[0], r->row[1]);
    return sqrt(dot(hand, hand) + first * first + second * second + skew * skew);
}

/* Replace R by exp(w) R. */
static void rotate(double r[3][3], double wx, double wy, double wz)
{
    const double square = wx * wx + wy * wy + wz * wz;
    double sine, versine;
    int j;
    if (square < 1e-12) {
        sine = 1.0 - square / 6.0;
        versine = 0.5 - square / 24.0;
    } else {
        const double angle = sqrt(square);
        double half, cosine;
        sine_cosine(0.5 * angle, &half, &cosine);
        sine = 2.0 * half * cosine / angle;
        versine = 2.0 * half * half / square;
    }
    for (j = 0; j < 3; j++) {
        const double x = r[0][j], y = r[1][j], z = r[2][j];
        const double cx = wy * z - wz * y, cy = wz * x - wx * z, cz = wx * y - wy * x;
        r[0][j] = x + sine * cx + versine * (wy * cz - wz * cy);
        r[1][j] = y + sine * cy + versine * (wz * cx - wx * cz);
        r[2][j] = z + sine * cz + versine * (wx * cy - wy * cx);
    }
}

static void orthonormalise(double r[3][3])
{
    const mat rows = three_rows((const double(*)[3])r);
    const mat out = straightened(&rows);
    int i;
    for (i = 0; i < 3; i++) {
        store(out.row[i], r[i]);
    }
}

/* compose: the pose product */
static hc_pose compose(const hc_pose *a, const hc_pose *b)
{
    hc_pose out;
    int i, j;
    for (i = 0; i < 3; i++) {
        out.position[i] = a->position[i] + a->rotation[i][0] * b->position[0] + a->rotation[i][1] * b->position[1]
                          + a->rotation[i][2] * b->position[2];
        for (j = 0; j < 3; j++) {
            out.rotation[i][j] = a->rotation[i][0] * b->rotation[0][j] + a->rotation[i][1] * b->rotation[1][j]
                                 + a->rotation[i][2] * b->rotation[2][j];
        }
    }
    return out;
}

/* A pose out of arrays: position, rotation matrix by rows. */
static inline hc_pose pose_of(const double *position, const double *rotation)
{
    hc_pose pose;
    int i, j;
    for (i = 0; i < 3; i++) {
        pose.position[i] = position[i];
        for (j = 0; j < 3; j++) {
            pose.rotation[i][j] = rotation[3 * i + j];
        }
    }
    return pose;
}

static inline void write_pose(const hc_pose *pose, double *position, double *rotation)
{
    int i, j;
    for (i = 0; i < 3; i++) {
        position[i] = pose->position[i];
        for (j = 0; j < 3; j++) {
            rotation[3 * i + j] = pose->rotation[i][j];
        }
    }
}

/* R o */
static vec lever(const hc_pose *pose, const double o[3])
{
    const mat r = three_rows(pose->rotation);
    const vec v = row_of(o);
    return vector(dot(r.row[0], v), dot(r.row[1], v), dot(r.row[2], v));
}

/* read_pose: a position and a quaternion as a pose */
static hc_status read_pose(const double n[7], hc_pose *pose)
{
    const double x = n[3], y = n[4], z = n[5], w = n[6];
    const double square = x * x + y * y + z * z + w * w;
    double s;
    if (!(finite_number(n[0]) && finite_number(n[1]) && finite_number(n[2]) && finite_number(square))) {
        return HC_NOT_FINITE;
    }
    if (fabs(sqrt(square) - 1.0) > QUATERNION_TOLERANCE) {
        return HC_QUATERNION;
    }
    s = 2.0 / square;
    store(row_of(n), pose->position);
    store(vector(1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)), pose->rotation[0]);
    store(vector(s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)), pose->rotation[1]);
    store(vector(s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)), pose->rotation[2]);
    return HC_OK;
}
