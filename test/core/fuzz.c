/* SPDX-License-Identifier: Apache-2.0
 *
 * Target of libFuzzer: its bytes become commands, strut readings or a machine. `benchmarks.fuzz --core` compiles this file once
 * for each, with ENTRY command, estimate or model. Beside what the sanitizers find, an answer must be finite and within the
 * limits, and a refusal must leave the state as it was, byte for byte.
 */
#include "hexapod_comp.h"
#include "hexapod_model.h"

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

typedef struct {
    const uint8_t *data;
    size_t left;
} bytes;

static void take(bytes *from, void *to, size_t size)
{
    const size_t here = from->left < size ? from->left : size;
    memset(to, 0, size);
    memcpy(to, from->data, here);
    from->data += here;
    from->left -= here;
}

static double take_number(bytes *from)
{
    double number;
    take(from, &number, sizeof number);
    return number;
}

static unsigned take_byte(bytes *from)
{
    uint8_t byte;
    take(from, &byte, 1);
    return byte;
}

/* Mostly a number within reach of a value, seldom any number at all. */
static double take_near(bytes *from, double value, double reach)
{
    int16_t steps;
    if (take_byte(from) > 250) {
        return take_number(from);
    }
    take(from, &steps, sizeof steps);
    return value + reach * steps / 32768.0;
}

static void must(int holds)
{
    if (!holds) {
        abort();
    }
}

static int finite_all(const double *numbers, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        if (!(numbers[i] - numbers[i] == 0.0)) {
            return 0;
        }
    }
    return 1;
}

static void check_answer(const hc_state *before, const hc_state *after, hc_status status, const hc_answer *answer)
{
#ifndef MODEL
    const hc_limits *limits = &after->model->limits;
    int i;
#endif
    must(status == answer->status);
    if (status != HC_OK) {
        must(memcmp(&before->last, &after->last, sizeof before->last) == 0);
        return;
    }
    must(finite_all(answer->nominal, 6) && finite_all(answer->correction, 6) && finite_all(answer->command, 6));
#ifndef MODEL /* a drawn machine may have any limits */
    for (i = 0; i < 6; i++) {
        must(answer->command[i] >= limits->stroke[i][0] && answer->command[i] <= limits->stroke[i][1]);
        must(answer->nominal[i] >= limits->stroke[i][0] && answer->nominal[i] <= limits->stroke[i][1]);
        must(fabs(answer->correction[i]) <= limits->correction);
        must(!(fabs(answer->command[i] - before->last.command[i]) > limits->step));
    }
    must(answer->condition <= limits->condition);
#endif
}

static void one_command(hc_state *state, bytes *from)
{
    const hc_pose *home = &state->model->home;
    const hc_state before = *state;
    hc_answer answer;
    hc_status status;
    hc_time time;
    double numbers[7];
    int i;
    time.made = take_near(from, before.last.time == before.last.time ? before.last.time : 0.0, 0.1);
    time.received = take_byte(from) & 1 ? NAN : time.made;
    if (take_byte(from) & 1) {
        for (i = 0; i < 6; i++) {
            numbers[i] = take_near(from, 0.5, 0.3);
        }
        status = hc_command_lengths(state, numbers, time, &answer);
    } else {
        for (i = 0; i < 7; i++) {
            numbers[i] = take_near(from, i < 3 ? home->position[i] : (double)(i == 6), i < 3 ? 0.02 : 1e-3);
        }
        status = hc_command(state, numbers, time, NULL, &answer);
    }
    check_answer(&before, state, status, &answer);
    hc_published(state, take_near(from, time.received, 0.01));
}

static void one_estimate(hc_state *state, bytes *from)
{
    const hc_state before = *state;
    hc_estimated estimated;
    double lengths[6];
    int i, j;
    for (i = 0; i < 6; i++) {
        lengths[i] = take_near(from, 0.5, 0.5);
    }
    if (hc_estimate(state, lengths, &estimated) != HC_OK) {
        must(memcmp(&before.estimate, &state->estimate, sizeof before.estimate) == 0);
        return;
    }
#ifdef MODEL
    return; /* a drawn machine may have any tool */
#endif
    must(finite_all(estimated.tool.position, 3) && estimated.condition <= state->model->limits.condition);
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            const double(*r)[3] = (const double(*)[3])estimated.tool.rotation;
            const double dot = r[i][0] * r[j][0] + r[i][1] * r[j][1] + r[i][2] * r[j][2];
            must(fabs(dot - (i == j)) < 1e-9);
        }
    }
}

static void one_change(hc_state *state, const hc_model *other, bytes *from)
{
    double lengths[6], gravity[3];
    hc_answer answer;
    int i;
    switch (take_byte(from) % 9) {
    case 8:
        for (i = 0; i < 6; i++) {
            gravity[i % 3] = take_near(from, 0.0, 10.0);
            lengths[i] = take_near(from, 0.0, 1e3);
        }
        hc_set_load(state, gravity, lengths);
        break;
    case 0: hc_set_temperature(state, (int)take_byte(from) - 1, take_near(from, 20.0, 130.0), take_near(from, 0.0, 1e4)); break;
    case 1: hc_set_humidity(state, take_near(from, 0.5, 0.7)); break;
    case 2: hc_enable(state, (int)(take_byte(from) & 1)); break;
    case 3: hc_set_model(state, other); break;
    case 4: hc_set_tool(state, other); break;
    case 5: hc_check(state, other, &answer); break;
    case 6: hc_reset(state, NULL); break;
    default:
        for (i = 0; i < 6; i++) {
            lengths[i] = take_near(from, 0.5, 0.2);
        }
        hc_reset(state, lengths);
    }
}

#ifdef MODEL
#define MOST 5 /* nodes and knots of a drawn machine */

/* Arrays of a drawn machine, exactly as long as its counts say, so that the sanitizer sees a read past their ends. */
static const double *take_array(bytes *from, size_t count)
{
    double *numbers = malloc(count * sizeof *numbers + !count);
    size_t n;
    must(numbers != NULL);
    for (n = 0; n < count; n++) {
        numbers[n] = take_near(from, 0.0, 1.0);
    }
    return numbers;
}

/* The machine of the header with any numbers replaced by others; counts and sensors as hexapod_comp.h allows them. */
static void take_model(hc_model *model, bytes *from)
{
    const size_t first = offsetof(hc_model, base), past = offsetof(hc_model, map);
    unsigned changes = take_byte(from) % 16;
    int i, count;
    *model = hexapod_model;
    for (; changes; changes--) {
        uint16_t place;
        double number;
        take(from, &place, sizeof place);
        number = take_byte(from) & 1 ? take_number(from) : take_near(from, 0.0, 1.0);
        memcpy((char *)model + first + 8 * (place % ((past - first) / 8)), &number, sizeof number);
    }
    for (i = 0; i < 6; i++) {
        model->struts[i].harmonics = (double)(take_byte(from) % 5);
    }
    model->map.knot_count = (int)(take_byte(from) % (MOST + 1));
    model->map.knot_count -= model->map.knot_count == 1;
    count = model->map.knot_count ? model->map.knot_count - 1 : 0;
    model->map.knots = take_array(from, (size_t)model->map.knot_count);
    model->map.pieces = take_array(from, (size_t)(6 * count * 8));
    for (i = 0; i < 3; i++) {
        model->field.node_count[i] = 2 + (int)(take_byte(from) % (MOST - 1));
        model->field.powers[i] = (int)(take_byte(from) % MOST);
        model->field.probe[i] = take_near(from, 0.0, 0.1);
    }
    for (i = 0; i < 3; i++) {
        const int *nodes = model->field.node_count;
        const int across = nodes[(i + 1) % 3] * nodes[(i + 2) % 3];
        model->field.nodes[i] = take_array(from, (size_t)nodes[i]);
        model->field.lines[i] = take_array(from, (size_t)(2 * across * model->field.powers[i] * 6));
    }
    model->field.refuse_outside = (int)(take_byte(from) & 1);
    model->late.count = (int)(take_byte(from) % 3);
    for (i = 0; i < 8; i++) {
        model->late.sensors[i] = (int)(take_byte(from) % 8);
        model->late.expansion[i][0] = take_near(from, 0.0, 1e-5);
        model->late.expansion[i][1] = take_near(from, 0.0, 1e-5);
    }
    model->late.time_constants[0] = take_near(from, 60.0, 60.0);
    model->late.time_constants[1] = take_near(from, 600.0, 600.0);
    model->load.bends = (int)(take_byte(from) & 1);
    model->load.take_up = 1.0;
    model->load.mass = take_near(from, 50.0, 50.0);
    for (i = 0; i < 6; i++) {
        model->load.compliance[i] = take_near(from, 1e-7, 1e-6);
        model->load.play[i] = take_near(from, 1e-6, 1e-5);
        model->load.moment[i % 3] = take_near(from, 0.0, 10.0);
        model->load.gravity[i % 3] = take_near(from, 0.0, 10.0);
    }
    model->axis_threshold = take_near(from, 0.0, 1e-6);
    model->strut_threshold = take_near(from, 0.0, 1e-6);
}

static void free_model(const hc_model *model)
{
    int i;
    free((void *)(uintptr_t)model->map.knots);
    free((void *)(uintptr_t)model->map.pieces);
    for (i = 0; i < 3; i++) {
        free((void *)(uintptr_t)model->field.nodes[i]);
        free((void *)(uintptr_t)model->field.lines[i]);
    }
}
#endif

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    bytes from;
    hc_state state;
    const hc_model *other = &hexapod_model;
    double ramp_rate = 1e-3;
    int n;
#ifdef MODEL
    hc_model model;
#endif
    from.data = data;
    from.left = size;
    memset(&state, 0, sizeof state); /* its padding too, as states are compared byte for byte */
#ifdef MODEL
    take_model(&model, &from);
    ramp_rate = take_near(&from, 1e-3, 1e-3);
    hc_init(&state, &model, ramp_rate);
    other = take_byte(&from) & 1 ? &model : &hexapod_model;
#else
    hc_init(&state, &hexapod_model, ramp_rate);
#endif
    for (n = 0; n < 64 && (from.left || n < 2); n++) {
        const unsigned kind = take_byte(&from);
#ifdef ESTIMATE
        const int commands = kind < 64;
#else
        const int commands = kind < 192;
#endif
        if (kind >= 224) {
            one_change(&state, other, &from);
        } else if (commands) {
            one_command(&state, &from);
        } else {
            one_estimate(&state, &from);
        }
    }
#ifdef MODEL
    free_model(&model);
#endif
    return 0;
}
