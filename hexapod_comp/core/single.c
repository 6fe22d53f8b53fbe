/* SPDX-License-Identifier: Apache-2.0
 *
 * Functions for Python on one pose, one point or six struts. Rotations are nine doubles, by rows.
 */
#include "core.h"

/* The largest element of |R'R - 1|; infinite for a left-handed matrix. */
double hc_rotation_flaw(const double *r)
{
    const vec x = row_of(r), y = row_of(r + 3), z = row_of(r + 6);
    double flaw = 0.0;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j <= i; j++) {
            const double product = r[i] * r[j] + r[3 + i] * r[3 + j] + r[6 + i] * r[6 + j];
            const double part = fabs(product - (i == j ? 1.0 : 0.0));
            if (!(part <= flaw)) {
                flaw = part;
            }
        }
    }
    return dot(cross(x, y), z) < 0.0 ? HUGE_VAL : flaw;
}

/* Convert position and quaternion to position and rotation matrix; refuses the same numbers as hc_command. */
hc_status hc_read_pose(const double numbers[7], double *position, double *rotation)
{
    hc_pose pose;
    const hc_status status = read_pose(numbers, &pose);
    if (status == HC_OK) {
        write_pose(&pose, position, rotation);
    }
    return status;
}

/* Write the unit quaternion x, y, z, w of a rotation, computed from its largest component. */
void hc_quaternion(const double *rotation, double q[4])
{
    const double(*r)[3] = (const double(*)[3])rotation;
    const double trace = r[0][0] + r[1][1] + r[2][2];
    double largest = trace;
    int i = 3;
    for (int n = 0; n < 3; n++) {
        if (r[n][n] > largest) {
            i = n;
            largest = r[n][n];
        }
    }
    if (i == 3) {
        const double root = 2.0 * sqrt(1.0 + trace);
        q[0] = (r[2][1] - r[1][2]) / root;
        q[1] = (r[0][2] - r[2][0]) / root;
        q[2] = (r[1][0] - r[0][1]) / root;
        q[3] = 0.25 * root;
        return;
    }
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    const double root = 2.0 * sqrt(1.0 + r[i][i] - r[j][j] - r[k][k]);
    q[i] = 0.25 * root;
    q[j] = (r[j][i] + r[i][j]) / root;
    q[k] = (r[k][i] + r[i][k]) / root;
    q[3] = (r[k][j] - r[j][k]) / root;
}

/* Replace R by exp(w) R. */
void hc_rotate(double *rotation, double x, double y, double z)
{
    rotate((double(*)[3])rotation, x, y, z);
}

/* Solve a 6 x 6 system in place; return the sign of its determinant, 0 for a singular matrix. */
double hc_solve_linear(double *matrix, double *right)
{
    return solve_six((double(*)[6])matrix, right);
}

/* Return the first limit that a pose and its lengths break; write the strut that breaks the limit, -1 for none, and its value. */
hc_status hc_check_stage(const double *base, const double *platform, const double *position, const double *rotation,
                         const double *lengths, const hc_limits *limits, int *strut, double *value)
{
    double condition;
    const double(*b)[3] = (const double(*)[3])base;
    const hc_pose pose = pose_of(position, rotation);
    const six_struts now = struts_of(b, (const double(*)[3])platform, &pose);
    const finding f = check_stage(b, &pose, &now, lengths, limits, &condition);
    *strut = f.strut;
    *value = f.value;
    return f.status;
}

/* Update the directions of motion (9) with new values of the measured point's x, y, z and of the struts. */
void hc_follow_nine(const double *values, double axis_threshold, double strut_threshold, double *low, double *sense)
{
    for (int i = 0; i < 9; i++) {
        follow(values[i], i < 3 ? axis_threshold : strut_threshold, low, sense, i);
    }
}

/* Update the directions of motion of the measured point, at a platform pose, along the three axes. */
void hc_follow_point(const double *position, const double *rotation, const double probe[3], double threshold, double low[9],
                     double sense[9])
{
    const hc_pose pose = pose_of(position, rotation);
    follow_point(point_at(&pose, probe), threshold, low, sense);
}

/* Write the six error components of a field at a point; return whether the point is outside the field's box. */
int hc_field_at(const hc_field *field, const double *point, const double *sense, double *error)
{
    return field_at(field, row_of(point), sense, error);
}

/* Write six lengths, and their velocities since the last call, which was `period`, s, ago; period 0: at rest. If a velocity would
 * be above `fastest`, all are reduced in proportion. */
void hc_write_lengths(const double *lengths, double period, double fastest, double *position, double *velocity)
{
    for (int i = 0; i < 6 && period > 0.0; i++) {
        period = fmax(period, fabs(lengths[i] - position[i]) / fastest);
    }
    for (int i = 0; i < 6; i++) {
        velocity[i] = period > 0.0 ? (lengths[i] - position[i]) / period : 0.0;
        position[i] = lengths[i];
    }
}

/* Update joints and growth after temperatures, humidity or lags were written into the state directly. */
void hc_place(hc_state *state)
{
    place_machine(state);
}
