/* SPDX-License-Identifier: Apache-2.0
 *
 * What is left of each limit along poses, and what limits them.
 */
#include "core.h"

/* All limited quantities of a pose with its lengths, nominal or compensated. */
static void examine(const double base[6][3], const hc_pose *pose, const six_struts *now, const double lengths[6],
                    const hc_limits *limits, hc_quantities *found)
{
    copy_six(lengths, found->lengths);
    joint_cosines(pose, now, limits, found->cosines);
    nearest_struts(base, now, limits, found->distances, found->nearest);
    found->condition = condition_at(base, pose, now, limits->characteristic_length, &found->sign);
}

/* The limited quantities of one pose, nominal. */
void hc_examine(const double *base, const double *platform, const hc_limits *limits, const double *position,
                const double *rotation, hc_quantities *found)
{
    const double(*b)[3] = (const double(*)[3])base;
    const hc_pose pose = pose_of(position, rotation);
    const six_struts now = struts_of(b, (const double(*)[3])platform, &pose);
    examine(b, &pose, &now, now.length, limits, found);
}

/* n x 2 quantities, nominal and compensated, of poses that follow each other or are `independent`, each with the
 * directions given; `low` and `sense` (9) are the motion, updated. Of `flags`, HC_NOT_CONVERGED says that the second is not
 * written, HC_OUTSIDE_FIELD that the field's value was held at the boundary. */
void hc_examine_many(const hc_state *state, size_t count, const double *positions, const double *rotations,
                     int independent, double *low, double *sense, hc_quantities *found, int *flags)
{
    const hc_model *model = state->model;
    for (size_t n = 0; n < count; n++) {
        const hc_pose pose = pose_of(positions + 3 * n, rotations + 9 * n);
        six_struts now = struts_of(model->base.joints, model->platform.joints, &pose);
        double commands[6];
        hc_pose q;
        int outside;
        for (int i = 0; independent && i < 9; i++) {
            low[i] = NAN;
        }
        examine(model->base.joints, &pose, &now, now.length, &model->limits, found + 2 * n);
        if (!run_backwards(state, &pose, low, sense, &q, &now, commands, &outside)) {
            flags[n] = HC_NOT_CONVERGED;
            continue;
        }
        flags[n] = outside ? HC_OUTSIDE_FIELD : HC_OK;
        examine(state->base_joints, &q, &now, commands, &model->limits, found + 2 * n + 1);
    }
}

/* The first limit that each pose breaks, a hc_status, and the struts concerned, n x 2, -1 for none. The last rotation serves
 * all poses that have none. */
void hc_check_poses(const double *base, const double *platform, const hc_limits *limits, size_t count,
                    const double *positions, size_t rotation_count, const double *rotations, signed char *findings,
                    signed char *struts)
{
    const double(*b)[3] = (const double(*)[3])base, (*t)[3] = (const double(*)[3])platform;
    for (size_t n = 0; n < count; n++) {
        const size_t turned_as = n < rotation_count ? n : rotation_count - 1;
        const hc_pose pose = pose_of(positions + 3 * n, rotations + 9 * turned_as);
        const six_struts now = struts_of(b, t, &pose);
        double condition;
        const finding f = check_stage(b, &pose, &now, now.length, limits, &condition);
        findings[n] = (signed char)f.status;
        struts[2 * n] = (signed char)f.strut;
        struts[2 * n + 1] = (signed char)f.other;
    }
}
