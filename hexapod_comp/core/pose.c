/* SPDX-License-Identifier: Apache-2.0
 *
 * Rotations and poses. Equations: doc/theory.md, 2.
 */
#include "core.h"

/* The Cayley rotation of w times R: equal to exp(w) R up to second order in w, and exactly orthogonal. */
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

/* The rotation nearest to a nearly orthonormal matrix, by one Newton step. */
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

/* Deviation of a matrix from a right-handed orthonormal one. */
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
    const vec w = vector(wx, wy, wz);
    const double square = dot(w, w);
    double sine = 1.0, versine = 0.5; /* below 1e-6, with errors of the rotation below 2e-19 */
    if (square >= 1e-12) {
        const double angle = sqrt(square);
        double half, cosine;
        sine_cosine(0.5 * angle, &half, &cosine);
        sine = 2.0 * half * cosine / angle;
        versine = 2.0 * half * half / square;
    }
    for (int j = 0; j < 3; j++) {
        const vec column = vector(r[0][j], r[1][j], r[2][j]), once = cross(w, column), twice = cross(w, once);
        const vec out = add(add(column, scale(sine, once)), scale(versine, twice));
        r[0][j] = out.x;
        r[1][j] = out.y;
        r[2][j] = out.z;
    }
}

static void set_rotation(double r[3][3], const mat *to)
{
    for (int i = 0; i < 3; i++) {
        store(to->row[i], r[i]);
    }
}

static void orthonormalise(double r[3][3])
{
    const mat rows = three_rows((const double(*)[3])r), out = straightened(&rows);
    set_rotation(r, &out);
}

/* The pose product a o b. */
static hc_pose compose(const hc_pose *a, const hc_pose *b)
{
    const mat rows = three_rows(b->rotation);
    hc_pose out;
    for (int i = 0; i < 3; i++) {
        const double *r = a->rotation[i], *p = b->position;
        out.position[i] = a->position[i] + r[0] * p[0] + r[1] * p[1] + r[2] * p[2];
        store(combine_rows(row_of(r), rows.row), out.rotation[i]);
    }
    return out;
}

/* The pose of two arrays: position, and rotation matrix by rows. */
static inline hc_pose pose_of(const double *position, const double *rotation)
{
    hc_pose pose;
    store(row_of(position), pose.position);
    for (int i = 0; i < 3; i++) {
        store(row_of(rotation + 3 * i), pose.rotation[i]);
    }
    return pose;
}

static inline void write_pose(const hc_pose *pose, double *position, double *rotation)
{
    store(row_of(pose->position), position);
    for (int i = 0; i < 3; i++) {
        store(row_of(pose->rotation[i]), rotation + 3 * i);
    }
}

/* R o: the vector o of the platform's frame, expressed in `base`. */
static vec lever(const hc_pose *pose, const double o[3])
{
    const mat r = three_rows(pose->rotation);
    return times(r.row, row_of(o));
}

/* Position in `base` of a point of the platform. */
static vec point_at(const hc_pose *pose, const double point[3])
{
    return add(row_of(pose->position), lever(pose, point));
}

/* Convert position and quaternion to a pose. */
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
