/* SPDX-License-Identifier: Apache-2.0
 *
 * Strut vectors, Jacobian, condition number, forward kinematics by Newton. Song, Mou & King (1993); doc/theory.md, 4 to 6.
 */
#include "core.h"

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

INLINED vec strut_between(vec b, vec t, vec p, const mat *r)
{
    return vector(p.x + r->row[0].x * t.x + r->row[0].y * t.y + r->row[0].z * t.z - b.x,
                  p.y + r->row[1].x * t.x + r->row[1].y * t.y + r->row[1].z * t.z - b.y,
                  p.z + r->row[2].x * t.x + r->row[2].y * t.y + r->row[2].z * t.z - b.z);
}

INLINED six_struts struts_at(const double base[6][3], const double platform[6][3], vec p, const mat *r)
{
    six_struts all;
    int i;
    UNROLLED
    for (i = 0; i < 6; i++) {
        const vec t = row_of(platform[i]);
        all.strut[i] = strut_between(row_of(base[i]), t, p, r);
        all.moment[i] = cross(vector(dot(r->row[0], t), dot(r->row[1], t), dot(r->row[2], t)), all.strut[i]);
        all.length[i] = norm(all.strut[i]);
    }
    return all;
}

INLINED double inverse_columns(vec a, vec b, vec c, vec columns[3])
{
    const vec first = cross(b, c);
    const double determinant = dot(a, first);
    const double factor = 1.0 / determinant;
    columns[0] = scale(factor, first);
    columns[1] = scale(factor, cross(c, a));
    columns[2] = scale(factor, cross(a, b));
    return determinant;
}

INLINED blocks eliminate(const vec s[6], const vec m[6])
{
    blocks f;
    vec left[3];
    int k;
    f.determinant_upper = inverse_columns(s[0], s[2], s[4], f.upper);
    UNROLLED
    for (k = 0; k < 3; k++) {
        const vec row = s[2 * k + 1];
        f.ratio[k] = vector(dot(row, f.upper[0]), dot(row, f.upper[1]), dot(row, f.upper[2]));
        left[k] = subtract(m[2 * k + 1], combine(f.ratio[k], m[0], m[2], m[4]));
    }
    f.determinant_lower = inverse_columns(left[0], left[1], left[2], f.lower);
    return f;
}

/* Solve with the factors: s_i v + m_i w = f_i. */
INLINED void substitute(const vec m[6], const blocks *f, const double right[6], vec *v, vec *w)
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
INLINED double column_square(const vec m[6], const blocks *f, vec v, vec w, double square)
{
    const vec rest = combine_rows(vector(dot(m[0], w), dot(m[2], w), dot(m[4], w)), f->upper);
    v = add(v, rest);
    return dot(v, v) + square * dot(w, w);
}

/* Condition number and sign of det J; sign 0 where pivoting is needed. */
INLINED double block_condition(const six_struts *now, double characteristic_length, double *sign)
{
    const double square = characteristic_length * characteristic_length;
    const blocks f = eliminate(now->strut, now->moment);
    const vec zero = vector(0.0, 0.0, 0.0);
    const double *l = now->length;
    const vec *a = f.ratio;
    const vec column[3] = {{a[0].x, a[1].x, a[2].x}, {a[0].y, a[1].y, a[2].y}, {a[0].z, a[1].z, a[2].z}};
    double inverse = 0.0, moments = 0.0, condition;
    int k;
    UNROLLED
    for (k = 0; k < 6; k++) {
        const vec w = k % 2 ? f.lower[k / 2] : combine_rows(column[k / 2], f.lower);
        const vec v = k % 2 ? zero : f.upper[k / 2];
        inverse += l[k] * l[k] * column_square(now->moment, &f, v, w, square);
        moments += dot(now->moment[k], now->moment[k]) / (l[k] * l[k]);
    }
    condition = sqrt((6.0 + moments / square) * inverse) / 6.0;
    *sign = f.determinant_upper * f.determinant_lower > 0.0 ? -1.0 : 1.0; /* no branch: lanes.c */
    *sign = fabs(f.determinant_upper) >= COPLANAR * l[0] * l[2] * l[4] ? *sign : 0.0;
    *sign = condition < HUGE_VAL ? *sign : 0.0;
    return condition;
}

/* Squared misfit of six lengths in units of what rounding may leave. */
INLINED double closure_error(const double now[6], const double wanted[6])
{
    const vec first = row_of(now), second = row_of(now + 3);
    const vec a = subtract(first, row_of(wanted)), b = subtract(second, row_of(wanted + 3));
    const double allowed = CLOSURE * CLOSURE
                           + CLOSURE_RELATIVE * CLOSURE_RELATIVE * (dot(first, first) + dot(second, second));
    return (dot(a, a) + dot(b, b)) / allowed;
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

/* What a solution is judged by: that J is well conditioned and of home's sign, the loops close, R is a rotation. It does
 * not depend on the iteration. */
typedef struct {
    double condition, sign, misfit, flaw;
} certificate;

INLINED certificate certify(const double base[6][3], const double platform[6][3], const double lengths[6], vec p,
                                  const mat *r, double characteristic_length)
{
    const six_struts now = struts_at(base, platform, p, r);
    certificate c;
    c.condition = block_condition(&now, characteristic_length, &c.sign);
    c.misfit = closure_error(now.length, lengths);
    c.flaw = rotation_error(r);
    return c;
}

static int closes(double misfit, double flaw)
{
    return misfit <= 1.0 && flaw <= ROTATION_ROUNDING;
}

/* What keeps a solution: the largest condition number, and home's sign of det J, 0 for any. */
typedef struct {
    double characteristic_length, home_sign, condition;
} judge;

static judge judge_of(const hc_limits *limits)
{
    judge by;
    by.characteristic_length = limits->characteristic_length;
    by.home_sign = limits->home_sign;
    by.condition = limits->condition;
    return by;
}

static int certified(const certificate *c, double step, const double lengths[6], const judge *by)
{
    int i, positive = 1;
    for (i = 0; i < 6; i++) {
        positive = positive && lengths[i] > 0.0;
    }
    return step < STEP_TOLERANCE && positive && closes(c->misfit, c->flaw) && c->condition <= by->condition
           && (c->sign * by->home_sign > 0.0 || (by->home_sign == 0.0 && c->sign != 0.0));
}

/* What came of a forward solution. */
typedef struct {
    hc_status status;
    int iterations;
    double condition;
} solution;

/* _newton, with pivoting */
static hc_status newton(const double base[6][3], const double platform[6][3], const double lengths[6], hc_pose *pose,
                        int *iterations)
{
    double jacobian[6][6], step[6];
    int i, k;
    for (*iterations = 1; *iterations <= MAX_ITERATIONS; ++*iterations) {
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
            return closes(closure_error(settled.length, lengths), rotation_error(&r)) ? HC_OK : HC_NOT_CONVERGED;
        }
    }
    *iterations = MAX_ITERATIONS;
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
static solution solve_carefully(const double base[6][3], const double platform[6][3], const double lengths[6],
                                const judge *by, hc_pose *pose)
{
    hc_pose trial = *pose;
    solution found = {HC_OK, 0, NAN};
    six_struts now;
    double sign;
    if (!usable(lengths, pose)) {
        found.status = HC_NOT_FINITE;
        return found;
    }
    if (!lengths_possible(base, platform, lengths)) {
        found.status = HC_UNREACHABLE;
        return found;
    }
    orthonormalise(trial.rotation); /* or what a rounded guess is off stays in a step too small to be followed by another */
    found.status = newton(base, platform, lengths, &trial, &found.iterations);
    if (found.status != HC_OK) {
        return found;
    }
    now = struts_of(base, platform, &trial);
    found.condition = condition_at(base, &trial, &now, by->characteristic_length, &sign);
    if (!(found.condition <= by->condition)) {
        found.status = HC_SINGULAR;
    } else if (by->home_sign != 0.0 && sign != by->home_sign) {
        found.status = HC_OTHER_ASSEMBLY;
    } else {
        *pose = trial;
    }
    return found;
}

/* One Newton step on the six loop closures; returns its length, m and rad. The rows are multiplied by the struts' lengths,
 * which spares a division and does not change the step. */
INLINED double newton_step(const double base[6][3], const double platform[6][3], const double lengths[6], vec *p,
                                 mat *r)
{
    const six_struts now = struts_at(base, platform, *p, r);
    const blocks f = eliminate(now.strut, now.moment);
    double misfit[6], ratio, shrink;
    vec v, w;
    int i;
    UNROLLED
    for (i = 0; i < 6; i++) {
        misfit[i] = now.length[i] * (lengths[i] - now.length[i]);
    }
    substitute(now.moment, &f, misfit, &v, &w);
    ratio = MAX_ROTATION_STEP / norm(w);
    shrink = ratio >= 1.0 ? 1.0 : ratio;
    *p = add(*p, scale(shrink, v));
    *r = turned(r, scale(shrink, w));
    return sqrt(dot(v, v) + dot(w, w));
}

/* solve_pose_one: the six loop closures by Newton from a guess, which is overwritten only by a solution */
static solution solve_pose(const double base[6][3], const double platform[6][3], const double lengths[6],
                           const judge *by, hc_pose *pose)
{
    vec p = row_of(pose->position);
    mat r = three_rows((const double(*)[3])pose->rotation);
    solution found = {HC_OK, 0, NAN};
    certificate c;
    double step = HUGE_VAL;
    int i;
    while (step >= STEP_TOLERANCE && found.iterations < MAX_ITERATIONS) {
        step = newton_step(base, platform, lengths, &p, &r);
        found.iterations++;
    }
    r = straightened(&r);
    c = certify(base, platform, lengths, p, &r, by->characteristic_length);
    if (!certified(&c, step, lengths, by)) {
        return solve_carefully(base, platform, lengths, by, pose);
    }
    found.condition = c.condition;
    store(p, pose->position);
    for (i = 0; i < 3; i++) {
        store(r.row[i], pose->rotation[i]);
    }
    return found;
}
