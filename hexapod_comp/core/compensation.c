/* SPDX-License-Identifier: Apache-2.0
 *
 * The whole model backwards and forwards, and the compensator. doc/theory.md, 11.
 */
#include "core.h"

/* Friction force of a strut's joint bearings on the moving platform, N; `along` is the strut's unit vector, `motion` the
 * platform's direction of motion. Each turning bearing resists with the torque `friction`, N m. With a cardan axis `axis`,
 * fixed in the base, two bearings turn; with `axis` 0, the joint is a ball joint. */
static vec bearing_force(vec along, double length, vec motion, const double axis[3], double friction)
{
    const vec across = subtract(motion, scale(dot(motion, along), along)), yoke = cross(row_of(axis), along);
    const double turning = norm(across), share = norm(yoke), slow = SLIDING * norm(motion);
    if (share > SLIDING) {
        const vec first = scale(1.0 / share, yoke), second = cross(first, along);
        const double by_first = fmax(-1.0, fmin(1.0, dot(motion, first) / slow)) / share;
        const double by_second = fmax(-1.0, fmin(1.0, dot(motion, second) / slow));
        return scale(-friction / length, add(scale(by_first, first), scale(by_second, second)));
    }
    return scale(-friction / (length * fmax(turning, slow)), across);
}

/* Write by how much the load lengthens each strut, m, at a pose that is reached in the directions of motion `sense`. */
static void load_stretch(const hc_state *state, const hc_pose *pose, const six_struts *now, const double sense[9],
                         double stretch[6])
{
    const hc_load *load = &state->model->load;
    const mat r = three_rows(pose->rotation);
    const vec g = row_of(finite_number(state->gravity[0]) ? state->gravity : load->gravity);
    vec force = add(scale(load->mass, g), times(r.row, row_of(state->external)));
    vec torque = add(cross(times(r.row, row_of(load->moment)), g), times(r.row, row_of(state->external + 3)));
    for (int i = 0; i < 6; i++) {
        if (load->friction[i] != 0.0 && dot(row_of(sense), row_of(sense)) > 0.0) {
            const vec along = scale(1.0 / now->length[i], now->strut[i]);
            const vec drag = bearing_force(along, now->length[i], row_of(sense), state->model->base.axes[i], load->friction[i]);
            force = add(force, drag);
            torque = add(torque, cross(times(r.row, row_of(state->platform_joints[i])), drag));
        }
    }
    const blocks f = eliminate(now->strut, now->moment);
    double per_length[6];
    substitute_transposed(now->moment, &f, force, torque, per_length);
    if (!(fabs(f.determinant_upper) >= COPLANAR * now->length[0] * now->length[2] * now->length[4])) {
        double columns[6][6]; /* with pivoting */
        for (int i = 0; i < 6; i++) {
            const double row[6] = {now->strut[i].x,  now->strut[i].y,  now->strut[i].z,
                                   now->moment[i].x, now->moment[i].y, now->moment[i].z};
            for (int k = 0; k < 6; k++) {
                columns[k][i] = row[k];
            }
        }
        store(force, per_length);
        store(torque, per_length + 3);
        if (solve_six(columns, per_length) == 0.0) { /* singular: the check of the condition number refuses this pose */
            store(vector(0.0, 0.0, 0.0), per_length);
            store(vector(0.0, 0.0, 0.0), per_length + 3);
        }
    }
    for (int i = 0; i < 6; i++) {
        const double tension = per_length[i] * now->length[i];
        const double taken_up = fmax(-1.0, fmin(1.0, tension / load->take_up));
        stretch[i] = load->compliance[i] * tension + 0.5 * load->play[i] * taken_up;
    }
}

/* Run the model backwards for a platform pose: write q with q o E(q) = platform, the struts at q, and the commands; return
 * whether the iteration for q converged. */
static int run_backwards(const hc_state *state, const hc_pose *platform, double low[9], double sense[9], hc_pose *q,
                         six_struts *now, double commands[6], int *outside)
{
    const hc_model *model = state->model;
    follow_point(point_at(platform, model->field.probe), model->axis_threshold, low, sense);
    const int solved = undo_field(&model->field, platform, sense, q, outside);
    double stretch[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    *now = struts_of(state->base_joints, state->platform_joints, q);
    if (model->load.bends) {
        load_stretch(state, q, now, sense, stretch);
    }
    for (int i = 0; i < 6; i++) {
        const double direction = follow(now->length[i], model->strut_threshold, low, sense, 3 + i);
        const double shift = screw_shift(model, q, now, i);
        commands[i] = command_for_length(state, i, now->length[i] - stretch[i], direction, shift);
    }
    return solved;
}

/* After a change, set next->ramp to the difference from the last correction; reduce the ramp at the ramp rate. */
static void shrink_ramp(const hc_last *last, hc_last *next, double ramp_rate)
{
    const double by_stamp = next->time - last->time;
    const double pause = by_stamp == by_stamp ? by_stamp : next->received - last->received;
    double step = 0.0, largest = 0.0, keep;
    /* at the first command the ramp stays whole, as this command must not move the struts */
    if (pause == pause && last->nominal[0] == last->nominal[0]) {
        step = ramp_rate * fmin(fmax(pause, 0.0), LONGEST_RAMP_STEP);
    }
    for (int i = 0; i < 6; i++) {
        if (last->changed && last->correction[i] == last->correction[i]) {
            next->ramp[i] = last->correction[i] - next->correction[i];
        }
        largest = fmax(largest, fabs(next->ramp[i]));
    }
    keep = largest <= step ? 0.0 : 1.0 - step / largest;
    for (int i = 0; i < 6; i++) {
        next->ramp[i] *= keep;
    }
}

/* Time since the last command, s, by the stamps and by the times of receipt; -1: not known. */
static hc_time elapsed(const hc_last *last, const hc_last *next)
{
    const double made = next->time - last->time, received = next->received - last->received;
    return (hc_time){made >= 0.0 ? made : -1.0, received >= 0.0 ? received : -1.0};
}

/* Check the struts' speeds by both clocks, and write how far each strut is ahead of the speed limit. */
static finding check_speed(const hc_last *last, hc_last *next, double limit)
{
    const hc_time since = elapsed(last, next);
    const double delay = last->published - last->received, waited = delay == delay ? delay : 0.0;
    double speed = 0.0, wait = 0.0;
    int too_fast = -1, early = -1;
    for (int i = 0; i < 6; i++) {
        const double moved = fabs(next->command[i] - last->command[i]), change = moved == moved ? moved : 0.0;
        if (since.made >= 0.0) {
            const double ahead = fmax(0.0, last->ahead_by_stamp[i] + change - limit * since.made);
            next->ahead_by_stamp[i] = ahead;
            if (ahead > limit * AHEAD_BY_STAMP && change > speed * since.made) {
                too_fast = i;
                speed = change / fmax(since.made, 1e-9);
            }
        }
        if (since.received >= 0.0) {
            double ahead = fmax(0.0, last->ahead_by_receipt[i] - limit * waited);
            ahead = fmax(0.0, ahead + change - limit * (since.received - waited));
            next->ahead_by_receipt[i] = ahead;
            if (ahead / limit - AHEAD_BY_RECEIPT > wait) {
                early = i;
                wait = ahead / limit - AHEAD_BY_RECEIPT;
            }
        }
    }
    if (too_fast >= 0) {
        return found(HC_SPEED, too_fast, speed);
    }
    return early >= 0 ? found(HC_EARLY, early, wait) : found(HC_OK, -1, 0.0);
}

/* Check the struts' accelerations by the stamps, the changes of their smoothed speeds; write these speeds. */
static finding check_acceleration(const hc_last *last, hc_last *next, double limit)
{
    const double made = elapsed(last, next).made, period = fmax(made, SHORTEST_PERIOD);
    const double keep = exponential(-period / SMOOTHED_OVER, 0.0);
    finding worst = found(HC_OK, -1, limit);
    if (made < 0.0) { /* times of receipt jitter by more than a period */
        return worst;
    }
    for (int i = 0; i < 6; i++) {
        const double before = last->smooth_speed[i], speed = (next->command[i] - last->command[i]) / period;
        const double smooth = speed == speed ? keep * before + (1.0 - keep) * speed : 0.0;
        const double acceleration = fabs(smooth - before) / period;
        next->smooth_speed[i] = smooth;
        if (acceleration > worst.value) {
            worst = found(HC_ACCELERATION, i, acceleration);
        }
    }
    return worst;
}

/* Check correction, step, speed and acceleration; `compensated` is set to 0 if the nominal values break a limit. */
static finding check_command(const hc_last *last, hc_last *next, const hc_limits *limits, int *compensated)
{
    for (int i = 0; i < 6; i++) {
        if (!(fabs(next->correction[i]) <= limits->correction)) {
            return found(HC_CORRECTION, i, next->correction[i]);
        }
    }
    finding f = check_change(next->nominal, last->nominal, limits->step);
    if (f.status != HC_OK) {
        *compensated = 0;
        return f;
    }
    f = check_change(next->command, last->command, limits->step);
    if (f.status == HC_OK) {
        f = check_speed(last, next, limits->speed);
    }
    if (f.status == HC_OK && limits->acceleration > 0.0) {
        f = check_acceleration(last, next, limits->acceleration);
    }
    return f;
}

/* Compute the next command and check all limits; `next` is valid only if the result is HC_OK. */
static finding next_command(const hc_state *state, const hc_pose *platform, hc_time time, hc_last *next, hc_answer *answer)
{
    const hc_model *model = state->model;
    const hc_last *last = &state->last;
    const hc_limits *limits = &model->limits;
    six_struts now = struts_of(model->base.joints, model->platform.joints, platform);
    double unused;
    *next = *last;
    answer->platform = *platform;
    answer->compensated = 0;
    answer->outside_field = 0;
    next->platform = *platform;
    copy_six(now.length, next->nominal);
    finding f = check_stage(model->base.joints, platform, &now, next->nominal, limits, &answer->condition);
    if (f.status != HC_OK) {
        return f;
    }
    answer->compensated = 1;
    if (!run_backwards(state, platform, next->motion_low, next->motion_sense, &next->model, &now, next->command,
                       &answer->outside_field)) {
        return found(HC_NOT_CONVERGED, -1, NAN);
    }
    for (int i = 0; i < 6; i++) {
        next->correction[i] = (double)last->enabled * (next->command[i] - next->nominal[i]);
    }
    next->time = time.made;
    next->received = time.received;
    next->published = NAN;
    next->changed = 0;
    next->resumes = HC_FROM_LAST;
    shrink_ramp(last, next, state->ramp_rate);
    for (int i = 0; i < 6; i++) {
        next->correction[i] += next->ramp[i];
        next->command[i] = next->nominal[i] + next->correction[i];
    }
    if (answer->outside_field && model->field.refuse_outside) {
        return found(HC_OUTSIDE_FIELD, -1, NAN);
    }
    f = check_command(last, next, limits, &answer->compensated);
    if (f.status != HC_OK) {
        return f;
    }
    return check_stage(state->base_joints, &next->model, &now, next->command, limits, &unused);
}

/* Set the last correction to measured - nominal lengths, if this difference is within the limit of corrections. */
static void set_measured_correction(const hc_state *state, const hc_last *trial, hc_last *last)
{
    double difference[6];
    for (int i = 0; i < 6; i++) {
        difference[i] = last->command[i] - trial->nominal[i];
        if (!(fabs(difference[i]) <= state->model->limits.correction)) {
            return;
        }
    }
    copy_six(difference, last->correction);
    last->changed = 1;
}

/* Write the result of a check, and the lengths of `last`, into an answer. */
static void fill_answer(const hc_last *last, finding f, hc_answer *answer)
{
    answer->status = f.status;
    answer->strut = f.strut;
    answer->value = f.value;
    copy_six(last->nominal, answer->nominal);
    copy_six(last->correction, answer->correction);
    copy_six(last->command, answer->command);
}

/* After a change of tool: refuse a command whose nominal lengths differ from the last ones, before any other reason. */
static finding same_place(const hc_last *last, const hc_last *next, finding f, hc_answer *answer)
{
    finding worst = found(HC_TOOL_CHANGED, -1, 0.0);
    for (int i = 0; i < 6; i++) {
        const double change = next->nominal[i] - last->nominal[i];
        if (!(fabs(change) <= fabs(worst.value))) {
            worst = found(HC_TOOL_CHANGED, i, change);
        }
    }
    if (fabs(worst.value) <= SAME_PLACE) {
        return f;
    }
    answer->compensated = 0;
    return worst;
}

/* Command a platform pose. A `status` other than HC_OK says why there is no pose; it is then the answer. */
static hc_status command_platform(hc_state *state, hc_status status, const hc_pose *platform, hc_time time,
                                  hc_answer *answer)
{
    hc_last next;
    finding f = found(status, -1, NAN);
    answer->condition = NAN;
    answer->compensated = 0;
    answer->outside_field = 0;
    if (status == HC_OK) {
        f = next_command(state, platform, time, &next, answer);
        if (state->last.resumes == HC_WITH_NEW_TOOL) {
            f = same_place(&state->last, &next, f, answer);
        } else if (state->last.resumes == HC_FROM_MEASURED) {
            const hc_last before = state->last;
            set_measured_correction(state, &next, &state->last);
            f = next_command(state, platform, time, &next, answer);
            state->last = before;
        }
        if (f.status == HC_OK) {
            state->last = next;
        }
    }
    fill_answer(&state->last, f, answer);
    return f.status;
}

hc_status hc_command(hc_state *state, const double numbers[7], hc_time time, const hc_pose *frame, hc_answer *answer)
{
    hc_pose pose;
    const hc_status status = read_pose(numbers, &pose);
    if (status != HC_OK) {
        return command_platform(state, status, &state->last.platform, time, answer);
    }
    return hc_command_pose(state, &pose, time, frame, answer);
}

hc_status hc_command_pose(hc_state *state, const hc_pose *pose, hc_time time, const hc_pose *frame, hc_answer *answer)
{
    const hc_model *model = state->model;
    const hc_pose in_base = compose(frame ? frame : &model->work, pose);
    const hc_pose platform = compose(&in_base, &model->tool_inverse);
    return command_platform(state, HC_OK, &platform, time, answer);
}

hc_status hc_command_lengths(hc_state *state, const double nominal[6], hc_time time, hc_answer *answer)
{
    const hc_model *model = state->model;
    const judge by = judge_of(&model->limits);
    hc_pose platform = state->last.platform;
    const solution found = solve_pose(model->base.joints, model->platform.joints, nominal, &by, &platform);
    return command_platform(state, found.status, &platform, time, answer);
}

void hc_published(hc_state *state, double time)
{
    state->last.published = time;
}

/* The model forwards: write q for six commands. Screw rotation and load depend on the pose, so lengths and pose are computed
 * in turn until the lengths no longer change. */
static solution run_forwards(const hc_state *state, const double commands[6], const double sense[9], hc_pose *q)
{
    const hc_model *model = state->model;
    const judge by = judge_of(&model->limits);
    double lengths[6], shifts[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0}, stretch[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    solution found = {HC_NOT_CONVERGED, 0, NAN};
    int by_pose = model->load.bends;
    for (int i = 0; i < 6; i++) {
        by_pose = by_pose || model->struts[i].lead != 0.0;
    }
    for (int count = 0; count < TURN_ITERATIONS; count++) {
        six_struts now;
        double change = 0.0, before[6];
        copy_six(stretch, before);
        if (by_pose) {
            now = struts_of(state->base_joints, state->platform_joints, q);
        }
        if (model->load.bends) {
            load_stretch(state, q, &now, sense, stretch);
        }
        for (int i = 0; i < 6; i++) {
            const double shift = screw_shift(model, q, &now, i);
            change = fmax(change, fabs(shift - shifts[i]) + fabs(stretch[i] - before[i]));
            shifts[i] = shift;
            lengths[i] = actual_length(state, i, commands[i], sense[3 + i], shift) + stretch[i];
        }
        if (by_pose && found.status == HC_OK && change < 1e-15) {
            break;
        }
        found = solve_pose(state->base_joints, state->platform_joints, lengths, &by, q);
        if (found.status != HC_OK || !by_pose) {
            break;
        }
    }
    return found;
}

hc_status hc_estimate(hc_state *state, const double lengths[6], hc_estimated *estimated)
{
    hc_pose q = state->estimate, actual;
    const solution found = run_forwards(state, lengths, state->last.motion_sense, &q);
    estimated->status = found.status;
    estimated->condition = found.condition;
    if (found.status == HC_OK) {
        state->estimate = q;
        apply_field(&state->model->field, &q, state->last.motion_sense, &actual);
        estimated->tool = compose(&actual, &state->model->tool);
    }
    return estimated->status;
}

/* Write the real joints of a body with a relative growth, m. */
static void place_joints(const hc_body *body, double growth, double joints[6][3])
{
    for (int i = 0; i < 6; i++) {
        for (int k = 0; k < 3; k++) {
            const double nominal = body->joints[i][k], deviation = body->deviation[i][k];
            joints[i][k] = nominal + (deviation + growth * (nominal + deviation));
        }
    }
}

/* Relative growth of a part since 20 degrees Celsius. */
static double part_growth(const hc_state *state, int part, double expansion)
{
    const hc_late *late = &state->model->late;
    const int sensor = late->sensors[part];
    double growth = expansion * (state->temperatures[sensor] - REFERENCE_TEMPERATURE);
    for (int k = 0; k < late->count && finite_number(state->began[sensor]); k++) {
        growth += late->expansion[part][k] * state->behind[sensor][k];
    }
    return growth;
}

/* Update the real joints and the struts' growth for the present temperatures and humidity. */
static void place_machine(hc_state *state)
{
    for (int i = 0; i < 6; i++) {
        const hc_strut *strut = &state->model->struts[i];
        state->growth[i] = part_growth(state, i, strut->expansion)
                           + strut->moisture * (state->humidity - REFERENCE_HUMIDITY);
    }
    place_joints(&state->model->base, part_growth(state, 6, state->model->base.expansion), state->base_joints);
    place_joints(&state->model->platform, part_growth(state, 7, state->model->platform.expansion), state->platform_joints);
}

/* Update a sensor's first-order lags with a reading; the temperature is taken as linear between readings. */
static void follow_late(hc_state *state, int index, double value, double time)
{
    const hc_late *late = &state->model->late;
    const double change = value - state->temperatures[index];
    const double elapsed = fmax(0.0, time - state->newest[index]);
    if (!finite_number(state->began[index])) {
        state->began[index] = time;
        state->newest[index] = time;
        return;
    }
    state->newest[index] = fmax(state->newest[index], time);
    for (int k = 0; k < late->count; k++) {
        const double ages = elapsed / late->time_constants[k];
        const double gone = -exponential(-ages, 1.0);
        const double kept = ages > 0.0 ? gone / ages : 1.0;
        state->behind[index][k] = state->behind[index][k] * (1.0 - gone) - change * kept;
    }
}

/* Write the nine values whose directions of motion are followed, at the last command; return 0 if there was no command or the
 * model does not run backwards there. */
static int motion_values(const hc_state *state, double values[9])
{
    hc_last copy = state->last;
    six_struts now;
    double commands[6];
    int outside;
    for (int i = 0; i < 6; i++) {
        if (!finite_number(copy.nominal[i])) {
            return 0;
        }
    }
    if (!run_backwards(state, &copy.platform, copy.motion_low, copy.motion_sense, &copy.model, &now, commands, &outside)) {
        return 0;
    }
    store(point_at(&copy.platform, state->model->field.probe), values);
    copy_six(now.length, values + 3);
    return 1;
}

/* Replace the state by `changed`, with another model, temperature, humidity or load. The model's lengths jump, though no strut
 * moves. The dead bands of the directions of motion jump too, so that no direction, and no correction of backlash, reverses. */
static void take_over(hc_state *state, const hc_state *changed)
{
    double before[9], after[9];
    int comparable = motion_values(state, before);
    *state = *changed;
    place_machine(state);
    comparable = motion_values(state, after) && comparable;
    for (int i = 0; i < 9 && comparable; i++) {
        state->last.motion_low[i] += after[i] - before[i];
    }
    state->last.changed = 1;
}

hc_status hc_set_temperature(hc_state *state, int index, double value, double time)
{
    hc_state changed = *state;
    if (index < 0 || index > 7 || !(value >= LOWEST_TEMPERATURE && value <= HIGHEST_TEMPERATURE)
        || (state->model->late.count && !finite_number(time))) {
        return HC_TEMPERATURE;
    }
    if (state->model->late.count) {
        follow_late(&changed, index, value, time);
    }
    changed.temperatures[index] = value;
    take_over(state, &changed);
    return HC_OK;
}

hc_status hc_set_humidity(hc_state *state, double value)
{
    hc_state changed = *state;
    if (!(value >= LOWEST_HUMIDITY && value <= 1.0)) {
        return HC_HUMIDITY;
    }
    changed.humidity = value;
    take_over(state, &changed);
    return HC_OK;
}

hc_status hc_set_load(hc_state *state, const double gravity[3], const double wrench[6])
{
    hc_state changed = *state;
    const int back = gravity && gravity[0] != gravity[0]; /* NAN restores the model's gravity */
    if (gravity && !back && !(norm(row_of(gravity)) <= LARGEST_GRAVITY)) {
        return HC_LOAD;
    }
    for (int i = 0; wrench && i < 6; i++) {
        if (!finite_number(wrench[i])) {
            return HC_LOAD;
        }
    }
    if (gravity) {
        store(back ? vector(NAN, NAN, NAN) : row_of(gravity), changed.gravity);
    }
    if (wrench) {
        copy_six(wrench, changed.external);
    }
    if (state->model->load.bends) {
        take_over(state, &changed);
    } else {
        *state = changed;
    }
    return HC_OK;
}

/* Forget the sensors' lags, as after a long time at constant temperatures. */
static void reset_lags(hc_state *state)
{
    for (int i = 0; i < 8; i++) {
        state->began[i] = NAN;
        state->newest[i] = NAN;
        state->behind[i][0] = 0.0;
        state->behind[i][1] = 0.0;
    }
}

/* The state with another model; if its time constants differ, the lags are reset. */
static hc_state with_model(const hc_state *state, const hc_model *model)
{
    const hc_late *late = &state->model->late;
    hc_state changed = *state;
    int same = late->count == model->late.count;
    for (int k = 0; k < late->count && same; k++) {
        same = late->time_constants[k] == model->late.time_constants[k];
    }
    changed.model = model;
    if (!same) {
        reset_lags(&changed);
    }
    place_machine(&changed);
    return changed;
}

/* Let the next command ramp from the last correction, if there is one. */
static void start_ramp(hc_last *last)
{
    last->changed = last->correction[0] == last->correction[0];
}

/* Forget the last command, so that step, speed and acceleration of the next command are not checked. */
static void forget_command(hc_last *last)
{
    for (int i = 0; i < 6; i++) {
        last->nominal[i] = NAN;
        last->command[i] = NAN;
        last->ahead_by_stamp[i] = 0.0;
        last->smooth_speed[i] = 0.0;
    }
    last->time = NAN;
}

hc_status hc_check(const hc_state *state, const hc_model *model, hc_answer *answer)
{
    const hc_time unknown = {NAN, NAN};
    hc_state trial = with_model(state, model);
    hc_last next;
    int home = 0;
    forget_command(&trial.last); /* the present motion of the struts must not count as step or acceleration */
    for (int i = 0; i < 6; i++) {
        home = home || !finite_number(state->last.nominal[i]);
        trial.last.correction[i] = NAN;
        trial.last.ramp[i] = 0.0;
    }
    trial.last.enabled = 1;
    trial.last.changed = 0;
    const finding f = next_command(&trial, home ? &model->home : &state->last.platform, unknown, &next, answer);
    fill_answer(&next, f, answer);
    return f.status;
}

hc_status hc_set_model(hc_state *state, const hc_model *model)
{
    const hc_state changed = with_model(state, model);
    hc_answer unused;
    const hc_status status = hc_check(state, model, &unused);
    if (status == HC_OK) {
        take_over(state, &changed);
    }
    return status;
}

void hc_set_tool(hc_state *state, const hc_model *model)
{
    state->model = model;
    place_machine(state);
    if (finite_number(state->last.nominal[0])) {
        state->last.resumes = HC_WITH_NEW_TOOL;
        state->last.changed = state->last.changed || model->load.bends; /* the new tool's weight ramps in */
    }
}

hc_status hc_enable(hc_state *state, int enabled)
{
    const int wanted = enabled != 0;
    if (wanted != state->last.enabled) {
        hc_answer unused;
        const hc_status status = wanted ? hc_check(state, state->model, &unused) : HC_OK;
        if (status != HC_OK) {
            return status;
        }
        state->last.enabled = wanted;
        start_ramp(&state->last);
    }
    return HC_OK;
}

/* Forget the last command and the directions of motion; the last correction stays, and the next command ramps from it. */
static void forget(hc_state *state)
{
    for (int i = 0; i < 9; i++) {
        state->last.motion_low[i] = NAN;
        state->last.motion_sense[i] = 0.0;
    }
    forget_command(&state->last);
    state->last.resumes = HC_FROM_LAST;
    start_ramp(&state->last);
    state->estimate = state->model->home;
}

hc_status hc_reset(hc_state *state, const double measured[6])
{
    for (int i = 0; measured && i < 6; i++) {
        if (!finite_number(measured[i])) {
            return HC_NOT_FINITE;
        }
    }
    forget(state);
    for (int i = 0; measured && i < 6; i++) {
        state->last.command[i] = measured[i];
        state->last.resumes = HC_FROM_MEASURED;
    }
    return HC_OK;
}

void hc_init(hc_state *state, const hc_model *model, double ramp_rate)
{
    *state = (hc_state){.model = model, .ramp_rate = ramp_rate, .humidity = REFERENCE_HUMIDITY}; /* other members: 0 */
    for (int i = 0; i < 8; i++) {
        state->temperatures[i] = REFERENCE_TEMPERATURE;
    }
    store(vector(NAN, NAN, NAN), state->gravity);
    reset_lags(state);
    store(vector(NAN, NAN, NAN), state->last.correction);
    store(vector(NAN, NAN, NAN), state->last.correction + 3);
    state->last.received = NAN;
    state->last.published = NAN;
    state->last.platform = model->home;
    state->last.model = model->home;
    state->last.enabled = 1;
    forget(state);
    place_machine(state);
}

const char *hc_version(void)
{
    return "2";
}

const char *hc_reason(hc_status status)
{
    static const char names[][20] = {
        "", "stroke", "stroke", "base_cone", "platform_cone", "clearance", "condition", "assembly",
        "not_finite", "correction", "step", "speed", "speed", "acceleration",
        "not_converged", "outside_field", "quaternion",
        "singular", "unreachable", "other_assembly_mode",
        "bad_model", "bad_model", "tool_changed", "bad_model"}; /* in the order of hc_status */
    return (size_t)status < sizeof names / sizeof names[0] ? names[status] : "unknown";
}
