component hexapod_rt """Strut corrections of a hexapod in the servo thread: see doc/linuxcnc.md of hexapod_comp.

The corrections are those of the nominal strut lengths of the same cycle. They ramp when compensation is switched, when a
temperature, gravity or a force changes, and after a refusal; while commands are refused they ramp to zero.""";

pin in float joint-pos-cmd-#[6] "Nominal strut lengths: joint.N.pos-cmd, machine units";
pin in float joint-pos-fb-#[6] "Measured strut lengths with their corrections, machine units; for the function estimate";
pin in float temperature-#[8] = 20 "Temperatures of struts 1-6, base and platform, degrees Celsius; filter them";
pin in float gravity-#[3] "Gravity in base, m/s2, for a model with a load block; zeros: the model's gravity";
pin in float wrench-#[6] "Force, N, and torque about platform's origin, N m, in platform, without weight; filter them";
pin in bit machine-on "True: machine on and homed, so joint positions are valid. False: corrections ramp to zero";
pin in bit enable "True: compensation is on";
pin out float correction-#[6] "Corrections, machine units; connect to offset.N.offset";
pin out bit ok "False: the last command was refused";
pin out s32 reason "Reason of the last refusal: hc_status of hexapod_comp.h; 0: not refused";
pin out s32 status "0 off, at zero; 1 ramping in; 2 compensating; 4 ramping to zero; 5 enabled, at zero, refused or not homed";
pin out bit compensating "True: status is 2";
pin out bit heartbeat "Toggles every cycle";
pin out u32 updates "Number of corrections computed";
pin out u32 refused "Number of commands refused";
pin out float largest "Largest correction now, machine units";
pin out float tool-x "Tool position in base by the measured struts, machine units";
pin out float tool-y;
pin out float tool-z;
pin out bit tool-valid "True: the tool position is valid";
param rw float unit = 0.001 "Metres per machine unit: 0.001 or 0.0254";
param rw float temperature-step = 0.01 "Smallest change of a temperature, K, that is used";
param rw float gravity-step = 0.01 "Smallest change of gravity, m/s2, that is used";
param rw float wrench-step = 1.0 "Smallest change of the wrench, N and N m, that is used";

include "hexapod_comp.c";
include "hexapod_model.h";
variable hc_state core;
variable double elapsed_time;
variable double temperature_now[8];
variable double gravity_now[3];
variable double wrench_now[6];
variable int started;
variable int begun;

option singleton yes;
function correct fp "Compute the corrections; add it after motion-controller and before the offsets are added";
function estimate fp "Compute the tool position; it takes as long as correct, leave it out if nobody reads it";

license "Apache-2.0 AND GPL";
author "The hexapod_comp maintainers";
;;

#define RAMP_RATE 1e-3 /* m/s */
#define LATE_PERIOD 1.0 /* s: with delayed growth, unchanged temperatures are set again after this time */

/* Initialise the core at the first call. */
static void begin_once(hc_state *state, int *has_begun, double temperatures[8])
{
    int i;
    if (*has_begun) {
        return;
    }
    hc_init(state, &hexapod_model, RAMP_RATE);
    for (i = 0; i < 8; i++) {
        temperatures[i] = state->temperatures[i];
    }
    *has_begun = 1;
}

/* Reset the core so that the next command ramps from the present corrections, m. */
static void start_from(hc_state *state, const double standing[6])
{
    int i;
    for (i = 0; i < 6; i++) {
        state->last.correction[i] = standing[i];
    }
    hc_reset(state, 0);
}

/* Whether a number has changed by at least `step`; false if a number is NAN. */
static int differ(const double now[], const double last[], int count, double step)
{
    int i, changed = 0;
    for (i = 0; i < count; i++) {
        if (now[i] != now[i]) {
            return 0;
        }
        changed = changed || fabs(now[i] - last[i]) >= step;
    }
    return changed;
}

static double largest_of(const double values[6])
{
    double most = 0.0;
    int i;
    for (i = 0; i < 6; i++) {
        most = fmax(most, fabs(values[i]));
    }
    return most;
}

FUNCTION(correct)
{
    double nominal[6], standing[6], down[3], pushing[6], most, keep;
    const double seconds = (double)period * 1e-9;
    int i, good = 0;
    begin_once(&core, &begun, temperature_now);
    elapsed_time += seconds;
    for (i = 0; i < 6; i++) {
        nominal[i] = joint_pos_cmd(i) * unit;
        standing[i] = correction(i) * unit;
        pushing[i] = wrench(i);
    }
    for (i = 0; i < 3; i++) {
        down[i] = gravity(i);
    }
    if (differ(down, gravity_now, 3, gravity_step)) {
        const double models[3] = {NAN, NAN, NAN};
        const int none = down[0] == 0.0 && down[1] == 0.0 && down[2] == 0.0;
        const int taken = hc_set_load(&core, none ? models : down, 0) == HC_OK;
        for (i = 0; i < 3 && taken; i++) {
            gravity_now[i] = down[i];
        }
    }
    if (differ(pushing, wrench_now, 6, wrench_step) && hc_set_load(&core, 0, pushing) == HC_OK) {
        for (i = 0; i < 6; i++) {
            wrench_now[i] = pushing[i];
        }
    }
    for (i = 0; i < 8; i++) {
        const int late = hexapod_model.late.count && !(elapsed_time - core.newest[i] < LATE_PERIOD);
        if ((late || fabs(temperature(i) - temperature_now[i]) >= temperature_step)
            && hc_set_temperature(&core, i, temperature(i), elapsed_time) == HC_OK) {
            temperature_now[i] = temperature(i);
        }
    }
    hc_enable(&core, enable);
    if (machine_on) {
        hc_answer answer;
        hc_time now;
        now.made = elapsed_time;
        now.received = NAN;
        if (!started) {
            start_from(&core, standing);
        }
        reason = (int)hc_command_lengths(&core, nominal, now, &answer);
        good = reason == HC_OK;
        for (i = 0; i < 6 && good; i++) {
            standing[i] = answer.correction[i];
        }
        updates += (unsigned)good;
        refused += (unsigned)!good;
    } else {
        reason = 0;
    }
    ok = good || !machine_on;
    started = good;
    most = largest_of(standing);
    keep = good || most == 0.0 ? 1.0 : fmax(0.0, 1.0 - RAMP_RATE * seconds / most);
    for (i = 0; i < 6; i++) {
        correction(i) = keep * standing[i] / unit;
    }
    largest = keep * most / unit;
    heartbeat = !heartbeat;
    if (good && enable) {
        status = largest_of(core.last.ramp) > 0.0 ? 1 : 2;
    } else {
        status = largest > 0.0 ? 4 : enable ? 5 : 0;
    }
    compensating = status == 2;
}

FUNCTION(estimate)
{
    double lengths[6];
    hc_estimated where;
    int i;
    begin_once(&core, &begun, temperature_now);
    for (i = 0; i < 6; i++) {
        lengths[i] = joint_pos_fb(i) * unit;
    }
    tool_valid = hc_estimate(&core, lengths, &where) == HC_OK;
    if (tool_valid) {
        tool_x = where.tool.position[0] / unit;
        tool_y = where.tool.position[1] / unit;
        tool_z = where.tool.position[2] / unit;
    }
}
