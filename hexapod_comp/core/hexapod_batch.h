/* SPDX-License-Identifier: Apache-2.0
 *
 * What studies, checks, calibrations and the virtual machine compute on arrays, with the arithmetic of hexapod_comp.h.
 *
 * Arrays are contiguous, by rows: positions n x 3, m, rotations n x 9, both `platform` in `base`; lengths and commands n x 6,
 * m; base, platform and their axes 6 x 3; senses n x 9, directions of motion as in hc_last. Nothing here checks them:
 * hexapod_comp/core/batch.py does.
 */
#ifndef HEXAPOD_BATCH_H
#define HEXAPOD_BATCH_H

#include "hexapod_comp.h"

#include <stddef.h>

/* Inverse kinematics: |P + R t - b|. */
void hc_strut_lengths_many(const double *base, const double *platform, size_t count, const double *positions,
                           const double *rotations, double *lengths);

/* Forward kinematics: Newton from the poses given, which solutions overwrite. A solution must have a condition number of at
 * most `largest_condition` and home's sign of det J, 0 for any. `outcomes` are hc_status; `conditions` are NaN where
 * there is none. */
void hc_solve_pose_many(const double *base, const double *platform, size_t count, const double *lengths, double *positions,
                        double *rotations, double characteristic_length, double home_sign, double largest_condition,
                        int *outcomes, int *iterations, double *conditions);

/* dL/d(v, w), n x 6 x 6, twist in `base`: row i is (u_i, R t_i x u_i). */
void hc_jacobian_many(const double *base, const double *platform, size_t count, const double *positions,
                      const double *rotations, double *jacobians);

/* Condition numbers of the Jacobian, rotations divided by the characteristic length, and signs of det J. */
void hc_condition_many(const double *base, const double *platform, size_t count, const double *positions,
                       const double *rotations, double characteristic_length, double *conditions, double *signs);

/* From each pose to another: displacement of a point of the platform, and rotation vector, along the columns of `axes`;
 * 6 x n, m and rad. NaN after exactly half a turn, whose axis could point either way. */
void hc_motions_many(size_t count, const double *positions, const double *rotations, const double *to_positions,
                     const double *to_rotations, const double *point, const double *axes, double *motions);

/* Angles about the struts from the base's cardan axes to the platform's, n x 6, rad. */
void hc_screw_twists(const double *base, const double *platform, const double *base_axes, const double *platform_axes,
                     size_t count, const double *positions, const double *rotations, double *twists);

/* Error of a strut at commands, without backlash and growth: m, and its slope. */
void hc_strut_errors(const hc_state *state, int strut, double sense, size_t count, const double *commands, double *errors,
                     double *slopes);

/* Commands that give a strut real lengths, m; `shift` for its screw's rotation. */
void hc_strut_commands(const hc_state *state, int strut, double sense, double shift, size_t count, const double *lengths,
                       double *commands);

/* Lower end of the window, and direction of motion, after each of some values that follow each other. */
void hc_follow(double threshold, size_t count, const double *values, double *low, double *sense);

/* The model backwards, each pose by itself, its directions of motion given: what to command. `solved` is 0 where the field
 * cannot be undone. */
void hc_backwards_many(const hc_state *state, size_t count, const double *positions, const double *rotations,
                       const double *senses, double *model_positions, double *model_rotations, double *commands,
                       int *solved);

/* The model forwards: where the platform goes. Model poses are guesses, and solutions where the outcome is HC_OK; only
 * there the poses are written. */
void hc_forwards_many(const hc_state *state, size_t count, const double *commands, const double *senses,
                      double *model_positions, double *model_rotations, double *positions, double *rotations,
                      int *outcomes, double *conditions);

/* The limited quantities of a pose, nominal or compensated. */
typedef struct {
    double lengths[6];    /* m */
    double cosines[2][6]; /* of the struts' angles to the neutral directions of their joints, at the base and at the platform */
    double distances[6];  /* m, to the nearest other strut that counts; infinite where there is none */
    double nearest[6];    /* its index, -1 for none */
    double condition;
    double sign; /* of det J */
} hc_quantities;

void hc_examine(const double *base, const double *platform, const hc_limits *limits, const hc_pose *pose,
                hc_quantities *found);

/* n x 2 quantities, nominal and compensated, of poses that follow each other or are `independent`, each with the
 * directions given; `low` and `sense` (9) are the motion, updated. Of `flags`, HC_NOT_CONVERGED says that the second is not written, HC_OUTSIDE_FIELD that the
 * field's value was held at the boundary. */
void hc_examine_many(const hc_state *state, size_t count, const double *positions, const double *rotations,
                     int independent, double *low, double *sense, hc_quantities *found, int *flags);

/* The first limit that each pose breaks, a hc_status, and the struts concerned, n x 2, -1 for none. The last rotation serves
 * all poses that have none. */
void hc_check_poses(const double *base, const double *platform, const hc_limits *limits, size_t count,
                    const double *positions, size_t rotation_count, const double *rotations, signed char *findings,
                    signed char *struts);

/* How far a tool may go one way. */
typedef struct {
    double inside;      /* the furthest that is allowed, less than 0 where the pose itself is not */
    double outside;     /* the nearest that is not, infinite where there is none */
    hc_answer refused;  /* what was found there, and the command that was tried */
} hc_way;

/* From a tool pose in `frame` along the unit vector `shift`, or about `turn`, the other one being 0, in steps and up to
 * `longest`, m or rad. `state` had no command yet, so that poses are judged one by one. */
void hc_go(const hc_state *state, const hc_pose *tool, const hc_pose *frame, const double shift[3], const double turn[3],
           double step, double longest, hc_way *way);

/* Minimise the side errors of triangles over three angles each, n x 3, in place; circles 3 x 3 x 3 (centre, p, q), sides 3.
 * Writes the corners, n x 9, m, and each one's largest side error, m. */
void hc_settle_many(const double *circles, const double *sides, size_t count, double *angles, double *points,
                    double *errors);

/* Six drives at work. */
typedef struct {
    double tick, lag;               /* s; a lag of 0: the motors are where the commands are */
    double max_speed;               /* m/s */
    double max_acceleration;        /* m/s2 */
    double step;                    /* m, 0: none */
    double stops[6][2];             /* m */
    double half_play[6];            /* m */
    double position[6], speed[6];   /* of the references, m and m/s */
    double motor[6], play[6];       /* m; the nut stands at motor - play */
    int stuck[6];
    int stopped[6];                 /* a drive was asked, or knocked, to go beyond a stop; stays until you clear it */
} hc_drives;

/* Some ticks towards six commands. A drive brakes for its stops as for any command; what still runs into one (a jump, a
 * command turned round too late) is stopped there dead. `sense` (9): directions of motion, 3 to 8 are written. */
void hc_run_drives(hc_drives *drives, const double commands[6], long ticks, double sense[9]);

/* Follow the measured point of a platform pose along the three axes. */
void hc_follow_point(const hc_pose *pose, const double probe[3], double threshold, double low[9], double sense[9]);

#endif
