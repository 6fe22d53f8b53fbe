/* SPDX-License-Identifier: Apache-2.0
 *
 * One pose, one point, one strut at a time: what Python asks of the core beside a compensator and batches. Rotations are nine
 * doubles, by rows; nothing here checks arrays: hexapod_comp/core/single.py does.
 */
#ifndef HEXAPOD_SINGLE_H
#define HEXAPOD_SINGLE_H

#include "hexapod_comp.h"

enum {
    HC_MOST_ITERATIONS = 30, /* Newton's, of the forward kinematics */
    HC_MOST_HARMONICS = 4    /* of a screw's periodic error */
};

/* The largest element of |R'R - 1|, infinite for a left-handed matrix. */
double hc_rotation_flaw(const double *rotation);

/* A pose out of position and quaternion, refused as in hc_command. */
hc_status hc_read_pose(const double numbers[7], double *position, double *rotation);

void hc_quaternion(const double *rotation, double quaternion[4]);

/* Replace R by exp(w) R. */
void hc_rotate(double *rotation, double x, double y, double z);

/* Remove the rounding that products leave in a rotation. */
void hc_orthonormalise(double *rotation);

/* Solve a 6 x 6 system in place; returns the sign of its determinant, 0 for a singular matrix. */
double hc_solve_linear(double *matrix, double *right);

/* Check lengths and pose of one stage; `struts`: which one, and a second one, -1 for none. */
hc_status hc_check_stage(const double *base, const double *platform, const double *position, const double *rotation,
                         const double *lengths, const hc_limits *limits, int struts[2], double *value, double *condition);

/* The smallest distance between the segments a-b and c-d. */
double hc_segment_distance(const double a[3], const double b[3], const double c[3], const double d[3]);

/* Directions of motion and windows (9) after values of the measured point's axes and of the struts (9). */
void hc_follow_nine(const double *values, double axis_threshold, double strut_threshold, double *low, double *sense);

/* Six components of a field at a point; returns whether that is outside its box. */
int hc_field_at(const hc_field *field, const double *point, const double *sense, double *error);

/* Real length of a strut for a command, m. */
double hc_actual_length(const hc_state *state, int strut, double command, double sense, double shift);

/* Write six lengths, and as velocities their change since the last ones over a period, s, 0: at rest; at most `fastest`, then
 * all in proportion. */
void hc_write_lengths(const double *lengths, double period, double fastest, double *position, double *velocity);

/* Take temperatures, humidity and lags that somebody has written into the state. */
void hc_place(hc_state *state);

/* The model backwards: HC_OK, HC_NOT_CONVERGED, or HC_OUTSIDE_FIELD where the field is held at the boundary of its box; low
 * and sense (9) go on. */
hc_status hc_backwards(const hc_state *state, const double *position, const double *rotation, double *low, double *sense,
                       double *model_position, double *model_rotation, double *commands);

#endif
