/* SPDX-License-Identifier: Apache-2.0
 *
 * Functions for studies, checks, calibrations and the virtual machine, on arrays and for one pose, with the arithmetic of
 * hexapod_comp.h. Only their definitions, in the files that hexapod_batch.c includes, declare them: build.py reads these files.
 *
 * Arrays are contiguous, by rows: positions n x 3, m, and rotations n x 9, of `platform` in `base`; lengths and commands n x 6,
 * m; base, platform and their axes 6 x 3; senses n x 9, directions of motion as in hc_last. The functions do not check
 * their arguments; hexapod_comp/core/batch.py checks them.
 */
#ifndef HEXAPOD_BATCH_H
#define HEXAPOD_BATCH_H

#include "hexapod_comp.h"

/* The quantities of a pose that have a limit, nominal or compensated. */
typedef struct {
    double lengths[6];    /* of the struts, m */
    double cosines[2][6]; /* cosines of the struts' angles to their joints' neutral directions, at base and platform */
    double distances[6];  /* distance of each strut's axis to that of the nearest strut, m; infinite: none is checked */
    double nearest[6];    /* index of this nearest strut, -1: none */
    double condition;     /* condition number */
    double sign;          /* sign of det J */
} hc_quantities;

/* How far a tool can move in one direction, m or rad. */
typedef struct {
    double inside;      /* largest tried distance within all limits; below 0 if the start breaks a limit */
    double outside;     /* smallest tried distance that breaks a limit; infinite: none does */
    hc_answer refused;  /* the answer at the distance `outside` */
} hc_way;

/* State and limits of six simulated drives. */
typedef struct {
    double tick;                    /* time of one tick, s */
    double lag;                     /* following error at constant speed divided by the speed, s; 0: no delay */
    double max_speed;               /* m/s */
    double max_acceleration;        /* m/s2 */
    double step;                    /* resolution of the motors, m; 0: not stepped */
    double stops[6][2];             /* lower and upper stop, m */
    double half_play[6];            /* half of the backlash, m */
    double position[6], speed[6];   /* reference of each drive, m and m/s */
    double motor[6], play[6];       /* motor position, and by how much the nut is behind the motor, m */
    int stuck[6];                   /* 1: the drive does not move */
    int stopped[6];                 /* 1: the drive has reached a stop; the caller clears it */
} hc_drives;

#endif
