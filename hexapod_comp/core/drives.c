/* SPDX-License-Identifier: Apache-2.0
 *
 * Simulation of six strut drives with lag, limits of speed and acceleration, stepped motors, stops and backlash.
 */
#include "core.h"

#define SETTLED 1e-12 /* m; a reference nearer to its command is set equal to it, as an exponential never arrives */
#define CONTACT 1e-6  /* m; a motor commanded beyond a stop counts as stopped within this distance of the stop */

/* Wanted speed at a distance from the command, m/s: distance / lag near the command, and further away the speed from which
 * half the largest acceleration brakes in time; both curves meet with equal slope. The other half of the
 * acceleration is a reserve for the lag of the speed loop. */
static double wanted_speed(const hc_drives *drives, double distance)
{
    const double braking = 0.5 * drives->max_acceleration, lag = drives->lag, size = fabs(distance);
    double speed = size / lag;
    if (size > braking * lag * lag) {
        const double short_of = braking * lag;
        speed = sqrt(2.0 * braking * size - short_of * short_of);
    }
    return copysign(fmin(speed, drives->max_speed), distance);
}

/* Move a reference for one tick towards its target. */
static void move_reference(const hc_drives *drives, double target, double *position, double *speed)
{
    const double tick = drives->tick, lag = drives->lag, most = drives->max_acceleration * tick;
    const double distance = target - *position;
    if (lag == 0.0) {
        *position = target;
        return;
    }
    if (fabs(distance) < SETTLED && fabs(*speed) * lag < SETTLED) {
        *position = target;
        *speed = 0.0;
        return;
    }
    *speed += clamp((wanted_speed(drives, distance) - *speed) * (4.0 * tick / lag), -most, most);
    *position += tick * *speed;
}

/* Set a motor to the step nearest to its reference, and let the nut follow with its backlash. */
static void place_motor(hc_drives *drives, int i)
{
    const double before = drives->motor[i], half = drives->half_play[i], step = drives->step;
    const double stepped = step > 0.0 ? rint(drives->position[i] / step) * step : drives->position[i];
    drives->motor[i] = clamp(stepped, drives->stops[i][0], drives->stops[i][1]);
    drives->play[i] = half > 0.0 ? clamp(drives->play[i] + drives->motor[i] - before, -half, half) : 0.0;
}

/* Run the drives for some ticks towards six commands. A drive brakes before its stops; if it still reaches one (after a jump,
 * or a command reversed too late), it stops there at once. Writes `sense` 3 to 8, the struts' directions of motion. */
void hc_run_drives(hc_drives *drives, const double commands[6], long ticks, double sense[9])
{
    for (int i = 0; i < 6; i++) {
        const double low = drives->stops[i][0], high = drives->stops[i][1];
        const double target = clamp(commands[i], low, high);
        int hit = 0;
        for (long n = 0; n < ticks; n++) {
            if (!drives->stuck[i]) {
                move_reference(drives, target, &drives->position[i], &drives->speed[i]);
            }
            if (drives->position[i] < low || drives->position[i] > high) {
                hit = 1;
                drives->position[i] = clamp(drives->position[i], low, high);
                drives->speed[i] = 0.0;
            }
            place_motor(drives, i);
        }
        sense[3 + i] = drives->half_play[i] > 0.0 ? drives->play[i] / drives->half_play[i] : 0.0;
        drives->stopped[i] = drives->stopped[i] || hit
                             || (commands[i] != target && fabs(drives->motor[i] - target) <= CONTACT);
    }
}
