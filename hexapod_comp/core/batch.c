/* SPDX-License-Identifier: Apache-2.0
 *
 * Functions of the core on arrays of poses, for studies, checks and calibrations.
 */
#include "core.h"

/* Write the Jacobians dL/d(v, w), n x 6 x 6, for twists (v, w) in `base`: row i is (u_i, R t_i x u_i). */
void hc_jacobian_many(const double *base, const double *platform, size_t count, const double *positions,
                      const double *rotations, double *jacobians)
{
    const double(*b)[3] = (const double(*)[3])base, (*t)[3] = (const double(*)[3])platform;
    for (size_t n = 0; n < count; n++) {
        const hc_pose pose = pose_of(positions + 3 * n, rotations + 9 * n);
        const six_struts now = struts_of(b, t, &pose);
        fill_jacobian(b, &pose, &now, (double(*)[6])(jacobians + 36 * n));
    }
}

/* Write the condition numbers of the Jacobian, with rotations scaled by the characteristic length, and the signs of det J. */
void hc_condition_many(const double *base, const double *platform, size_t count, const double *positions,
                       const double *rotations, double characteristic_length, double *conditions, double *signs)
{
    const double(*b)[3] = (const double(*)[3])base, (*t)[3] = (const double(*)[3])platform;
    for (size_t n = 0; n < count; n++) {
        const hc_pose pose = pose_of(positions + 3 * n, rotations + 9 * n);
        const six_struts now = struts_of(b, t, &pose);
        conditions[n] = condition_at(b, &pose, &now, characteristic_length, &signs[n]);
    }
}

/* Write the motions (6 x n) from n poses to n other poses along the columns of `axes`: displacement of a point of the platform,
 * m, and rotation vector, rad; NaN for a turn by exactly 180 degrees, whose axis has no defined sign. Rotation matrices are
 * subtracted first, so that a small motion is as accurate as the two poses. */
void hc_motions_many(size_t count, const double *positions, const double *rotations, const double *to_positions,
                     const double *to_rotations, const double *point, const double *axes, double *motions)
{
    const vec t = row_of(point);
    for (size_t n = 0; n < count; n++) {
        const hc_pose from = pose_of(positions + 3 * n, rotations + 9 * n);
        const hc_pose to = pose_of(to_positions + 3 * n, to_rotations + 9 * n);
        const mat r = three_rows(from.rotation), s = three_rows(to.rotation);
        const vec x = subtract(s.row[0], r.row[0]), y = subtract(s.row[1], r.row[1]), z = subtract(s.row[2], r.row[2]);
        const vec shift = add(subtract(row_of(to.position), row_of(from.position)), vector(dot(x, t), dot(y, t), dot(z, t)));
        const vec twice = vector(dot(z, r.row[1]) - dot(y, r.row[2]), dot(x, r.row[2]) - dot(z, r.row[0]),
                                 dot(y, r.row[0]) - dot(x, r.row[1]));
        const double sine = 0.5 * norm(twice), versine = 0.25 * (dot(x, x) + dot(y, y) + dot(z, z));
        const double share = sine > 1e-4 || versine > 1.0
                                 ? 0.5 * arc_tangent(sine, 1.0 - versine) / sine
                                 : 0.5 + sine * sine / 12.0; /* the series' next term is below 1e-17 */
        const vec turn_by = scale(share, twice);
        for (int k = 0; k < 3; k++) {
            const vec along_axis = vector(axes[k], axes[3 + k], axes[6 + k]);
            motions[(size_t)k * count + n] = dot(along_axis, shift);
            motions[(size_t)(3 + k) * count + n] = dot(along_axis, turn_by);
        }
    }
}

/* Write the angles about the struts from the base's cardan axes to the platform's, n x 6, rad. */
void hc_screw_twists(const double *base, const double *platform, const double *base_axes, const double *platform_axes,
                     size_t count, const double *positions, const double *rotations, double *twists)
{
    const double(*b)[3] = (const double(*)[3])base, (*t)[3] = (const double(*)[3])platform;
    for (size_t n = 0; n < count; n++) {
        const hc_pose pose = pose_of(positions + 3 * n, rotations + 9 * n);
        const six_struts now = struts_of(b, t, &pose);
        for (int i = 0; i < 6; i++) {
            twists[6 * n + (size_t)i] = screw_twist(base_axes + 3 * i, platform_axes + 3 * i, &pose, &now, i);
        }
    }
}

/* Write a strut's length errors at n commands, m, without constant backlash and growth, and their slopes over the command. */
void hc_strut_errors(const hc_state *state, int strut, double sense, size_t count, const double *commands, double *errors,
                     double *slopes)
{
    const hc_strut *of = &state->model->struts[strut];
    for (size_t n = 0; n < count; n++) {
        errors[n] = error_at(state->model, strut, commands[n], screw_turn(of, commands[n]), sense, &slopes[n]);
    }
}

/* Write the commands that give a strut the actual `lengths`, m; `shift`, m: the result of screw_shift. */
void hc_strut_commands(const hc_state *state, int strut, double sense, double shift, size_t count, const double *lengths,
                       double *commands)
{
    for (size_t n = 0; n < count; n++) {
        commands[n] = command_for_length(state, strut, lengths[n], sense, shift);
    }
}

/* Write, after each value of a sequence, the value's direction of motion and the lower end of its dead band. */
void hc_follow(double threshold, size_t count, const double *values, double *low, double *sense)
{
    double windows[9] = {NAN}, directions[9] = {0.0};
    for (size_t n = 0; n < count; n++) {
        sense[n] = follow(values[n], threshold, windows, directions, 0);
        low[n] = windows[0];
    }
}

/* The model backwards: write the commands for n poses. Each pose updates its own row of `low` and `sense` (n x 9); where `low` is
 * NAN, `sense` does not change. Outcomes: HC_OK; HC_NOT_CONVERGED: the field could not be undone; HC_OUTSIDE_FIELD: the
 * field's value was held at the boundary of its box. */
void hc_backwards_many(const hc_state *state, size_t count, const double *positions, const double *rotations, double *low,
                       double *sense, double *model_positions, double *model_rotations, double *commands, int *outcomes)
{
    for (size_t n = 0; n < count; n++) {
        const hc_pose pose = pose_of(positions + 3 * n, rotations + 9 * n);
        hc_pose q;
        six_struts now;
        int outside = 0;
        const int solved = run_backwards(state, &pose, low + 9 * n, sense + 9 * n, &q, &now, commands + 6 * n, &outside);
        outcomes[n] = !solved ? HC_NOT_CONVERGED : outside ? HC_OUTSIDE_FIELD : HC_OK;
        write_pose(&q, model_positions + 3 * n, model_rotations + 9 * n);
    }
}

/* The model forwards: write the actual platform poses for n commands. Model poses are guesses; if the outcome is HC_OK, the
 * solution replaces the guess and the actual pose is written, otherwise neither. */
void hc_forwards_many(const hc_state *state, size_t count, const double *commands, const double *senses,
                      double *model_positions, double *model_rotations, double *positions, double *rotations,
                      int *outcomes, double *conditions)
{
    for (size_t n = 0; n < count; n++) {
        hc_pose q = pose_of(model_positions + 3 * n, model_rotations + 9 * n), actual;
        const solution found_here = run_forwards(state, commands + 6 * n, senses + 9 * n, &q);
        outcomes[n] = (int)found_here.status;
        conditions[n] = found_here.condition;
        if (found_here.status == HC_OK) {
            apply_field(&state->model->field, &q, senses + 9 * n, &actual);
            write_pose(&q, model_positions + 3 * n, model_rotations + 9 * n);
            write_pose(&actual, positions + 3 * n, rotations + 9 * n);
        }
    }
}
