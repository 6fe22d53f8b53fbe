/* SPDX-License-Identifier: Apache-2.0
 *
 * A strut's own errors, forwards (command to length) and backwards, and directions of motion. doc/theory.md, 8 and 10.
 */
#include "core.h"

/* Update the direction of motion of one value: it reverses when the value leaves a dead band that it drags along, from
 * `low` to `low` + threshold. */
static double follow(double value, double threshold, double low[9], double sense[9], int index)
{
    if (low[index] != low[index]) {
        low[index] = value - 0.5 * threshold;
    } else if (value > low[index] + threshold) {
        low[index] = value - threshold;
        sense[index] = 1.0;
    } else if (value < low[index]) {
        low[index] = value;
        sense[index] = -1.0;
    }
    return sense[index];
}

/* Update the directions of motion of a point along the three axes. */
static void follow_point(vec point, double threshold, double low[9], double sense[9])
{
    follow(point.x, threshold, low, sense, 0);
    follow(point.y, threshold, low, sense, 1);
    follow(point.z, threshold, low, sense, 2);
}

/* Angle about a strut, rad, from the base's cardan axis to the platform's, both projected along the strut. LinuxCNC's
 * genhexkins computes the same angle while it is within 90 degrees. */
static double screw_twist(const double base_axis[3], const double platform_axis[3], const hc_pose *pose,
                          const six_struts *now, int i)
{
    const vec s = now->strut[i], u = vector(s.x / now->length[i], s.y / now->length[i], s.z / now->length[i]);
    const vec b = row_of(base_axis), p = lever(pose, platform_axis);
    return arc_tangent(dot(b, cross(p, u)), dot(b, p) - dot(b, u) * dot(p, u));
}

/* The change of a command, m, that cancels the effect of the screw's rotation: if joints turn the screw in its nut by an angle,
 * the strut's length changes by lead * angle / 2 pi. `now` are the struts at `pose`. */
static double screw_shift(const hc_model *model, const hc_pose *pose, const six_struts *now, int i)
{
    const hc_strut *strut = &model->struts[i];
    if (strut->lead == 0.0) {
        return 0.0;
    }
    const double twist = screw_twist(model->base.axes[i], model->platform.axes[i], pose, now, i);
    const double turns = (twist - strut->twist_home) / (2.0 * PI);
    return -strut->lead * (turns - floor(turns + 0.5));
}

typedef struct { double cosine, sine; } turn; /* cosine and sine of a screw's angle */

static turn screw_turn(const hc_strut *strut, double command)
{
    turn at = {1.0, 0.0};
    if (strut->harmonics != 0.0) {
        sine_cosine(strut->wavenumber * command, &at.sine, &at.cosine);
    }
    return at;
}

/* The screw's angle `at` plus a small `angle`, by Taylor's series. */
static turn turned_on(turn at, double angle)
{
    const double square = angle * angle;
    const double c = 1.0 - square * (0.5 - square * (1.0 / 24.0));
    const double s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0)));
    return (turn){at.cosine * c - at.sine * s, at.sine * c + at.cosine * s};
}

/* The periodic error, m, and its slope over the command; harmonics by the addition theorem. */
static double wave_error(const hc_strut *strut, turn at, double *slope)
{
    const double (*wave)[2] = strut->wave;
    double error = wave[0][0] * at.cosine + wave[0][1] * at.sine;
    double c = at.cosine, s = at.sine, steep = wave[0][1] * c - wave[0][0] * s;
    for (int n = 2; n <= strut->harmonics; n++) {
        const double a = wave[n - 1][0], b = wave[n - 1][1], next = c * at.cosine - s * at.sine;
        s = s * at.cosine + c * at.sine;
        c = next;
        error += a * c + b * s;
        steep += n * (b * c - a * s);
    }
    *slope = strut->wavenumber * steep;
    return error;
}

/* The part of the length error that depends on the command, m (offset, pitch, wave, map with its backlash), and its slope. */
static double error_at(const hc_model *model, int i, double command, turn at, double sense, double *slope)
{
    const hc_strut *strut = &model->struts[i];
    const hc_map *map = &model->map;
    double error = strut->offset + strut->pitch * (command - strut->reference);
    *slope = strut->pitch;
    if (strut->harmonics != 0.0) {
        double steep;
        error += wave_error(strut, at, &steep);
        *slope += steep;
    }
    if (map->knot_count > 1) {
        const int last = map->knot_count - 1;
        const double inside = fmin(map->knots[last], fmax(map->knots[0], command));
        int low = 0, high = last;
        while (high - low > 1) {
            const int middle = low + (high - low) / 2;
            const int above = map->knots[middle] <= inside;
            low = above ? middle : low;
            high = above ? high : middle;
        }
        const double x = inside - map->knots[low], half = -0.5 * sense, *piece = map->pieces + (i * last + low) * 8;
        double c[4];
        for (int n = 0; n < 4; n++) {
            c[n] = piece[n] + half * piece[4 + n];
        }
        error += ((c[0] * x + c[1]) * x + c[2]) * x + c[3];
        if (inside == command) {
            *slope += (3.0 * c[0] * x + 2.0 * c[1]) * x + c[2];
        }
    }
    return error;
}

/* Forwards: the strut's actual length at a command, m. */
static double actual_length(const hc_state *state, int i, double command, double sense, double shift)
{
    const hc_strut *strut = &state->model->struts[i];
    double slope;
    const double error = error_at(state->model, i, command, screw_turn(strut, command), sense, &slope);
    const double play = 0.5 * sense * strut->backlash;
    return (1.0 + state->growth[i]) * (command + error - play - shift);
}

/* Backwards: the command that gives the strut a length, m, by Newton's method. */
static double command_for_length(const hc_state *state, int i, double length, double sense, double shift)
{
    const hc_strut *strut = &state->model->struts[i];
    const double wanted = length / (1.0 + state->growth[i]) + 0.5 * sense * strut->backlash + shift;
    double command = wanted - strut->offset;
    command -= strut->pitch * (command - strut->reference);
    turn at = screw_turn(strut, command);
    for (int count = 0; count < COMMAND_ITERATIONS; count++) {
        double slope;
        const double error = error_at(state->model, i, command, at, sense, &slope);
        const double step = (wanted - command - error) / (1.0 + slope);
        command += step;
        if (fabs(step) < 1e-9) {
            break;
        }
        const double angle = strut->wavenumber * step;
        at = fabs(angle) < SMALL_ANGLE ? turned_on(at, angle) : screw_turn(strut, command);
    }
    return command;
}
