/* SPDX-License-Identifier: Apache-2.0
 *
 * The polish of a 6-3 machine's assembly modes: from start angles to triangles that close. Two struts hold their platform
 * joint on a circle, centre + p cos(angle) + q sin(angle); the platform is a triangle of given sides. What counts as a
 * mode is decided by closure alone. doc/theory.md, 7.
 */
#include "core.h"

#define MOST_STEPS 60 /* more than a few are needed only at multiple roots, where the minimiser converges linearly */

/* Three circles, rows (centre, p, q), the sides between their joints, and the joints at some angles. */
typedef struct {
    const double (*circles)[3][3];
    const double *sides;
    vec points[3];
    double errors[3];      /* (|T_i - T_j|^2 - a^2) / 2a, m */
    double jacobian[3][3]; /* of the errors by the angles */
} triangle;

/* Place the joints at three angles; returns the sum of the squared errors. */
static double close_triangle(triangle *t, const double angles[3])
{
    vec tangents[3];
    double cost = 0.0;
    for (int i = 0; i < 3; i++) {
        double c, s;
        const vec centre = row_of(t->circles[i][0]), p = row_of(t->circles[i][1]), q = row_of(t->circles[i][2]);
        sine_cosine(angles[i], &s, &c);
        t->points[i] = add(add(centre, scale(c, p)), scale(s, q));
        tangents[i] = subtract(scale(c, q), scale(s, p));
    }
    for (int i = 0; i < 3; i++) {
        const int j = (i + 1) % 3;
        const vec apart = subtract(t->points[i], t->points[j]);
        t->errors[i] = (dot(apart, apart) - t->sides[i] * t->sides[i]) / (2.0 * t->sides[i]);
        t->jacobian[i][i] = dot(apart, tangents[i]) / t->sides[i];
        t->jacobian[i][j] = -dot(apart, tangents[j]) / t->sides[i];
        cost += t->errors[i] * t->errors[i];
    }
    return cost;
}

/* (J'J + damping tr(J'J))^-1 J' errors, rad; zero where that has no inverse. */
static vec damped_step(const triangle *t, double damping)
{
    const double(*j)[3] = t->jacobian;
    const vec x = vector(j[0][0], j[1][0], j[2][0]), y = vector(j[0][1], j[1][1], j[2][1]);
    const vec z = vector(j[0][2], j[1][2], j[2][2]), errors = row_of(t->errors);
    const double xx = dot(x, x), yy = dot(y, y), zz = dot(z, z), xy = dot(x, y), xz = dot(x, z), yz = dot(y, z);
    const double added = damping * (xx + yy + zz);
    vec columns[3];
    const double determinant = inverse_columns(vector(xx + added, xy, xz), vector(xy, yy + added, yz),
                                               vector(xz, yz, zz + added), columns);
    if (!(fabs(determinant) > 0.0)) {
        return vector(0.0, 0.0, 0.0);
    }
    return combine_rows(vector(dot(x, errors), dot(y, errors), dot(z, errors)), columns);
}

/* Minimise the side errors over the angles, in place (Levenberg-Marquardt); returns the largest, m. A minimiser rather than
 * Newton: at a double root the Jacobian is singular, where Newton would be thrown out of reach by rounding. */
static double settle(const double (*circles)[3][3], const double sides[3], double angles[3], double points[9])
{
    const double rounding = 2e-16 * (sides[0] + sides[1] + sides[2]);
    triangle t = {circles, sides, {{0.0, 0.0, 0.0}}, {0.0, 0.0, 0.0}, {{0.0}}};
    double cost = close_triangle(&t, angles), damping = 1e-6;
    for (int count = 0; count < MOST_STEPS && cost > rounding * rounding && damping <= 1e6; count++) {
        const vec step = damped_step(&t, damping);
        const double trial[3] = {angles[0] - step.x, angles[1] - step.y, angles[2] - step.z};
        const double next_cost = close_triangle(&t, trial);
        if (next_cost < cost) {
            for (int i = 0; i < 3; i++) {
                angles[i] = trial[i];
            }
            cost = next_cost;
            damping = 0.1 * damping;
        } else {
            damping = 10.0 * fmax(damping, 1e-12);
            close_triangle(&t, angles);
        }
    }
    for (int i = 0; i < 3; i++) {
        store(t.points[i], points + 3 * i);
    }
    return fmax(fabs(t.errors[0]), fmax(fabs(t.errors[1]), fabs(t.errors[2])));
}

/* Minimise the side errors of triangles over three angles each, n x 3, in place; circles 3 x 3 x 3 (centre, p, q), sides 3.
 * Writes the corners, n x 9, m, and each one's largest side error, m. */
void hc_settle_many(const double *circles, const double *sides, size_t count, double *angles, double *points,
                    double *errors)
{
    for (size_t n = 0; n < count; n++) {
        errors[n] = settle((const double(*)[3][3])circles, sides, angles + 3 * n, points + 9 * n);
    }
}
