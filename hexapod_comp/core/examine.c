/* SPDX-License-Identifier: Apache-2.0
 *
 * The quantities that have a limit at given poses, and the first limit that each pose breaks.
 */
#include "core.h"

/* Write all quantities of a pose that have a limit; `lengths`, m: nominal or compensated strut lengths. */
static void examine(const double base[6][3], const hc_pose *pose, const six_struts *now, const double lengths[6],
                    const hc_limits *limits, hc_quantities *found)
{
    copy_six(lengths, found->lengths);
    joint_cosines(pose, now, limits, found->cosines);
    nearest_struts(base, now, limits, found->distances, found->nearest);
    found->condition = condition_at(base, pose, now, limits->characteristic_length, &found->sign);
}

/* Write the quantities of one pose of the nominal machine. */
void hc_examine(const double *base, const double *platform, const hc_limits *limits, const double *position,
                const double *rotation, hc_quantities *found)
{
    const double(*b)[3] = (const double(*)[3])base;
    const hc_pose pose = pose_of(position, rotation);
    const six_struts now = struts_of(b, (const double(*)[3])platform, &pose);
    examine(b, &pose, &now, now.length, limits, found);
}

/* Write the nominal and the compensated quantities, n x 2, of a sequence of poses. `low` and `sense` (9) are the state of
 * motion, updated from pose to pose; if `independent` is 1, the given directions hold at every pose. `flags`: HC_OK;
 * HC_NOT_CONVERGED: no compensated quantities; HC_OUTSIDE_FIELD: the field's value was held at the boundary of its box. */
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

/* Write the first limit that each pose breaks, an hc_status, and the struts that break it, n x 2, -1 for none. If there are
 * fewer rotations than positions, the last rotation holds for all further positions. */
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
