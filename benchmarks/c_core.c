/* Timing loops in one thread around the functions of the exported C core, with which this file is linked. */
#define _POSIX_C_SOURCE 200809L

#include <math.h>
#include <time.h>

#include "hexapod_comp.h"
#include "hexapod_model.h"

#define BINS 4000 /* bins of 10 ns */

static hc_time made(double seconds)
{
    hc_time time;
    time.made = seconds;
    time.received = NAN;
    return time;
}

/* Return the processor time of this thread, s; other threads and processes are not counted. */
static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static double wall(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void begin(hc_state *state, const double *warm)
{
    int i;
    hc_init(state, &hexapod_model, 1e-3);
    for (i = 0; i < 8; i++) {
        hc_set_temperature(state, i, warm[i], 0.0);
    }
}

/* Compute commands for `count` poses, `rounds` times; return the processor time, s, or -1 if a command was refused. */
double commands_many(long count, long rounds, const double *poses, const double *warm)
{
    hc_state state;
    hc_answer answer;
    double begun;
    long k, n;
    begin(&state, warm);
    begun = seconds();
    for (k = 0; k < rounds; k++) {
        for (n = 0; n < count; n++) {
            if (hc_command(&state, poses + 7 * n, made(1e-3 * (double)(k * count + n)), 0, &answer) != HC_OK) {
                return -1.0;
            }
        }
    }
    return seconds() - begun;
}

/* Compute a warm estimate from each command's struts; return the processor time, s, or -1 if a command was refused. */
double estimates_many(long count, long rounds, const double *poses, const double *warm)
{
    hc_state state;
    hc_answer answer;
    hc_estimated where;
    double begun, spent = 0.0;
    long k, n;
    begin(&state, warm);
    for (k = 0; k < rounds; k++) {
        for (n = 0; n < count; n++) {
            hc_command(&state, poses + 7 * n, made(1e-3 * (double)(k * count + n)), 0, &answer);
            begun = seconds();
            if (hc_estimate(&state, answer.command, &where) != HC_OK) {
                return -1.0;
            }
            spent += seconds() - begun;
        }
    }
    return spent;
}

/* Return the time of one reading of the clock, s. */
double clock_cost(long count)
{
    const double begun = seconds();
    double last = begun;
    long n;
    for (n = 0; n < count; n++) {
        last = seconds();
    }
    return (last - begun) / (double)count;
}

/* Measure the wall clock time of every command, count it in bins of 10 ns, and return the largest time, s. */
double each_command(long count, long rounds, const double *poses, const double *warm, long *bins)
{
    hc_state state;
    hc_answer answer;
    double most = 0.0;
    long k, n;
    begin(&state, warm);
    for (k = 0; k < rounds; k++) {
        for (n = 0; n < count; n++) {
            const double begun = wall();
            double took;
            long bin;
            hc_command(&state, poses + 7 * n, made(1e-3 * (double)(k * count + n)), 0, &answer);
            took = wall() - begun;
            bin = (long)(took * 1e8);
            bins[bin < BINS ? bin : BINS - 1]++;
            most = took > most ? took : most;
        }
    }
    return most;
}
