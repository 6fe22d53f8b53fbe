/* SPDX-License-Identifier: Apache-2.0
 *
 * Strut vectors, Jacobian, condition number, forward kinematics by Newton. Song, Mou & King (1993); doc/theory.md, 4 to 6.
 */
#include "core.h"

/* The struts at a pose: vectors from base joint to platform joint, their moments about the platform's origin, lengths. */
typedef struct {
    vec strut[6];
    vec moment[6];
    double length[6];
} six_struts;

/* LU factors, in blocks of three rows, of the 6 x 6 matrix with rows (strut, moment). */
typedef struct {
    vec upper[3]; /* columns of the inverse of rows 0, 2, 4 */
    vec ratio[3]; /* rows 1, 3, 5 times the inverse of rows 0, 2, 4 */
    vec lower[3]; /* columns of the inverse of rows 1, 3, 5 after elimination */
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
    UNROLLED
    for (int i = 0; i < 6; i++) {
        const vec t = row_of(platform[i]);
        all.strut[i] = strut_between(row_of(base[i]), t, p, r);
        all.moment[i] = cross(times(r->row, t), all.strut[i]);
        all.length[i] = norm(all.strut[i]);
    }
    return all;
}

/* Write the columns of the inverse of the matrix with rows a, b, c; return the determinant. */
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
    f.determinant_upper = inverse_columns(s[0], s[2], s[4], f.upper);
    UNROLLED
    for (int k = 0; k < 3; k++) {
        const vec row = s[2 * k + 1];
        f.ratio[k] = times(f.upper, row);
        left[k] = subtract(m[2 * k + 1], combine(f.ratio[k], m[0], m[2], m[4]));
    }
    f.determinant_lower = inverse_columns(left[0], left[1], left[2], f.lower);
    return f;
}

/* Solve with the factors: s_i v + m_i w = f_i. */
INLINED void substitute(const vec m[6], const blocks *f, const double right[6], vec *v, vec *w)
{
    const vec even = vector(right[0], right[2], right[4]);
    *w = combine_rows(subtract(vector(right[1], right[3], right[5]), times(f->ratio, even)), f->lower);
    *v = combine_rows(subtract(even, vector(dot(m[0], *w), dot(m[2], *w), dot(m[4], *w))), f->upper);
}

/* Solve with the factors: sum of s_i f_i = force, sum of m_i f_i = torque. */
INLINED void substitute_transposed(const vec m[6], const blocks *f, vec force, vec torque, double forces[6])
{
    const vec even = times(f->upper, force);
    const vec odd = times(f->lower, subtract(torque, combine(even, m[0], m[2], m[4])));
    const vec rest = subtract(even, combine_rows(odd, f->ratio));
    const double all[6] = {rest.x, odd.x, rest.y, odd.y, rest.z, odd.z};
    copy_six(all, forces);
}

/* Condition number, and sign of det J; the sign is 0 if the elimination needs pivoting. */
INLINED double block_condition(const six_struts *now, double characteristic_length, double *sign)
{
    const double square = characteristic_length * characteristic_length;
    const blocks f = eliminate(now->strut, now->moment);
    const vec *a = f.ratio, *m = now->moment, zero = vector(0.0, 0.0, 0.0);
    const double *l = now->length;
    const vec column[3] = {{a[0].x, a[1].x, a[2].x}, {a[0].y, a[1].y, a[2].y}, {a[0].z, a[1].z, a[2].z}};
    double inverse = 0.0, moments = 0.0, condition;
    UNROLLED
    for (int k = 0; k < 6; k++) {
        /* column k of the inverse, up to its sign */
        const vec w = k % 2 ? f.lower[k / 2] : combine_rows(column[k / 2], f.lower);
        const vec v = add(k % 2 ? zero : f.upper[k / 2], combine_rows(vector(dot(m[0], w), dot(m[2], w), dot(m[4], w)), f.upper));
        inverse += l[k] * l[k] * (dot(v, v) + square * dot(w, w));
        moments += dot(m[k], m[k]) / (l[k] * l[k]);
    }
    condition = sqrt((6.0 + moments / square) * inverse) / 6.0;
    *sign = f.determinant_upper * f.determinant_lower > 0.0 ? -1.0 : 1.0; /* without a branch, for lanes.c */
    *sign = fabs(f.determinant_upper) >= COPLANAR * l[0] * l[2] * l[4] ? *sign : 0.0;
    *sign = condition < HUGE_VAL ? *sign : 0.0;
    return condition;
}

/* Squared misfit of six lengths, divided by the largest square that rounding can cause. */
INLINED double closure_error(const double now[6], const double wanted[6])
{
    const vec first = row_of(now), second = row_of(now + 3);
    const vec a = subtract(first, row_of(wanted)), b = subtract(second, row_of(wanted + 3));
    const double allowed = CLOSURE * CLOSURE
                           + CLOSURE_RELATIVE * CLOSURE_RELATIVE * (dot(first, first) + dot(second, second));
    return (dot(a, a) + dot(b, b)) / allowed;
}

/* dL/d(v, w): row i is (u_i, R t_i x u_i). */
static void fill_jacobian(const double base[6][3], const hc_pose *pose, const six_struts *now, double rows[6][6])
{
    for (int i = 0; i < 6; i++) {
        const vec s = now->strut[i], u = vector(s.x / now->length[i], s.y / now->length[i], s.z / now->length[i]);
        store(u, rows[i]);
        store(cross(subtract(add(s, row_of(base[i])), row_of(pose->position)), u), rows[i] + 3);
    }
}

/* Solve a 6 x 6 system in place with pivoting; return the sign of the determinant, 0 for a singular matrix. */
static double solve_six(double a[6][6], double right[6])
{
    double sign = 1.0;
    for (int k = 0; k < 6; k++) {
        int pivot = k;
        for (int i = k + 1; i < 6; i++) {
            if (fabs(a[i][k]) > fabs(a[pivot][k])) {
                pivot = i;
            }
        }
        const double value = a[pivot][k], inverse = 1.0 / value;
        if (!(fabs(value) > SMALLEST_PIVOT)) {
            return 0.0;
        }
        if (pivot != k) {
            const double kept = right[k];
            sign = -sign;
            right[k] = right[pivot];
            right[pivot] = kept;
            for (int j = k; j < 6; j++) {
                const double element = a[k][j];
                a[k][j] = a[pivot][j];
                a[pivot][j] = element;
            }
        }
        sign = value < 0.0 ? -sign : sign;
        for (int i = k + 1; i < 6; i++) {
            const double factor = a[i][k] * inverse;
            for (int j = k + 1; j < 6; j++) {
                a[i][j] -= factor * a[k][j];
            }
            right[i] -= factor * right[k];
        }
    }
    for (int k = 5; k >= 0; k--) {
        double total = right[k];
        for (int j = k + 1; j < 6; j++) {
            total -= a[k][j] * right[j];
        }
        right[k] = total / a[k][k];
    }
    return sign;
}

/* Frobenius condition number of a matrix, and sign of its determinant, with pivoting. */
static double frobenius_condition(double a[6][6], double *sign)
{
    double square = 0.0, inverse_square = 0.0;
    *sign = 0.0;
    for (int k = 0; k < 6; k++) {
        double factors[6][6], column[6];
        for (int i = 0; i < 6; i++) {
            column[i] = i == k ? 1.0 : 0.0;
            square += a[i][k] * a[i][k];
            for (int j = 0; j < 6; j++) {
                factors[i][j] = a[i][j];
            }
        }
        *sign = solve_six(factors, column);
        for (int i = 0; i < 6; i++) {
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

/* Frobenius condition number of J at a pose, and sign of det J; rotations are scaled by the characteristic length. */
static double condition_at(const double base[6][3], const hc_pose *pose, const six_struts *now,
                           double characteristic_length, double *sign)
{
    const double condition = block_condition(now, characteristic_length, sign);
    double jacobian[6][6];
    if (*sign != 0.0) {
        return condition;
    }
    fill_jacobian(base, pose, now, jacobian);
    for (int k = 0; k < 18; k++) {
        jacobian[k / 3][3 + k % 3] /= characteristic_length;
    }
    return frobenius_condition(jacobian, sign);
}

/* Whether each pair of lengths is compatible with the distances between the pair's joints, by the triangle inequality. */
static int lengths_possible(const double base[6][3], const double platform[6][3], const double lengths[6])
{
    for (int i = 0; i < 6; i++) {
        for (int j = 0; j < i; j++) {
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

/* Values by which a solution is accepted, whichever iteration found it: condition number, sign of det J, misfit of the loop
 * closures, and deviation of R from a rotation matrix. */
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

/* Criteria of an accepted solution: largest condition number, and home's sign of det J, 0 for both signs. */
typedef struct {
    double characteristic_length, home_sign, condition;
} judge;

static judge judge_of(const hc_limits *limits)
{
    return (judge){limits->characteristic_length, limits->home_sign, limits->condition};
}

static int certified(const certificate *c, double step, const double lengths[6], const judge *by)
{
    int positive = 1;
    for (int i = 0; i < 6; i++) {
        positive = positive && lengths[i] > 0.0;
    }
    return step < STEP_TOLERANCE && positive && closes(c->misfit, c->flaw) && c->condition <= by->condition
           && (c->sign * by->home_sign > 0.0 || (by->home_sign == 0.0 && c->sign != 0.0));
}

/* Result of a forward solution. */
typedef struct {
    hc_status status;
    int iterations;
    double condition;
} solution;

/* Newton's method with pivoting, for poses at which block elimination fails. */
static hc_status newton(const double base[6][3], const double platform[6][3], const double lengths[6], hc_pose *pose,
                        int *iterations)
{
    double jacobian[6][6], step[6];
    for (*iterations = 1; *iterations <= MAX_ITERATIONS; ++*iterations) {
        const six_struts now = struts_of(base, platform, pose);
        double turn, shrink, size;
        for (int i = 0; i < 6; i++) {
            step[i] = lengths[i] - now.length[i];
        }
        fill_jacobian(base, pose, &now, jacobian);
        if (solve_six(jacobian, step) == 0.0) {
            return HC_SINGULAR;
        }
        size = turn = norm(row_of(step + 3));
        if (!(turn < HUGE_VAL)) {
            return HC_SINGULAR;
        }
        shrink = turn <= MAX_ROTATION_STEP ? 1.0 : MAX_ROTATION_STEP / turn;
        for (int k = 0; k < 3; k++) {
            pose->position[k] += shrink * step[k];
            size = fmax(size, fabs(step[k]));
        }
        rotate(pose->rotation, shrink * step[3], shrink * step[4], shrink * step[5]);
        if (size < STEP_TOLERANCE) {
            orthonormalise(pose->rotation);
            const mat r = three_rows((const double(*)[3])pose->rotation);
            const six_struts settled = struts_at(base, platform, row_of(pose->position), &r);
            return closes(closure_error(settled.length, lengths), rotation_error(&r)) ? HC_OK : HC_NOT_CONVERGED;
        }
    }
    *iterations = MAX_ITERATIONS;
    return HC_NOT_CONVERGED;
}

/* Whether the lengths are finite and above zero, and the guess is finite. */
static int usable(const double lengths[6], const hc_pose *guess)
{
    for (int i = 0; i < 6; i++) {
        if (!(lengths[i] > 0.0 && lengths[i] < HUGE_VAL)) {
            return 0;
        }
    }
    for (int k = 0; k < 9; k++) {
        if (!(finite_number(guess->position[k / 3]) && finite_number(guess->rotation[k / 3][k % 3]))) {
            return 0;
        }
    }
    return 1;
}

/* Forward kinematics with pivoting; the status tells why it failed. */
static solution solve_carefully(const double base[6][3], const double platform[6][3], const double lengths[6],
                                const judge *by, hc_pose *pose)
{
    hc_pose trial = *pose;
    solution found = {HC_OK, 0, NAN};
    double sign;
    if (!usable(lengths, pose)) {
        found.status = HC_NOT_FINITE;
        return found;
    }
    if (!lengths_possible(base, platform, lengths)) {
        found.status = HC_UNREACHABLE;
        return found;
    }
    orthonormalise(trial.rotation); /* the guess may be rounded, which Newton's small last step would not correct */
    found.status = newton(base, platform, lengths, &trial, &found.iterations);
    if (found.status != HC_OK) {
        return found;
    }
    const six_struts now = struts_of(base, platform, &trial);
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

/* Take one Newton step on the six loop closures; return its size, m and rad. The rows are multiplied by the struts' lengths,
 * which saves a division and does not change the step. */
INLINED double newton_step(const double base[6][3], const double platform[6][3], const double lengths[6], vec *p,
                                 mat *r)
{
    const six_struts now = struts_at(base, platform, *p, r);
    const blocks f = eliminate(now.strut, now.moment);
    double misfit[6], ratio, shrink;
    vec v, w;
    UNROLLED
    for (int i = 0; i < 6; i++) {
        misfit[i] = now.length[i] * (lengths[i] - now.length[i]);
    }
    substitute(now.moment, &f, misfit, &v, &w);
    ratio = MAX_ROTATION_STEP / norm(w);
    shrink = ratio >= 1.0 ? 1.0 : ratio;
    *p = add(*p, scale(shrink, v));
    *r = turned(r, scale(shrink, w));
    return sqrt(dot(v, v) + dot(w, w));
}

/* Solve the six loop closures by Newton's method from a guess; only a solution overwrites the guess. */
static solution solve_pose(const double base[6][3], const double platform[6][3], const double lengths[6],
                           const judge *by, hc_pose *pose)
{
    vec p = row_of(pose->position);
    mat r = three_rows((const double(*)[3])pose->rotation);
    solution found = {HC_OK, 0, NAN};
    certificate c;
    double step = HUGE_VAL;
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
    set_rotation(pose->rotation, &r);
    return found;
}
