/* SPDX-License-Identifier: Apache-2.0
 *
 * Call every function of the core on the machine of hexapod_model.h and print each number with all digits. The tests expect
 * the same lines from every compiler and instruction set, and no complaint of a sanitizer. `driver N` then sends N commands.
 */
#include "hexapod_batch.c"
#include "hexapod_model.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define POSES 37 /* no multiple of eight, so that a batch has a rest */

static unsigned long long random_bits = 88172645463325252ULL;

/* xorshift; uniform in -1 to 1, the same everywhere */
static double drawn(void)
{
    random_bits ^= random_bits << 13;
    random_bits ^= random_bits >> 7;
    random_bits ^= random_bits << 17;
    return (double)(random_bits >> 12) * (2.0 / 4503599627370496.0) - 1.0;
}

static void show(const char *what, const double *numbers, int count)
{
    int i;
    printf("%s", what);
    for (i = 0; i < count; i++) {
        printf(" %.17g", numbers[i]);
    }
    printf("\n");
}

static void show_status(const char *what, int status)
{
    const double number = status;
    show(what, &number, 1);
}

/* A small rotation, exact to rounding: rows of (1 - |w|^2) + 2 (w w' + [w]) over 1 + |w|^2. */
static void turned_to(double angle, double rotation[9])
{
    const double x = angle * drawn(), y = angle * drawn(), z = angle * drawn();
    const double square = x * x + y * y + z * z, share = 2.0 / (1.0 + square), one = share - 1.0;
    const double skew[9] = {0.0, -z, y, z, 0.0, -x, -y, x, 0.0}, w[3] = {x, y, z};
    int i, j;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            rotation[3 * i + j] = share * (w[i] * w[j] + skew[3 * i + j]) + (i == j ? one : 0.0);
        }
    }
}

/* A tool pose near where the tool is at home, by position and quaternion. */
static void near_home(double reach, double pose[7])
{
    const hc_pose *home = &hexapod_model.home;
    double x = 0.1 * drawn(), y = 0.1 * drawn(), z = 0.1 * drawn(), norm = sqrt(1.0 + x * x + y * y + z * z);
    int i;
    for (i = 0; i < 3; i++) {
        pose[i] = home->position[i] + reach * drawn();
    }
    pose[3] = x / norm;
    pose[4] = y / norm;
    pose[5] = z / norm;
    pose[6] = 1.0 / norm;
}

static void commands(long count)
{
    static const hc_pose base = {{0.0, 0.0, 0.0}, {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}};
    hc_state state;
    hc_answer answer;
    hc_estimated estimated;
    double pose[7], way[7] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    long n;
    int i;
    hc_init(&state, &hexapod_model, 1e-3);
    near_home(0.01, pose);
    for (n = 0; n < count; n++) {
        hc_time time;
        hc_status status;
        double tried[7];
        time.made = n % 97 ? 4e-3 * (double)n : NAN;
        time.received = n % 89 ? 4e-3 * (double)n + 1e-3 * drawn() : NAN;
        for (i = 0; i < 7; i++) {
            way[i] = n % 50 ? way[i] : (i < 3 ? 1e-4 : 1e-5) * drawn();
            tried[i] = pose[i] + way[i];
        }
        if (n % 61 == 60) {
            tried[n % 7] = n % 2 ? NAN : 2.0;
        }
        status = n % 5 ? hc_command(&state, tried, time, n % 3 ? &base : NULL, &answer)
                       : hc_command_lengths(&state, state.last.nominal, time, &answer);
        hc_published(&state, time.received + 1e-4);
        show_status(hc_reason(status), (int)status);
        show("command", answer.command, 6);
        for (i = 0; i < 7 && status == HC_OK && n % 5; i++) {
            pose[i] = tried[i];
        }
        if (status != HC_OK) {
            hc_reset(&state, n % 4 ? NULL : answer.command);
            near_home(0.03, pose);
        }
        if (n % 13 == 12) {
            show_status("temperature", (int)hc_set_temperature(&state, (int)(n % 10), 20.0 + 30.0 * drawn(), 4e-3 * (double)n));
            show_status("humidity", (int)hc_set_humidity(&state, 0.5 + 0.6 * drawn()));
            const double gravity[3] = {drawn(), drawn(), n % 4 ? -9.8 : NAN}, wrench[6] = {50.0 * drawn(), 0.0, drawn()};
            show_status("load", (int)hc_set_load(&state, n % 3 ? gravity : NULL, n % 5 ? wrench : NULL));
        }
        if (n % 29 == 28) {
            show_status("enable", (int)hc_enable(&state, n % 2 == 0));
            show_status("check", (int)hc_check(&state, &hexapod_model, &answer));
            show_status("model", (int)hc_set_model(&state, &hexapod_model));
        }
        if (n % 211 == 210) {
            hc_set_tool(&state, &hexapod_model);
        }
        status = hc_estimate(&state, state.last.command, &estimated);
        show_status("estimate", (int)status);
        if (status == HC_OK) {
            show("tool", estimated.tool.position, 3);
            show("tool", (const double *)estimated.tool.rotation, 9);
        }
    }
}

static double positions[POSES * 3], rotations[POSES * 9], lengths[POSES * 6], senses[POSES * 9];

static void draw_poses(void)
{
    int n, i;
    for (n = 0; n < POSES; n++) {
        for (i = 0; i < 3; i++) {
            positions[3 * n + i] = hexapod_model.home.position[i] + 0.04 * drawn();
        }
        turned_to(0.1, rotations + 9 * n);
        for (i = 0; i < 9; i++) {
            senses[9 * n + i] = drawn() > 0.0 ? 1.0 : -1.0;
        }
    }
}

static void kinematics(void)
{
    const double *base = (const double *)hexapod_model.base.joints, *platform = (const double *)hexapod_model.platform.joints;
    const double *axes = (const double *)hexapod_model.base.axes, *others = (const double *)hexapod_model.platform.axes;
    static const double point[3] = {0.01, -0.02, 0.1}, identity[9] = {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0};
    static double found[POSES * 3], turned[POSES * 9], numbers[POSES * 36], signs[POSES];
    int outcomes[POSES], iterations[POSES], n, i;
    hc_strut_lengths_many(base, platform, POSES, positions, rotations, lengths);
    show("lengths", lengths, POSES * 6);
    for (n = 0; n < POSES; n++) {
        for (i = 0; i < 3; i++) {
            found[3 * n + i] = hexapod_model.home.position[i];
        }
        for (i = 0; i < 9; i++) {
            turned[9 * n + i] = hexapod_model.home.rotation[i / 3][i % 3];
        }
    }
    lengths[6 * 4 + 1] = 3.0;
    lengths[6 * 20 + 2] = NAN;
    lengths[6 * 33 + 5] += 0.2;
    hc_solve_pose_many(base, platform, POSES, lengths, found, turned, hexapod_model.limits.characteristic_length,
                       hexapod_model.limits.home_sign, hexapod_model.limits.condition, outcomes, iterations, numbers);
    for (n = 0; n < POSES; n++) {
        show_status("outcome", 100 * outcomes[n] + iterations[n]);
    }
    show("positions", found, POSES * 3);
    show("rotations", turned, POSES * 9);
    show("conditions", numbers, POSES);
    hc_jacobian_many(base, platform, POSES, positions, rotations, numbers);
    show("jacobians", numbers, POSES * 36);
    hc_condition_many(base, platform, POSES, positions, rotations, 0.2, numbers, signs);
    show("conditions", numbers, POSES);
    show("signs", signs, POSES);
    hc_motions_many(POSES, positions, rotations, found, turned, point, identity, numbers);
    show("motions", numbers, POSES * 6);
    hc_screw_twists(base, platform, axes, others, POSES, positions, rotations, numbers);
    show("twists", numbers, POSES * 6);
}

static void model(void)
{
    const double *base = (const double *)hexapod_model.base.joints, *platform = (const double *)hexapod_model.platform.joints;
    static double windows[POSES * 9], q[POSES * 3], turned[POSES * 9], actual[POSES * 3], rotated[POSES * 9], numbers[POSES * 6];
    static hc_quantities found[2 * POSES];
    double low[9] = {NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN}, sense[9] = {0.0}, slopes[POSES];
    int flags[POSES], n, i;
    signed char findings[POSES], struts[2 * POSES];
    hc_state state;
    hc_pose pose;
    hc_init(&state, &hexapod_model, 1e-3);
    for (i = 0; i < POSES * 9; i++) {
        windows[i] = NAN;
    }
    hc_backwards_many(&state, POSES, positions, rotations, windows, senses, q, turned, numbers, flags);
    show("commands", numbers, POSES * 6);
    hc_forwards_many(&state, POSES, numbers, senses, q, turned, actual, rotated, flags, slopes);
    show("actual", actual, POSES * 3);
    show("actual", rotated, POSES * 9);
    hc_strut_errors(&state, 2, 0.5, POSES, numbers, actual, slopes);
    show("errors", actual, POSES);
    show("slopes", slopes, POSES);
    hc_strut_commands(&state, 2, -1.0, 1e-5, POSES, numbers, actual);
    show("commands", actual, POSES);
    hc_follow(1e-3, POSES, numbers, actual, slopes);
    show("sense", slopes, POSES);
    for (i = 0; i < 2; i++) {
        hc_examine_many(&state, POSES, positions, rotations, i, low, sense, found, flags);
        for (n = 0; n < 2 * POSES; n++) {
            show("quantities", (const double *)&found[n], (int)(sizeof found[n] / sizeof(double)));
        }
    }
    hc_check_poses(base, platform, &hexapod_model.limits, POSES, positions, POSES, rotations, findings, struts);
    for (n = 0; n < POSES; n++) {
        show_status("finding", 10000 * findings[n] + 100 * struts[2 * n] + struts[2 * n + 1]);
    }
    pose = hexapod_model.home;
    hc_examine(base, platform, &hexapod_model.limits, pose.position, pose.rotation[0], found);
    show("home", (const double *)&found[0], (int)(sizeof found[0] / sizeof(double)));
}

static void ways(void)
{
    hc_state state;
    hc_pose tool = hexapod_model.home, frame = {{0.0, 0.0, 0.0}, {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}};
    int i;
    hc_init(&state, &hexapod_model, 0.0);
    for (i = 0; i < 12; i++) {
        double along[2][3] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
        hc_way way;
        along[i / 6][i % 3] = i % 2 ? 1.0 : -1.0;
        hc_go(&state, &tool, &frame, along[0], along[1], i < 6 ? 1e-3 : 9e-3, i < 6 ? 2.0 : 3.0, &way);
        show("inside", &way.inside, 1);
        show("outside", &way.outside, 1);
        show_status("refused", (int)way.refused.status);
    }
}

static void drives(void)
{
    const double probe[3] = {0.0, 0.0, 0.1};
    hc_drives all = {0};
    double sense[9] = {0.0}, low[9] = {NAN, NAN, NAN}, wanted[6];
    int n, i;
    all.tick = 2.5e-4;
    all.lag = 0.01;
    all.max_speed = 0.05;
    all.max_acceleration = 1.0;
    all.step = 1e-6;
    for (i = 0; i < 6; i++) {
        all.stops[i][0] = 0.4;
        all.stops[i][1] = 0.6;
        all.half_play[i] = 1e-5 * i;
        all.position[i] = 0.5;
        all.motor[i] = 0.5;
        all.stuck[i] = i == 3;
    }
    for (n = 0; n < 40; n++) {
        for (i = 0; i < 6; i++) {
            wanted[i] = 0.5 + 0.12 * drawn();
        }
        hc_run_drives(&all, wanted, 37, sense);
        hc_follow_point(hexapod_model.home.position, hexapod_model.home.rotation[0], probe, 1e-3, low, sense);
        show("motor", all.motor, 6);
        show("play", all.play, 6);
        show("sense", sense, 9);
        show_status("stopped", all.stopped[0] + 2 * all.stopped[1] + 4 * all.stopped[5]);
    }
}

int main(int words, char **word)
{
    commands(words > 1 ? atol(word[1]) : 500);
    draw_poses();
    kinematics();
    model();
    ways();
    drives();
    return 0;
}
