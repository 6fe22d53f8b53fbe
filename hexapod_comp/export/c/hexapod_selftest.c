/* SPDX-License-Identifier: Apache-2.0
 *
 * Runs the steps of hexapod_vectors.h and compares the answers with those of the Python compensator. Build it with the
 * compiler of your target, and run it on the target once:
 *
 *     cc -std=c99 -O2 hexapod_comp.c hexapod_selftest.c -lm -o selftest && ./selftest
 *
 * The exit code is 0 if all lengths agree within 2 units in the last place and all refusals are the same.
 */
#include <math.h>
#include <stdio.h>

#include "hexapod_comp.h"
#include "hexapod_model.h"
#include "hexapod_vectors.h"

#define ALLOWED 2.0 /* largest difference of lengths, units in the last place */

/* The difference of two numbers in units in the last place of `expected`. */
static double last_places(double got, double expected)
{
    int exponent;
    if (got != got || expected != expected) {
        return got != got && expected != expected ? 0.0 : HUGE_VAL;
    }
    (void)frexp(expected, &exponent);
    return fabs(got - expected) / ldexp(1.0, exponent - 53);
}

/* Do the step of a vector; write the strut commands, or an estimate's position and last row of the rotation matrix. */
static hc_status do_step(hc_state *state, const hexapod_vector *vector, double lengths[6])
{
    hc_answer answer;
    hc_estimated estimated;
    hc_time time;
    hc_status status = HC_OK;
    int i;
    switch (vector->kind) {
    case 't': return hc_set_temperature(state, (int)vector->input[0], vector->input[1], vector->time);
    case 'g': return hc_set_load(state, vector->input, NULL);
    case 'e': return hc_enable(state, (int)vector->input[0]);
    case 'f': return hc_reset(state, NULL);
    case 'r': return hc_reset(state, vector->input);
    case 'p':
        status = hc_estimate(state, vector->input, &estimated);
        for (i = 0; i < 3; i++) {
            lengths[i] = status == HC_OK ? estimated.tool.position[i] : NAN;
            lengths[3 + i] = status == HC_OK ? estimated.tool.rotation[2][i] : NAN;
        }
        return status;
    default:
        time.made = vector->time;
        time.received = NAN;
        status = hc_command(state, vector->input, time, NULL, &answer);
        for (i = 0; i < 6; i++) {
            lengths[i] = answer.command[i];
        }
        return status;
    }
}

int main(void)
{
    const int count = (int)(sizeof hexapod_vectors / sizeof hexapod_vectors[0]);
    hc_state state;
    double worst_length = 0.0, worst_pose = 0.0;
    int wrong = 0, n, i;
    hc_init(&state, &hexapod_model, hexapod_ramp_rate);
    for (n = 0; n < count; n++) {
        const hexapod_vector *vector = &hexapod_vectors[n];
        double got[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
        const hc_status status = do_step(&state, vector, got);
        if ((int)status != vector->status) {
            printf("vector %d: %s instead of %s\n", n, hc_reason(status), hc_reason((hc_status)vector->status));
            wrong++;
            continue;
        }
        for (i = 0; i < 6; i++) {
            if (vector->kind == 'p') {
                /* poses have an absolute tolerance, m and 1, as Newton's result depends on rounding of the lengths */
                const double off = fabs(got[i] - vector->expected[i]);
                worst_pose = off > worst_pose ? off : worst_pose;
                wrong += off > 1e-12;
            } else {
                const double off = last_places(got[i], vector->expected[i]);
                worst_length = off > worst_length ? off : worst_length;
                wrong += !(off <= ALLOWED);
            }
        }
    }
    printf("%s, model %s of %s: %d vectors, lengths within %g units in the last place, poses within %.1e: %s\n",
           hexapod_model.machine, hexapod_model.model, hexapod_model.date, count, worst_length, worst_pose,
           wrong ? "FAILED" : "PASSED");
    return wrong != 0;
}
