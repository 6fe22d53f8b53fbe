/* SPDX-License-Identifier: Apache-2.0
 *
 * What studies, checks, calibrations and the virtual machine compute, on arrays and for one pose, with the arithmetic of
 * hexapod_comp.h. The functions stand in the files that hexapod_batch.c includes, and nowhere else: build.py reads their heads.
 *
 * Arrays are contiguous, by rows: positions n x 3, m, rotations n x 9, both `platform` in `base`; lengths and commands n x 6,
 * m; base, platform and their axes 6 x 3; senses n x 9, directions of motion as in hc_last. Nothing here checks them:
 * hexapod_comp/core/batch.py does.
 */
#ifndef HEXAPOD_BATCH_H
#define HEXAPOD_BATCH_H

#include "hexapod_comp.h"

enum {
    HC_MOST_ITERATIONS = 30, /* Newton's, of the forward kinematics */
    HC_MOST_HARMONICS = 4    /* of a screw's periodic error */
};

/* The limited quantities of a pose, nominal or compensated. */
typedef struct {
    double lengths[6];    /* m */
    double cosines[2][6]; /* of the struts' angles to the neutral directions of their joints, at the base and at the platform */
    double distances[6];  /* m, to the nearest other strut that counts; infinite where there is none */
    double nearest[6];    /* its index, -1 for none */
    double condition;
    double sign; /* of det J */
} hc_quantities;

/* How far a tool may go one way. */
typedef struct {
    double inside;      /* the furthest that is allowed, less than 0 where the pose itself is not */
    double outside;     /* the nearest that is not, infinite where there is none */
    hc_answer refused;  /* what was found there, and the command that was tried */
} hc_way;

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

#endif
