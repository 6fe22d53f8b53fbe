/* SPDX-License-Identifier: Apache-2.0
 *
 * See hexapod_comp.h. Each function does what the function of its name in hexapod_comp/kernels does, operation by
 * operation and in the same order, so that both give the same digits; where that name differs it is given.
 * A test holds the two together.
 */
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
#define LOWEST_TEMPERATURE (-40.0)
#define HIGHEST_TEMPERATURE 120.0
#define FIELD_ITERATIONS 50
#define COMMAND_ITERATIONS 8
#define SMALL_ANGLE (1.0 / 64.0) /* rad */
#define LEAD_ITERATIONS 20

/* ---- Three-vectors: kernels/linalg.py ------------------------------------------------------------------------ */

typedef struct {
    double x, y, z;
} vec;

typedef struct {
    vec row[3];
} mat;

static inline vec vector(double x, double y, double z)
{
    vec v;
    v.x = x;
    v.y = y;
    v.z = z;
    return v;
}

static inline vec row_of(const double a[3])
{
    return vector(a[0], a[1], a[2]);
}

static inline mat three_rows(const double r[3][3])
{
    mat m;
    m.row[0] = row_of(r[0]);
    m.row[1] = row_of(r[1]);
    m.row[2] = row_of(r[2]);
    return m;
}

static inline double dot(vec a, vec b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline double norm(vec a)
{
    return sqrt(dot(a, a));
}

static inline vec cross(vec a, vec b)
{
    return vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

static inline vec add(vec a, vec b)
{
    return vector(a.x + b.x, a.y + b.y, a.z + b.z);
}

static inline vec subtract(vec a, vec b)
{
    return vector(a.x - b.x, a.y - b.y, a.z - b.z);
}

static inline vec scale(double factor, vec a)
{
    return vector(factor * a.x, factor * a.y, factor * a.z);
}

/* k.x a + k.y b + k.z c */
static inline vec combine(vec k, vec a, vec b, vec c)
{
    return vector(k.x * a.x + k.y * b.x + k.z * c.x, k.x * a.y + k.y * b.y + k.z * c.y,
                  k.x * a.z + k.y * b.z + k.z * c.z);
}

static inline vec combine_rows(vec k, const vec rows[3])
{
    return combine(k, rows[0], rows[1], rows[2]);
}

static inline void store(vec v, double to[3])
{
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
}

static int finite_number(double a)
{
    return a - a == 0.0;
}

/* ---- Six rows of a machine's Jacobian: kernels/lanes.py ------------------------------------------------------- */

typedef struct {
    vec strut[6];
    vec moment[6];
    double length[6];
} six_struts;

/* Factors of the 6 x 6 matrix with rows (strut, moment), by blocks of three rows. */
typedef struct {
    vec upper[3]; /* columns of the inverse of rows 0, 2, 4 */
    vec ratio[3]; /* rows 1, 3, 5 times that inverse */
    vec lower[3]; /* columns of the inverse of what is left of rows 1, 3, 5 */
    double determinant_upper, determinant_lower;
} blocks;

static inline vec strut_between(vec b, vec t, vec p, const mat *r)
{
    return vector(p.x + r->row[0].x * t.x + r->row[0].y * t.y + r->row[0].z * t.z - b.x,
                  p.y + r->row[1].x * t.x + r->row[1].y * t.y + r->row[1].z * t.z - b.y,
                  p.z + r->row[2].x * t.x + r->row[2].y * t.y + r->row[2].z * t.z - b.z);
}

static six_struts struts_at(const double base[6][3], const double platform[6][3], vec p, const mat *r)
{
    six_struts all;
    int i;
    for (i = 0; i < 6; i++) {
        const vec t = row_of(platform[i]);
        all.strut[i] = strut_between(row_of(base[i]), t, p, r);
        all.moment[i] = cross(vector(dot(r->row[0], t), dot(r->row[1], t), dot(r->row[2], t)), all.strut[i]);
        all.length[i] = norm(all.strut[i]);
    }
    return all;
}

static inline double inverse_columns(vec a, vec b, vec c, vec columns[3])
{
    const vec first = cross(b, c);
    const double determinant = dot(a, first);
    const double factor = 1.0 / determinant;
    columns[0] = scale(factor, first);
    columns[1] = scale(factor, cross(c, a));
    columns[2] = scale(factor, cross(a, b));
    return determinant;
}

static blocks eliminate(const vec s[6], const vec m[6])
{
    blocks f;
    vec left[3];
    int k;
    f.determinant_upper = inverse_columns(s[0], s[2], s[4], f.upper);
    for (k = 0; k < 3; k++) {
        const vec row = s[2 * k + 1];
        f.ratio[k] = vector(dot(row, f.upper[0]), dot(row, f.upper[1]), dot(row, f.upper[2]));
        left[k] = subtract(m[2 * k + 1], combine(f.ratio[k], m[0], m[2], m[4]));
    }
    f.determinant_lower = inverse_columns(left[0], left[1], left[2], f.lower);
    return f;
}

/* Solve with the factors: s_i v + m_i w = f_i. */
static void substitute(const vec m[6], const blocks *f, const double right[6], vec *v, vec *w)
{
    const vec even = vector(right[0], right[2], right[4]);
    const vec carried = vector(dot(f->ratio[0], even), dot(f->ratio[1], even), dot(f->ratio[2], even));
    const vec reduced = subtract(vector(right[1], right[3], right[5]), carried);
    vec rest;
    *w = combine_rows(reduced, f->lower);
    rest = subtract(even, vector(dot(m[0], *w), dot(m[2], *w), dot(m[4], *w)));
    *v = combine_rows(rest, f->upper);
}

/* _column_square: one column of the inverse, squared, its sign left aside */
static inline double column_square(const vec m[6], const blocks *f, vec v, vec w, double square)
{
    const vec rest = combine_rows(vector(dot(m[0], w), dot(m[2], w), dot(m[4], w)), f->upper);
    v = add(v, rest);
    return dot(v, v) + square * dot(w, w);
}

/* Condition number and sign of det J; sign 0 where pivoting is needed. */
static double block_condition(const six_struts *now, double characteristic_length, double *sign)
{
    const double square = characteristic_length * characteristic_length;
    const blocks f = eliminate(now->strut, now->moment);
    const vec zero = vector(0.0, 0.0, 0.0);
    const double *l = now->length;
    const vec *a = f.ratio;
    const vec column[3] = {{a[0].x, a[1].x, a[2].x}, {a[0].y, a[1].y, a[2].y}, {a[0].z, a[1].z, a[2].z}};
    double inverse = 0.0, moments = 0.0, condition;
    int k;
    for (k = 0; k < 6; k++) {
        const vec w = k % 2 ? f.lower[k / 2] : combine_rows(column[k / 2], f.lower);
        const vec v = k % 2 ? zero : f.upper[k / 2];
        inverse += l[k] * l[k] * column_square(now->moment, &f, v, w, square);
        moments += dot(now->moment[k], now->moment[k]) / (l[k] * l[k]);
    }
    condition = sqrt((6.0 + moments / square) * inverse) / 6.0;
    *sign = f.determinant_upper * f.determinant_lower > 0.0 ? -1.0 : 1.0;
    if (!(fabs(f.determinant_upper) >= COPLANAR * l[0] * l[2] * l[4] && condition < HUGE_VAL)) {
        *sign = 0.0;
    }
    return condition;
}

/* _turned: the Cayley rotation of w times R, exp(w) to second order and exactly orthogonal */
static mat turned(const mat *r, vec w)
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
static mat straightened(const mat *r)
{
    const vec *g = r->row;
    const double g01 = dot(g[0], g[1]), g02 = dot(g[0], g[2]), g12 = dot(g[1], g[2]);
    mat out;
    out.row[0] = combine_rows(vector(1.5 - 0.5 * dot(g[0], g[0]), -0.5 * g01, -0.5 * g02), g);
    out.row[1] = combine_rows(vector(-0.5 * g01, 1.5 - 0.5 * dot(g[1], g[1]), -0.5 * g12), g);
    out.row[2] = combine_rows(vector(-0.5 * g02, -0.5 * g12, 1.5 - 0.5 * dot(g[2], g[2])), g);
    return out;
}

/* Squared misfit of six lengths in units of what rounding may leave. */
static double closure_error(const double now[6], const double wanted[6])
{
    const vec first = row_of(now), second = row_of(now + 3);
    const vec a = subtract(first, row_of(wanted)), b = subtract(second, row_of(wanted + 3));
    const double allowed = CLOSURE * CLOSURE
                           + CLOSURE_RELATIVE * CLOSURE_RELATIVE * (dot(first, first) + dot(second, second));
    return (dot(a, a) + dot(b, b)) / allowed;
}

static double rotation_error(const mat *r)
{
    const vec hand = subtract(cross(r->row[0], r->row[1]), r->row[2]);
    const double first = dot(r->row[0], r->row[0]) - 1.0, second = dot(r->row[1], r->row[1]) - 1.0;
    const double skew = dot(r->row[0], r->row[1]);
    return sqrt(dot(hand, hand) + first * first + second * second + skew * skew);
}

/* ---- Kinematics: kernels/kinematics.py ------------------------------------------------------------------------ */

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
        const double angle = sqrt(square), half = sin(0.5 * angle);
        sine = sin(angle) / angle;
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

/* _jacobian_row: write row i, return the strut's length */
static double jacobian_row(const double base[3], const double position[3], vec s, double row[6])
{
    const double length = sqrt(s.x * s.x + s.y * s.y + s.z * s.z);
    const double ux = s.x / length, uy = s.y / length, uz = s.z / length;
    const double rx = s.x + base[0] - position[0];
    const double ry = s.y + base[1] - position[1];
    const double rz = s.z + base[2] - position[2];
    row[0] = ux;
    row[1] = uy;
    row[2] = uz;
    row[3] = ry * uz - rz * uy;
    row[4] = rz * ux - rx * uz;
    row[5] = rx * uy - ry * ux;
    return length;
}

/* Solve a 6 x 6 system in place with pivoting; return the sign of the determinant, 0 for a singular matrix. */
static double solve_six(double a[6][6], double right[6])
{
    double sign = 1.0;
    int i, j, k;
    for (k = 0; k < 6; k++) {
        int pivot = k;
        double value, inverse;
        for (i = k + 1; i < 6; i++) {
            if (fabs(a[i][k]) > fabs(a[pivot][k])) {
                pivot = i;
            }
        }
        value = a[pivot][k];
        if (!(fabs(value) > SMALLEST_PIVOT)) {
            return 0.0;
        }
        if (pivot != k) {
            const double kept = right[k];
            sign = -sign;
            right[k] = right[pivot];
            right[pivot] = kept;
            for (j = k; j < 6; j++) {
                const double element = a[k][j];
                a[k][j] = a[pivot][j];
                a[pivot][j] = element;
            }
        }
        if (value < 0.0) {
            sign = -sign;
        }
        inverse = 1.0 / value;
        for (i = k + 1; i < 6; i++) {
            const double factor = a[i][k] * inverse;
            for (j = k + 1; j < 6; j++) {
                a[i][j] -= factor * a[k][j];
            }
            right[i] -= factor * right[k];
        }
    }
    for (k = 5; k >= 0; k--) {
        double total = right[k];
        for (j = k + 1; j < 6; j++) {
            total -= a[k][j] * right[j];
        }
        right[k] = total / a[k][k];
    }
    return sign;
}

static double frobenius_condition(double a[6][6], double *sign)
{
    double square = 0.0, inverse_square = 0.0;
    int i, j, k;
    *sign = 0.0;
    for (k = 0; k < 6; k++) {
        double factors[6][6], column[6];
        for (i = 0; i < 6; i++) {
            column[i] = i == k ? 1.0 : 0.0;
            square += a[i][k] * a[i][k];
            for (j = 0; j < 6; j++) {
                factors[i][j] = a[i][j];
            }
        }
        *sign = solve_six(factors, column);
        for (i = 0; i < 6; i++) {
            inverse_square += column[i] * column[i];
        }
    }
    if (*sign == 0.0 || !(square * inverse_square < HUGE_VAL)) {
        *sign = 0.0;
        return HUGE_VAL;
    }
    return sqrt(square * inverse_square) / 6.0;
}

static six_struts struts_of(const double base[6][3], const double platform[6][3], const hc_pose *pose)
{
    const mat r = three_rows(pose->rotation);
    return struts_at(base, platform, row_of(pose->position), &r);
}

/* condition_one: Frobenius condition number at a pose, rotations scaled by the characteristic length */
static double condition_at(const double base[6][3], const hc_pose *pose, const six_struts *now,
                           double characteristic_length, double *sign)
{
    const double condition = block_condition(now, characteristic_length, sign);
    double jacobian[6][6];
    int i, j;
    if (*sign != 0.0) {
        return condition;
    }
    for (i = 0; i < 6; i++) {
        jacobian_row(base[i], pose->position, now->strut[i], jacobian[i]);
        for (j = 3; j < 6; j++) {
            jacobian[i][j] /= characteristic_length;
        }
    }
    return frobenius_condition(jacobian, sign);
}

/* lengths_possible: whether every pair of struts can close its triangle */
static int lengths_possible(const double base[6][3], const double platform[6][3], const double lengths[6])
{
    int i, j;
    for (i = 0; i < 6; i++) {
        for (j = 0; j < i; j++) {
            const double on_base = norm(subtract(row_of(base[i]), row_of(base[j])));
            const double on_platform = norm(subtract(row_of(platform[i]), row_of(platform[j])));
            const double slack = 1e-12 * (on_base + on_platform);
            if (fabs(lengths[i] - lengths[j]) > on_base + on_platform + slack
                || lengths[i] + lengths[j] < fabs(on_base - on_platform) - slack) {
                return 0;
            }
        }
    }
    return 1;
}

/* _closes: a certificate that does not depend on the iteration */
static int closes(const six_struts *now, const mat *r, const double lengths[6])
{
    return closure_error(now->length, lengths) <= 1.0 && rotation_error(r) <= ROTATION_ROUNDING;
}

/* _newton, with pivoting */
static hc_status newton(const double base[6][3], const double platform[6][3], const double lengths[6], hc_pose *pose)
{
    double jacobian[6][6], step[6];
    int iteration, i, k;
    for (iteration = 0; iteration < MAX_ITERATIONS; iteration++) {
        const six_struts now = struts_of(base, platform, pose);
        double turn, shrink, size;
        for (i = 0; i < 6; i++) {
            step[i] = lengths[i] - jacobian_row(base[i], pose->position, now.strut[i], jacobian[i]);
        }
        if (solve_six(jacobian, step) == 0.0) {
            return HC_SINGULAR;
        }
        turn = sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5]);
        if (!(turn < HUGE_VAL)) {
            return HC_SINGULAR;
        }
        shrink = turn <= MAX_ROTATION_STEP ? 1.0 : MAX_ROTATION_STEP / turn;
        size = turn;
        for (k = 0; k < 3; k++) {
            pose->position[k] += shrink * step[k];
            size = fmax(size, fabs(step[k]));
        }
        rotate(pose->rotation, shrink * step[3], shrink * step[4], shrink * step[5]);
        if (size < STEP_TOLERANCE) {
            mat r;
            six_struts settled;
            orthonormalise(pose->rotation);
            r = three_rows((const double(*)[3])pose->rotation);
            settled = struts_at(base, platform, row_of(pose->position), &r);
            return closes(&settled, &r, lengths) ? HC_OK : HC_NOT_CONVERGED;
        }
    }
    return HC_NOT_CONVERGED;
}

/* _usable: finite lengths above zero and a finite guess */
static int usable(const double lengths[6], const hc_pose *guess)
{
    int i, j;
    for (i = 0; i < 6; i++) {
        if (!(lengths[i] > 0.0 && lengths[i] < HUGE_VAL)) {
            return 0;
        }
    }
    for (i = 0; i < 3; i++) {
        if (!finite_number(guess->position[i])) {
            return 0;
        }
        for (j = 0; j < 3; j++) {
            if (!finite_number(guess->rotation[i][j])) {
                return 0;
            }
        }
    }
    return 1;
}

/* _solve_carefully: with pivoting, and with the reason of a failure */
static hc_status solve_carefully(const double base[6][3], const double platform[6][3], const double lengths[6],
                                 const hc_limits *limits, hc_pose *pose, double *condition)
{
    hc_pose trial = *pose;
    six_struts now;
    hc_status outcome;
    double sign;
    *condition = NAN;
    if (!usable(lengths, pose)) {
        return HC_NOT_FINITE;
    }
    if (!lengths_possible(base, platform, lengths)) {
        return HC_UNREACHABLE;
    }
    orthonormalise(trial.rotation);
    outcome = newton(base, platform, lengths, &trial);
    if (outcome != HC_OK) {
        return outcome;
    }
    now = struts_of(base, platform, &trial);
    *condition = condition_at(base, &trial, &now, limits->characteristic_length, &sign);
    if (!(*condition <= limits->condition)) {
        return HC_SINGULAR;
    }
    if (limits->home_sign != 0.0 && sign != limits->home_sign) {
        return HC_OTHER_ASSEMBLY;
    }
    *pose = trial;
    return HC_OK;
}

/* solve_pose_one: the six loop closures by Newton from a guess, which is overwritten only by a solution */
static hc_status solve_pose(const double base[6][3], const double platform[6][3], const double lengths[6],
                            const hc_limits *limits, hc_pose *pose, double *condition)
{
    vec p = row_of(pose->position);
    mat r = three_rows((const double(*)[3])pose->rotation);
    double step = HUGE_VAL, sign;
    six_struts now;
    int count, i, positive = 1;
    for (count = 0; step >= STEP_TOLERANCE && count < MAX_ITERATIONS; count++) {
        double misfit[6], ratio, shrink;
        blocks f;
        vec v, w;
        now = struts_at(base, platform, p, &r);
        for (i = 0; i < 6; i++) {
            misfit[i] = now.length[i] * (lengths[i] - now.length[i]);
        }
        f = eliminate(now.strut, now.moment);
        substitute(now.moment, &f, misfit, &v, &w);
        ratio = MAX_ROTATION_STEP / norm(w);
        shrink = ratio >= 1.0 ? 1.0 : ratio;
        step = sqrt(dot(v, v) + dot(w, w));
        p = add(p, scale(shrink, v));
        r = turned(&r, scale(shrink, w));
    }
    r = straightened(&r);
    now = struts_at(base, platform, p, &r);
    *condition = block_condition(&now, limits->characteristic_length, &sign);
    for (i = 0; i < 6; i++) {
        positive = positive && lengths[i] > 0.0;
    }
    if (step < STEP_TOLERANCE && positive && closes(&now, &r, lengths) && *condition <= limits->condition
        && (sign * limits->home_sign > 0.0 || (limits->home_sign == 0.0 && sign != 0.0))) {
        store(p, pose->position);
        for (i = 0; i < 3; i++) {
            store(r.row[i], pose->rotation[i]);
        }
        return HC_OK;
    }
    return solve_carefully(base, platform, lengths, limits, pose, condition);
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

/* R o */
static vec lever(const hc_pose *pose, const double o[3])
{
    const mat r = three_rows(pose->rotation);
    const vec v = row_of(o);
    return vector(dot(r.row[0], v), dot(r.row[1], v), dot(r.row[2], v));
}

/* ---- Limits: kernels/limits.py -------------------------------------------------------------------------------- */

/* What was found, and of what. */
typedef struct {
    hc_status status;
    int strut;
    double value;
} finding;

static finding found(hc_status status, int strut, double value)
{
    finding f;
    f.status = status;
    f.strut = strut;
    f.value = value;
    return f;
}

static double held(double value, double low, double high)
{
    return fmax(low, fmin(high, value));
}

/* _share: a quotient held within 0...1; 0 where there is nothing to divide by */
static double share_of(double part, double whole)
{
    return whole > 0.0 ? held(part / whole, 0.0, 1.0) : 0.0;
}

static double segment_distance(const double a[3], const double b[3], const double c[3], const double d[3])
{
    double uu = 0.0, uv = 0.0, vv = 0.0, uw = 0.0, vw = 0.0, determinant, s, t, square = 0.0;
    int k;
    for (k = 0; k < 3; k++) {
        const double u = b[k] - a[k], v = d[k] - c[k], w = a[k] - c[k];
        uu += u * u;
        uv += u * v;
        vv += v * v;
        uw += u * w;
        vw += v * w;
    }
    determinant = uu * vv - uv * uv;
    s = share_of(uv * vw - vv * uw, determinant);
    t = share_of(uv * s + vw, vv);
    s = share_of(uv * t - uw, uu);
    for (k = 0; k < 3; k++) {
        const double apart = a[k] + s * (b[k] - a[k]) - c[k] - t * (d[k] - c[k]);
        square += apart * apart;
    }
    return sqrt(square);
}

static finding check_clearance(const double base[6][3], const six_struts *now, const hc_limits *limits)
{
    double ends[6][3];
    int i, j;
    for (i = 0; i < 6; i++) {
        store(add(row_of(base[i]), now->strut[i]), ends[i]);
    }
    for (i = 0; i < 6; i++) {
        double least = HUGE_VAL;
        int nearest = -1;
        for (j = 0; j < i; j++) {
            if (limits->apart[i][j] > 0.0) {
                const double distance = segment_distance(base[i], ends[i], base[j], ends[j]);
                if (distance < least || distance != distance) {
                    least = distance;
                    nearest = j;
                }
            }
        }
        if (!(least >= limits->clearance)) {
            return found(HC_CLEARANCE, nearest, least);
        }
    }
    return found(HC_OK, -1, 0.0);
}

static finding check_joints(const double base[6][3], const hc_pose *pose, const six_struts *now,
                            const hc_limits *limits)
{
    int i, k;
    for (i = 0; i < 6; i++) {
        const vec s = now->strut[i];
        const double length = now->length[i];
        const double at_base = dot(s, row_of(limits->cone_axes[0][i])) / length;
        double at_platform = 0.0;
        for (k = 0; k < 3; k++) {
            const double along = pose->rotation[0][k] * s.x + pose->rotation[1][k] * s.y + pose->rotation[2][k] * s.z;
            at_platform += along * limits->cone_axes[1][i][k];
        }
        at_platform /= length;
        if (!(at_base >= limits->cone_cosines[0][i])) {
            return found(HC_BASE_CONE, i, acos(held(at_base, -1.0, 1.0)));
        }
        if (!(at_platform >= limits->cone_cosines[1][i])) {
            return found(HC_PLATFORM_CONE, i, acos(held(at_platform, -1.0, 1.0)));
        }
    }
    return limits->clearance > 0.0 ? check_clearance(base, now, limits) : found(HC_OK, -1, 0.0);
}

/* `now` are the struts at the pose: whoever asks has needed them already */
static finding check_stage(const double base[6][3], const hc_pose *pose, const six_struts *now,
                           const double lengths[6], const hc_limits *limits, double *condition)
{
    finding f;
    double sign;
    int i;
    *condition = NAN;
    for (i = 0; i < 6; i++) {
        if (!finite_number(lengths[i])) {
            return found(HC_NOT_FINITE, i, lengths[i]);
        }
        if (lengths[i] < limits->stroke[i][0]) {
            return found(HC_STROKE_SHORT, i, lengths[i]);
        }
        if (lengths[i] > limits->stroke[i][1]) {
            return found(HC_STROKE_LONG, i, lengths[i]);
        }
    }
    f = check_joints(base, pose, now, limits);
    if (f.status != HC_OK) {
        return f;
    }
    *condition = condition_at(base, pose, now, limits->characteristic_length, &sign);
    if (!(*condition <= limits->condition)) {
        return found(HC_CONDITION, -1, *condition);
    }
    return sign == limits->home_sign ? f : found(HC_ASSEMBLY, -1, sign);
}

/* A NaN in `previous` means that there is none. */
static finding check_change(const double lengths[6], const double previous[6], double largest)
{
    int i;
    for (i = 0; i < 6; i++) {
        const double change = lengths[i] - previous[i];
        if (fabs(change) > largest) {
            return found(HC_STEP, i, change);
        }
    }
    return found(HC_OK, -1, 0.0);
}

/* ---- The error field: kernels/field.py ------------------------------------------------------------------------ */

/* Cell, weight of its upper node, and whether the coordinate lies outside the grid. */
typedef struct {
    int index;
    double weight;
    int outside;
} place;

static place locate(double value, const double *nodes, int count)
{
    place at;
    at.index = 0;
    at.weight = 0.0;
    at.outside = value < nodes[0];
    if (value <= nodes[0]) {
        return at;
    }
    if (value >= nodes[count - 1]) {
        at.index = count - 2;
        at.weight = 1.0;
        at.outside = value > nodes[count - 1];
        return at;
    }
    while (at.index < count - 2 && value >= nodes[at.index + 1]) {
        at.index++;
    }
    at.weight = (value - nodes[at.index]) / (nodes[at.index + 1] - nodes[at.index]);
    return at;
}

static double along(double value, const double *nodes, int count)
{
    const double first = nodes[0], last = nodes[count - 1];
    return fmin(1.0, fmax(-1.0, (2.0 * value - first - last) / (last - first)));
}

/* Add the family of lines along one axis: four polynomials, weighted by the area opposite to each (Mou & King). */
static void add_family(const hc_field *field, int axis, double u, double sense, const place *first,
                       const place *second, double error[6])
{
    const int across = field->node_count[axis == 2 ? 1 : 2], size = 6 * field->powers[axis];
    const int upper = field->node_count[axis == 0 ? 1 : 0];
    const double s = first->weight, t = second->weight;
    int direction, k, power;
    for (direction = 0; direction < 2; direction++) {
        const double share = direction == 0 ? 0.5 * (1.0 + sense) : 0.5 * (1.0 - sense);
        const int cell = (direction * upper + first->index) * across + second->index;
        const double *c00 = field->lines[axis] + cell * size, *c01 = c00 + size;
        const double *c10 = c00 + across * size, *c11 = c10 + size;
        const double w00 = share * (1.0 - s) * (1.0 - t), w01 = share * (1.0 - s) * t;
        const double w10 = share * s * (1.0 - t), w11 = share * s * t;
        double value[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
        if (share == 0.0) {
            continue;
        }
        for (power = size - 6; power >= 0; power -= 6) {
            for (k = 0; k < 6; k++) { /* side by side in memory, for the compiler to take two or four at once */
                const int at = power + k;
                value[k] = value[k] * u + (w00 * c00[at] + w01 * c01[at] + w10 * c10[at] + w11 * c11[at]);
            }
        }
        for (k = 0; k < 6; k++) {
            error[k] += value[k];
        }
    }
}

/* field_one: six error components at a point; returns whether it lies outside the box */
static int field_at(const hc_field *field, vec point, const double sense[3], double error[6])
{
    place x, y, z;
    int k;
    if (!(finite_number(point.x) && finite_number(point.y) && finite_number(point.z))) {
        for (k = 0; k < 6; k++) {
            error[k] = NAN;
        }
        return 1;
    }
    x = locate(point.x, field->nodes[0], field->node_count[0]);
    y = locate(point.y, field->nodes[1], field->node_count[1]);
    z = locate(point.z, field->nodes[2], field->node_count[2]);
    for (k = 0; k < 6; k++) {
        error[k] = 0.0;
    }
    if (field->powers[0]) {
        add_family(field, 0, along(point.x, field->nodes[0], field->node_count[0]), sense[0], &y, &z, error);
    }
    if (field->powers[1]) {
        add_family(field, 1, along(point.y, field->nodes[1], field->node_count[1]), sense[1], &x, &z, error);
    }
    if (field->powers[2]) {
        add_family(field, 2, along(point.z, field->nodes[2], field->node_count[2]), sense[2], &x, &y, error);
    }
    return x.outside || y.outside || z.outside;
}

/* Solve q o E(q) = target for q by fixed points; returns whether it was solved. */
static int undo_field(const hc_field *field, const hc_pose *target, const double sense[3], hc_pose *q, int *outside)
{
    const vec target_point = add(row_of(target->position), lever(target, field->probe));
    vec point = target_point;
    double error[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    int solved = 0, count;
    for (count = 0; count < FIELD_ITERATIONS && !solved; count++) {
        vec next;
        *outside = field_at(field, point, sense, error);
        next = subtract(target_point, vector(error[0], error[1], error[2]));
        solved = fabs(point.x - next.x) + fabs(point.y - next.y) + fabs(point.z - next.z) < 1e-15;
        point = next;
    }
    *q = *target;
    if (error[3] != 0.0 || error[4] != 0.0 || error[5] != 0.0) {
        rotate(q->rotation, -error[3], -error[4], -error[5]);
    }
    store(subtract(point, lever(q, field->probe)), q->position);
    return solved;
}

/* Write q o E(q). */
static void apply_field(const hc_field *field, const hc_pose *q, const double sense[3], hc_pose *actual)
{
    const vec point = add(row_of(q->position), lever(q, field->probe));
    double error[6];
    field_at(field, point, sense, error);
    *actual = *q;
    if (error[3] != 0.0 || error[4] != 0.0 || error[5] != 0.0) {
        rotate(actual->rotation, error[3], error[4], error[5]);
    }
    store(subtract(add(point, vector(error[0], error[1], error[2])), lever(actual, field->probe)), actual->position);
}

/* ---- One strut: kernels/struts.py, kernels/motion.py ---------------------------------------------------------- */

/* follow: direction of motion with a reversal threshold */
static double follow(double value, double threshold, double low[9], double sense[9], int index)
{
    if (low[index] != low[index]) {
        low[index] = value - 0.5 * threshold;
    } else if (value > low[index] + threshold) {
        low[index] = value - threshold;
        sense[index] = 1.0;
    } else if (value < low[index]) {
        low[index] = value;
        sense[index] = -1.0;
    }
    return sense[index];
}

/* screw_shift: how much longer the command must be for the screw's rotation, m (screw_twist is part of it); `now` are
 * the struts at the pose */
static double screw_shift(const hc_model *model, const hc_pose *pose, const six_struts *now, int i)
{
    const hc_strut *strut = &model->struts[i];
    vec s, u, b, p;
    double length, sine, cosine, turns;
    if (strut->lead == 0.0) {
        return 0.0;
    }
    s = now->strut[i];
    length = now->length[i];
    u = vector(s.x / length, s.y / length, s.z / length);
    b = row_of(model->base.axes[i]);
    p = lever(pose, model->platform.axes[i]);
    sine = dot(b, cross(p, u));
    cosine = dot(b, p) - dot(b, u) * dot(p, u);
    turns = (atan2(sine, cosine) - strut->twist_home) / (2.0 * PI);
    return -strut->lead * (turns - floor(turns + 0.5));
}

/* Cosine and sine of the angle that a screw has turned. */
typedef struct {
    double cosine, sine;
} turn;

/* screw_turn */
static turn screw_turn(const hc_strut *strut, double command)
{
    turn at = {1.0, 0.0};
    if (strut->harmonics != 0.0) {
        const double angle = strut->wavenumber * command;
        at.cosine = cos(angle);
        at.sine = sin(angle);
    }
    return at;
}

/* turned_on: increased by a small angle */
static turn turned_on(turn at, double angle)
{
    const double square = angle * angle;
    const double c = 1.0 - square * (0.5 - square * (1.0 / 24.0));
    const double s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0)));
    turn on;
    on.cosine = at.cosine * c - at.sine * s;
    on.sine = at.sine * c + at.cosine * s;
    return on;
}

/* wave_error: error and slope of the periodic error; harmonics by the addition theorem */
static double wave_error(const hc_strut *strut, turn at, double *slope)
{
    const double (*wave)[2] = strut->wave;
    double error = wave[0][0] * at.cosine + wave[0][1] * at.sine;
    double c = at.cosine, s = at.sine, steep = wave[0][1] * c - wave[0][0] * s;
    int n;
    for (n = 2; n <= strut->harmonics; n++) {
        const double a = wave[n - 1][0], b = wave[n - 1][1], next = c * at.cosine - s * at.sine;
        s = s * at.cosine + c * at.sine;
        c = next;
        error += a * c + b * s;
        steep += n * (b * c - a * s);
    }
    *slope = strut->wavenumber * steep;
    return error;
}

/* error_at: error and slope of what depends on the command: offset, pitch, waves, map, and the backlash's change */
static double error_at(const hc_model *model, int i, double command, turn at, double sense, double *slope)
{
    const hc_strut *strut = &model->struts[i];
    const hc_map *map = &model->map;
    double error = strut->offset + strut->pitch * (command - strut->reference);
    *slope = strut->pitch;
    if (strut->harmonics != 0.0) {
        double steep;
        error += wave_error(strut, at, &steep);
        *slope += steep;
    }
    if (map->knot_count > 1) {
        const int last = map->knot_count - 1;
        const double inside = fmin(map->knots[last], fmax(map->knots[0], command));
        const double *piece, half = -0.5 * sense;
        double x, c[4];
        int low = 0, high = last, n;
        while (high - low > 1) {
            const int middle = low + (high - low) / 2;
            if (map->knots[middle] <= inside) {
                low = middle;
            } else {
                high = middle;
            }
        }
        x = inside - map->knots[low];
        piece = map->pieces + (i * last + low) * 8;
        for (n = 0; n < 4; n++) {
            c[n] = piece[n] + half * piece[4 + n];
        }
        error += ((c[0] * x + c[1]) * x + c[2]) * x + c[3];
        if (inside == command) {
            *slope += (3.0 * c[0] * x + 2.0 * c[1]) * x + c[2];
        }
    }
    return error;
}

static double actual_length(const hc_state *state, int i, double command, double sense, double shift)
{
    const hc_strut *strut = &state->model->struts[i];
    double slope;
    const double error = error_at(state->model, i, command, screw_turn(strut, command), sense, &slope);
    const double play = 0.5 * sense * strut->backlash;
    return (1.0 + state->growth[i]) * (command + error - play - shift);
}

static double command_for_length(const hc_state *state, int i, double length, double sense, double shift)
{
    const hc_strut *strut = &state->model->struts[i];
    const double wanted = length / (1.0 + state->growth[i]) + 0.5 * sense * strut->backlash + shift;
    double command = wanted - strut->offset;
    turn at;
    int count;
    command -= strut->pitch * (command - strut->reference);
    at = screw_turn(strut, command);
    for (count = 0; count < COMMAND_ITERATIONS; count++) {
        double slope, angle;
        const double error = error_at(state->model, i, command, at, sense, &slope);
        const double step = (wanted - command - error) / (1.0 + slope);
        command += step;
        if (fabs(step) < 1e-9) {
            break;
        }
        angle = strut->wavenumber * step;
        at = fabs(angle) < SMALL_ANGLE ? turned_on(at, angle) : screw_turn(strut, command);
    }
    return command;
}

/* ---- The whole chain: kernels/model.py, kernels/compensation.py ----------------------------------------------- */

/* command_one: the model backwards for one platform pose */
static int run_backwards(const hc_state *state, const hc_pose *platform, double low[9], double sense[9], hc_pose *q,
                         six_struts *now, double commands[6], int *outside)
{
    const hc_model *model = state->model;
    const vec point = add(row_of(platform->position), lever(platform, model->field.probe));
    int solved, i;
    follow(point.x, model->axis_threshold, low, sense, 0);
    follow(point.y, model->axis_threshold, low, sense, 1);
    follow(point.z, model->axis_threshold, low, sense, 2);
    solved = undo_field(&model->field, platform, sense, q, outside);
    *now = struts_of(state->base_joints, state->platform_joints, q);
    for (i = 0; i < 6; i++) {
        const double direction = follow(now->length[i], model->strut_threshold, low, sense, 3 + i);
        commands[i] = command_for_length(state, i, now->length[i], direction, screw_shift(model, q, now, i));
    }
    return solved;
}

static void shrink_ramp(const hc_last *last, hc_last *next, double ramp_rate)
{
    const double by_stamp = next->time - last->time;
    const double pause = by_stamp == by_stamp ? by_stamp : next->received - last->received;
    double step = 0.0, largest = 0.0, keep;
    int i;
    if (pause == pause && last->nominal[0] == last->nominal[0]) { /* the first command stands where the struts are */
        step = ramp_rate * fmin(fmax(pause, 0.0), LONGEST_RAMP_STEP);
    }
    for (i = 0; i < 6; i++) {
        if (last->changed && last->correction[i] == last->correction[i]) {
            next->ramp[i] = last->correction[i] - next->correction[i];
        }
        largest = fmax(largest, fabs(next->ramp[i]));
    }
    keep = largest <= step ? 0.0 : 1.0 - step / largest;
    for (i = 0; i < 6; i++) {
        next->ramp[i] *= keep;
    }
}

/* elapsed: time since the last command by the stamps and by the receipt, s; -1: not known */
static hc_time elapsed(const hc_last *last, const hc_last *next)
{
    hc_time since;
    since.made = next->time - last->time;
    since.received = next->received - last->received;
    since.made = since.made >= 0.0 ? since.made : -1.0;
    since.received = since.received >= 0.0 ? since.received : -1.0;
    return since;
}

/* The struts' speed by both clocks; writes how far they are ahead of what is allowed. */
static finding check_speed(const hc_last *last, hc_last *next, double limit)
{
    const hc_time since = elapsed(last, next);
    const double late = last->published - last->received, held_up = late == late ? late : 0.0;
    double speed = 0.0, wait = 0.0;
    int hurried = -1, early = -1, i;
    for (i = 0; i < 6; i++) {
        const double moved = fabs(next->command[i] - last->command[i]), change = moved == moved ? moved : 0.0;
        if (since.made >= 0.0) {
            const double ahead = fmax(0.0, last->ahead_by_stamp[i] + change - limit * since.made);
            next->ahead_by_stamp[i] = ahead;
            if (ahead > limit * AHEAD_BY_STAMP && change > speed * since.made) {
                hurried = i;
                speed = change / fmax(since.made, 1e-9);
            }
        }
        if (since.received >= 0.0) {
            double ahead = fmax(0.0, last->ahead_by_receipt[i] - limit * held_up);
            ahead = fmax(0.0, ahead + change - limit * (since.received - held_up));
            next->ahead_by_receipt[i] = ahead;
            if (ahead / limit - AHEAD_BY_RECEIPT > wait) {
                early = i;
                wait = ahead / limit - AHEAD_BY_RECEIPT;
            }
        }
    }
    if (hurried >= 0) {
        return found(HC_SPEED, hurried, speed);
    }
    return early >= 0 ? found(HC_EARLY, early, wait) : found(HC_OK, -1, 0.0);
}

/* How fast the struts' smoothed speeds change; writes them. */
static finding check_acceleration(const hc_last *last, hc_last *next, double limit)
{
    const hc_time since = elapsed(last, next);
    const double period = fmax(since.made >= 0.0 ? since.made : since.received, SHORTEST_PERIOD);
    const double keep = exp(-period / SMOOTHED_OVER);
    finding worst = found(HC_OK, -1, limit);
    int i;
    for (i = 0; i < 6; i++) {
        const double before = last->smooth_speed[i], speed = (next->command[i] - last->command[i]) / period;
        const double smooth = speed == speed ? keep * before + (1.0 - keep) * speed : 0.0;
        const double acceleration = fabs(smooth - before) / period;
        next->smooth_speed[i] = smooth;
        if (acceleration > worst.value) {
            worst = found(HC_ACCELERATION, i, acceleration);
        }
    }
    return worst;
}

/* check_command: correction, steps, speed and acceleration; `compensated` tells the stage */
static finding check_command(const hc_last *last, hc_last *next, const hc_limits *limits, int *compensated)
{
    finding f;
    int i;
    *compensated = 1;
    for (i = 0; i < 6; i++) {
        if (!(fabs(next->correction[i]) <= limits->correction)) {
            return found(HC_CORRECTION, i, next->correction[i]);
        }
    }
    f = check_change(next->nominal, last->nominal, limits->step);
    if (f.status != HC_OK) {
        *compensated = 0;
        return f;
    }
    f = check_change(next->command, last->command, limits->step);
    if (f.status == HC_OK) {
        f = check_speed(last, next, limits->speed);
    }
    if (f.status == HC_OK && limits->acceleration > 0.0) {
        f = check_acceleration(last, next, limits->acceleration);
    }
    return f;
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

/* compensate_one from the platform's pose on: work out the next command; `next` counts only when nothing was found */
static finding work_out(const hc_state *state, const hc_pose *platform, hc_time time, hc_last *next, hc_answer *answer)
{
    const hc_model *model = state->model;
    const hc_last *last = &state->last;
    const hc_limits *limits = &model->limits;
    six_struts now = struts_of(model->base.joints, model->platform.joints, platform);
    finding f;
    double unused;
    int i;
    *next = *last;
    answer->compensated = 0;
    answer->outside_field = 0;
    next->platform = *platform;
    for (i = 0; i < 6; i++) {
        next->nominal[i] = now.length[i];
    }
    f = check_stage(model->base.joints, platform, &now, next->nominal, limits, &answer->condition);
    if (f.status != HC_OK) {
        return f;
    }
    answer->compensated = 1;
    if (!run_backwards(state, platform, next->motion_low, next->motion_sense, &next->model, &now, next->command,
                       &answer->outside_field)) {
        return found(HC_NOT_CONVERGED, -1, NAN);
    }
    for (i = 0; i < 6; i++) {
        next->correction[i] = (double)last->enabled * (next->command[i] - next->nominal[i]);
    }
    next->time = time.made;
    next->received = time.received;
    next->published = NAN;
    next->changed = 0;
    next->resumes = 0;
    shrink_ramp(last, next, state->ramp_rate);
    for (i = 0; i < 6; i++) {
        next->correction[i] += next->ramp[i];
        next->command[i] = next->nominal[i] + next->correction[i];
    }
    if (answer->outside_field && model->field.refuse_outside) {
        return found(HC_OUTSIDE_FIELD, -1, NAN);
    }
    f = check_command(last, next, limits, &answer->compensated);
    if (f.status != HC_OK) {
        return f;
    }
    answer->compensated = 1;
    return check_stage(state->base_joints, &next->model, &now, next->command, limits, &unused);
}

/* Compensator._resume: take what measured struts differ from nominal lengths for the correction that they stand at */
static void take_standing(const hc_state *state, const hc_last *trial, hc_last *last)
{
    double standing[6];
    int i;
    for (i = 0; i < 6; i++) {
        standing[i] = last->command[i] - trial->nominal[i];
        if (!(fabs(standing[i]) <= state->model->limits.correction)) {
            return;
        }
    }
    for (i = 0; i < 6; i++) {
        last->correction[i] = standing[i];
    }
    last->changed = 1;
}

static void fill_answer(const hc_last *last, finding f, hc_answer *answer)
{
    int i;
    answer->status = f.status;
    answer->strut = f.strut;
    answer->value = f.value;
    for (i = 0; i < 6; i++) {
        answer->nominal[i] = last->nominal[i];
        answer->correction[i] = last->correction[i];
        answer->command[i] = last->command[i];
    }
}

/* Compensator.step from the platform's pose on, when there is one */
static hc_status command_platform(hc_state *state, hc_status status, const hc_pose *platform, hc_time time,
                                  hc_answer *answer)
{
    hc_last next;
    finding f = found(status, -1, NAN);
    answer->condition = NAN;
    answer->compensated = 0;
    answer->outside_field = 0;
    if (status == HC_OK) {
        f = work_out(state, platform, time, &next, answer);
        if (state->last.resumes) {
            const hc_last before = state->last;
            take_standing(state, &next, &state->last);
            f = work_out(state, platform, time, &next, answer);
            state->last = before;
        }
        if (f.status == HC_OK) {
            state->last = next;
        }
    }
    fill_answer(&state->last, f, answer);
    return f.status;
}

hc_status hc_command(hc_state *state, const double numbers[7], hc_time time, const hc_pose *frame, hc_answer *answer)
{
    const hc_model *model = state->model;
    hc_pose pose, platform;
    const hc_status status = read_pose(numbers, &pose);
    if (status == HC_OK) {
        const hc_pose in_base = compose(frame ? frame : &model->work, &pose);
        platform = compose(&in_base, &model->tool_inverse);
    }
    return command_platform(state, status, &platform, time, answer);
}

hc_status hc_command_lengths(hc_state *state, const double nominal[6], hc_time time, hc_answer *answer)
{
    const hc_model *model = state->model;
    hc_pose platform = state->last.platform;
    double unused;
    const hc_status status = solve_pose(model->base.joints, model->platform.joints, nominal, &model->limits, &platform,
                                        &unused);
    return command_platform(state, status, &platform, time, answer);
}

void hc_published(hc_state *state, double time)
{
    state->last.published = time;
}

/* actual_pose_one: the model forwards; lengths and screw rotation are settled in turn */
static hc_status run_forwards(const hc_state *state, const double commands[6], hc_pose *q, double *condition)
{
    const hc_model *model = state->model;
    double lengths[6], shifts[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    hc_status outcome = HC_NOT_CONVERGED;
    int turning = 0, count, i;
    for (i = 0; i < 6; i++) {
        turning = turning || model->struts[i].lead != 0.0;
    }
    for (count = 0; count < LEAD_ITERATIONS; count++) {
        six_struts now;
        double change = 0.0;
        if (turning) {
            now = struts_of(state->base_joints, state->platform_joints, q);
        }
        for (i = 0; i < 6; i++) {
            const double shift = screw_shift(model, q, &now, i);
            change = fmax(change, fabs(shift - shifts[i]));
            shifts[i] = shift;
            lengths[i] = actual_length(state, i, commands[i], state->last.motion_sense[3 + i], shift);
        }
        if (turning && outcome == HC_OK && change < 1e-15) {
            break;
        }
        outcome = solve_pose(state->base_joints, state->platform_joints, lengths, &model->limits, q, condition);
        if (outcome != HC_OK || !turning) {
            break;
        }
    }
    return outcome;
}

hc_status hc_estimate(hc_state *state, const double lengths[6], hc_estimated *estimated)
{
    hc_pose q = state->estimate, actual;
    estimated->condition = NAN;
    estimated->status = run_forwards(state, lengths, &q, &estimated->condition);
    if (estimated->status == HC_OK) {
        state->estimate = q;
        apply_field(&state->model->field, &q, state->last.motion_sense, &actual);
        estimated->tool = compose(&actual, &state->model->tool);
    }
    return estimated->status;
}

/* ---- What changes between commands: compensation/compensator.py, machine/model.py ------------------------------ */

static void place_joints(const hc_body *body, double growth, double joints[6][3])
{
    int i, k;
    for (i = 0; i < 6; i++) {
        for (k = 0; k < 3; k++) {
            const double nominal = body->joints[i][k], deviation = body->deviation[i][k];
            joints[i][k] = nominal + (deviation + growth * (nominal + deviation));
        }
    }
}

/* RealMachine._growth: by which share a part has grown since 20 degrees */
static double part_growth(const hc_state *state, int part, double expansion)
{
    const hc_late *late = &state->model->late;
    const int sensor = late->sensors[part];
    double growth = expansion * (state->temperatures[sensor] - REFERENCE_TEMPERATURE);
    int k;
    for (k = 0; k < late->count && finite_number(state->began[sensor]); k++) {
        growth += late->expansion[part][k] * state->behind[sensor][k];
    }
    return growth;
}

/* RealMachine: the structure and the struts' growth at the present temperatures */
static void place_machine(hc_state *state)
{
    int i;
    for (i = 0; i < 6; i++) {
        state->growth[i] = part_growth(state, i, state->model->struts[i].expansion);
    }
    place_joints(&state->model->base, part_growth(state, 6, state->model->base.expansion), state->base_joints);
    place_joints(&state->model->platform, part_growth(state, 7, state->model->platform.expansion), state->platform_joints);
}

/* Temperatures.follow and Lag.take */
static void follow_late(hc_state *state, int index, double value, double time)
{
    const hc_late *late = &state->model->late;
    const double change = value - state->temperatures[index];
    const double elapsed = fmax(0.0, time - state->newest[index]);
    int k;
    if (!finite_number(state->began[index])) {
        state->began[index] = time;
        state->newest[index] = time;
        return;
    }
    state->newest[index] = fmax(state->newest[index], time);
    for (k = 0; k < late->count; k++) {
        const double ages = elapsed / late->time_constants[k];
        const double gone = -expm1(-ages);
        const double kept = ages > 0.0 ? gone / ages : 1.0;
        state->behind[index][k] = state->behind[index][k] * (1.0 - gone) - change * kept;
    }
}

/* Compensator._followed: the lengths whose directions are followed, at the last command; 0 where there are none */
static int followed(const hc_state *state, double lengths[6])
{
    hc_last copy = state->last;
    six_struts now;
    double commands[6];
    int outside, i;
    for (i = 0; i < 6; i++) {
        if (!finite_number(copy.nominal[i])) {
            return 0;
        }
    }
    if (!run_backwards(state, &copy.platform, copy.motion_low, copy.motion_sense, &copy.model, &now, commands, &outside)) {
        return 0;
    }
    for (i = 0; i < 6; i++) {
        lengths[i] = now.length[i];
    }
    return 1;
}

hc_status hc_set_temperature(hc_state *state, int index, double value, double time)
{
    double before[6], after[6];
    int comparable, i;
    if (index < 0 || index > 7 || !(value >= LOWEST_TEMPERATURE && value <= HIGHEST_TEMPERATURE)) {
        return HC_TEMPERATURE;
    }
    if (state->model->late.count && !finite_number(time)) {
        return HC_TEMPERATURE;
    }
    comparable = followed(state, before);
    if (state->model->late.count) {
        follow_late(state, index, value, time);
    }
    state->temperatures[index] = value;
    place_machine(state);
    comparable = followed(state, after) && comparable;
    for (i = 0; i < 6 && comparable; i++) {
        /* The model's lengths jump, the struts do not: without this the jump would count as a motion. */
        state->last.motion_low[3 + i] += after[i] - before[i];
    }
    state->last.changed = 1;
    return HC_OK;
}

static void must_ramp(hc_last *last)
{
    last->changed = last->correction[0] == last->correction[0];
}

/* Compensator._check_whole: whether the whole correction, without ramp or switch, is allowed at the last command */
static hc_status check_whole(const hc_state *state)
{
    hc_state trial = *state;
    hc_last unused;
    hc_answer answer;
    hc_time unknown;
    int i, home = 0;
    for (i = 0; i < 6; i++) {
        home = home || !finite_number(state->last.nominal[i]);
        trial.last.nominal[i] = NAN;
        trial.last.correction[i] = NAN;
        trial.last.command[i] = NAN;
        trial.last.ramp[i] = 0.0;
    }
    trial.last.time = NAN;
    trial.last.received = NAN;
    unknown.made = NAN;
    unknown.received = NAN;
    trial.last.enabled = 1;
    trial.last.changed = 0;
    return work_out(&trial, home ? &state->model->home : &state->last.platform, unknown, &unused, &answer).status;
}

hc_status hc_enable(hc_state *state, int enabled)
{
    const int wanted = enabled != 0;
    if (wanted != state->last.enabled) {
        const hc_status status = wanted ? check_whole(state) : HC_OK;
        if (status != HC_OK) {
            return status;
        }
        state->last.enabled = wanted;
        must_ramp(&state->last);
    }
    return HC_OK;
}

/* CommandState.clear: the correction stays, as what the struts stand at */
static void forget(hc_state *state)
{
    hc_last *last = &state->last;
    int i;
    for (i = 0; i < 9; i++) {
        last->motion_low[i] = NAN;
        last->motion_sense[i] = 0.0;
    }
    for (i = 0; i < 6; i++) {
        last->nominal[i] = NAN;
        last->command[i] = NAN;
        last->ahead_by_stamp[i] = 0.0;
        last->smooth_speed[i] = 0.0;
    }
    last->time = NAN;
    last->resumes = 0;
    must_ramp(last);
    state->estimate = state->model->home;
}

hc_status hc_reset(hc_state *state, const double measured[6])
{
    int i;
    for (i = 0; measured && i < 6; i++) {
        if (!finite_number(measured[i])) {
            return HC_NOT_FINITE;
        }
    }
    forget(state);
    for (i = 0; measured && i < 6; i++) {
        state->last.command[i] = measured[i];
        state->last.resumes = 1;
    }
    return HC_OK;
}

void hc_init(hc_state *state, const hc_model *model, double ramp_rate)
{
    int i;
    state->model = model;
    state->ramp_rate = ramp_rate;
    for (i = 0; i < 8; i++) {
        state->temperatures[i] = REFERENCE_TEMPERATURE;
        state->began[i] = NAN;
        state->newest[i] = NAN;
        state->behind[i][0] = 0.0;
        state->behind[i][1] = 0.0;
    }
    for (i = 0; i < 6; i++) {
        state->last.correction[i] = NAN;
        state->last.ramp[i] = 0.0;
        state->last.ahead_by_receipt[i] = 0.0;
    }
    state->last.received = NAN;
    state->last.published = NAN;
    state->last.platform = model->home;
    state->last.model = model->home;
    state->last.enabled = 1;
    forget(state);
    place_machine(state);
}

const char *hc_reason(hc_status status)
{
    switch (status) {
    case HC_OK: return "";
    case HC_STROKE_SHORT: return "stroke";
    case HC_STROKE_LONG: return "stroke";
    case HC_BASE_CONE: return "base_cone";
    case HC_PLATFORM_CONE: return "platform_cone";
    case HC_CLEARANCE: return "clearance";
    case HC_CONDITION: return "condition";
    case HC_ASSEMBLY: return "assembly";
    case HC_NOT_FINITE: return "not_finite";
    case HC_CORRECTION: return "correction";
    case HC_STEP: return "step";
    case HC_SPEED: return "speed";
    case HC_EARLY: return "speed";
    case HC_ACCELERATION: return "acceleration";
    case HC_NOT_CONVERGED: return "not_converged";
    case HC_OUTSIDE_FIELD: return "outside_field";
    case HC_QUATERNION: return "quaternion";
    case HC_SINGULAR: return "singular";
    case HC_UNREACHABLE: return "unreachable";
    case HC_OTHER_ASSEMBLY: return "other_assembly_mode";
    case HC_TEMPERATURE: return "bad_model";
    }
    return "unknown";
}
