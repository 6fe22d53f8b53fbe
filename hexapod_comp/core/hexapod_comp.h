/* SPDX-License-Identifier: Apache-2.0
 *
 * Compensation of a hexapod machine tool: tool poses in, compensated strut lengths out.
 *
 * The arithmetic of hexapod_comp, in its Python package and in a servo thread alike: no allocation, no globals, no
 * input or output, no recursion, every loop bounded, nothing needed but <math.h>. The machine and its error model
 * stand in one constant, which `hexapod_comp export --c` writes into hexapod_model.h; all that changes lies in a state
 * that you own.
 *
 * Units: metres, radians, seconds; temperatures in degrees Celsius. Quaternions are (x, y, z, w). Matrices lie by rows.
 * Frames: `base` does not move, `platform` carries the tool, `work` is where poses are commanded.
 *
 * Compile without contraction of products and sums (gcc: -ffp-contract=off, which -std=c99 implies), or the last
 * digits depend on the target.
 */
#ifndef HEXAPOD_COMP_H
#define HEXAPOD_COMP_H

#ifdef __cplusplus
extern "C" {
#endif

/* What became of a command or an estimate. hc_reason() names each as the Python package does. */
typedef enum {
    HC_OK = 0,
    HC_STROKE_SHORT, HC_STROKE_LONG, HC_BASE_CONE, HC_PLATFORM_CONE, HC_CLEARANCE, HC_CONDITION, HC_ASSEMBLY, /* of a pose */
    HC_NOT_FINITE, HC_CORRECTION, HC_STEP, HC_SPEED, HC_EARLY, HC_ACCELERATION, /* of a command */
    HC_NOT_CONVERGED, HC_OUTSIDE_FIELD, HC_QUATERNION,
    HC_SINGULAR, HC_UNREACHABLE, HC_OTHER_ASSEMBLY, /* of strut lengths */
    HC_TEMPERATURE, HC_HUMIDITY, HC_TOOL_CHANGED, HC_LOAD
} hc_status;

/* Where the next command starts: at the last one; at measured struts; or, since the tool has changed, where it must be. */
typedef enum { HC_FROM_LAST = 0, HC_FROM_MEASURED, HC_WITH_NEW_TOOL } hc_start;

/* Position, m, and rotation matrix. */
typedef struct {
    double position[3];
    double rotation[3][3];
} hc_pose;

/* Joint centres and cardan axes of one body, in its frame; the model's deviation of each joint; its expansion. */
typedef struct {
    double joints[6][3];
    double deviation[6][3];
    double axes[6][3];
    double expansion; /* 1/K */
} hc_body;

/* One strut's errors: the length that it really has is (1 + growth) (command + error - backlash - screw shift). */
typedef struct {
    double offset;     /* m */
    double pitch;      /* m per m, about `reference` */
    double reference;  /* m */
    double wavenumber; /* rad/m, of the screw's turning */
    double harmonics;  /* how many of `wave` count, 0 to 4 */
    double backlash;   /* m */
    double lead;       /* m per turn, positive for a right-hand screw */
    double twist_home; /* rad */
    double expansion;  /* 1/K */
    double moisture;   /* growth by relative humidity from 0 to 1 */
    double wave[4][2]; /* m, cosine and sine of the periodic error once, twice, three and four times a turn */
} hc_strut;

/* Cubic pieces of the struts' length maps and of their backlash's change; no knots where there is no map. */
typedef struct {
    int knot_count;
    const double *knots;  /* knot_count, m */
    const double *pieces; /* 6 x (knot_count - 1) x 2 x 4, lengths before backlash, highest power first */
} hc_map;

/* Error field: three families of lines through the nodes of a grid, see GridField. */
typedef struct {
    double probe[3]; /* measured point in `platform`, m */
    int node_count[3];
    const double *nodes[3]; /* in `base`, m */
    int powers[3];          /* coefficients per polynomial; 0: this family was not measured */
    const double *lines[3]; /* direction x cross node x cross node x power x 6 */
    int refuse_outside;     /* 1: poses outside the box are refused; 0: the value at the boundary is held */
} hc_field;

/* What a command must keep; `apart` is 1 for pairs of struts whose distance counts. */
typedef struct {
    double stroke[6][2];
    double cone_axes[2][6][3];
    double cone_cosines[2][6];
    double apart[6][6];
    double condition;
    double correction;
    double step;
    double clearance;
    double characteristic_length;
    double home_sign;
    double speed;        /* m/s */
    double acceleration; /* m/s2, 0: not limited */
} hc_limits;

/* How parts follow their thermometers: see machine/late.py. `sensors`: whose thermometer stands for each part. */
typedef struct {
    int count;                 /* of time constants, 0 to 2 */
    double time_constants[2];  /* s */
    double expansion[8][2];    /* of struts 1-6, base, platform, 1/K */
    int sensors[8];
} hc_late;

/* What struts, with their joints, give under the weight that they carry. The platform carries its own weight and the
 * tool's; a strut that pulls by a force T is longer by compliance * T + play / 2, one that pushes is shorter. */
typedef struct {
    int bends;             /* 0: nothing does, and none of the rest counts */
    double compliance[6];  /* m/N */
    double play[6];        /* m: lost motion when the strut's force changes its sign */
    double friction[6];    /* N m: torque of each of its bearings against its turning, by the direction of motion */
    double take_up;        /* N: below this force the play is taken up in proportion, so that nothing jumps */
    double mass;           /* kg, of platform and tool */
    double moment[3];      /* kg m: mass times centre of mass, in `platform` */
    double gravity[3];     /* m/s2, in `base`, where hc_set_load has told of no other */
} hc_load;

/* A machine with its error model: constant, generated by `hexapod_comp export --c`. */
typedef struct {
    const char *machine;
    const char *model;
    const char *date;
    const char *geometry_sha256; /* of the files that it was made of; of nothing for the ideal model */
    const char *model_sha256;
    hc_body base;
    hc_body platform;
    hc_pose home;         /* pose_platform_in_base */
    hc_pose work;         /* pose_work_in_base */
    hc_pose tool;         /* pose_tool_in_platform */
    hc_pose tool_inverse; /* pose_platform_in_tool */
    hc_limits limits;
    hc_strut struts[6];
    hc_map map;
    hc_field field;
    hc_late late;
    hc_load load;
    double axis_threshold;  /* m: how far the measured point comes back before its direction counts as reversed */
    double strut_threshold; /* m: the same of a strut */
} hc_model;

/* All that one command leaves behind. Recordings hold it under these names: a new meaning needs a new name.
 * Windows and directions of motion are those of the measured point's x, y, z and of the struts. */
typedef struct {
    double motion_low[9];   /* lower end of each window, m; NAN before the first value */
    double motion_sense[9]; /* +1 forward, -1 backward, 0 not known */
    double nominal[6];
    double correction[6];
    double command[6]; /* after hc_reset to measured struts, where they stand */
    double ramp[6];    /* the part of the correction that a change has still to take away */
    double time;
    hc_pose platform; /* pose_platform_in_base commanded */
    hc_pose model;    /* q with q o E(q) = that pose */
    int enabled;
    int changed; /* model, temperatures or enabling have, since the last command */
    hc_start resumes;
    double received;
    double published;
    double ahead_by_stamp[6]; /* how far each strut is ahead of the speed limit by the one clock and by the other, m */
    double ahead_by_receipt[6];
    double smooth_speed[6]; /* m/s */
} hc_last;

/* A compensator at work. The caller owns it; two of them know nothing of each other. */
typedef struct {
    const hc_model *model;
    double ramp_rate;           /* m/s */
    double temperatures[8];     /* struts 1-6, base, platform, degrees Celsius */
    double began[8];            /* when each was first read, NAN before that, and last, s; where there are late parts */
    double newest[8];
    double behind[8][2];        /* how far what follows each late is behind, K */
    double base_joints[6][3];   /* where the real joints are at these temperatures, m */
    double platform_joints[6][3];
    double growth[6];
    double humidity; /* 0 to 1 */
    double gravity[3];  /* m/s2, in `base`; NAN: the model's */
    double external[6]; /* force, N, and torque about the origin of `platform`, N m, in `platform` */
    hc_last last;
    hc_pose estimate; /* model pose of the last estimate: where the next one begins */
} hc_state;

/* The answer to a command. After a refusal the lengths are those of the last command (NaN before the first one). */
typedef struct {
    hc_status status;
    int strut;         /* 0-5 that a refusal is about, -1 for none */
    int compensated;   /* 1: the compensated value broke the limit, 0: the nominal one */
    double value;      /* that broke the limit, m, rad, m/s, m/s2 or 1; of HC_EARLY the time to wait, s */
    double condition;  /* number of the nominal pose, NaN where it was not reached */
    int outside_field; /* 1: the field's value was held at the boundary of its box */
    hc_pose platform;  /* pose_platform_in_base that was asked for */
    double nominal[6];    /* m */
    double correction[6]; /* command - nominal, m */
    double command[6];    /* m */
} hc_answer;

/* Where the tool is. */
typedef struct {
    hc_status status;
    double condition;
    hc_pose tool; /* pose_tool_in_base; written only when the status is HC_OK */
} hc_estimated;

/* Begin: nothing commanded yet, compensation on, 20 degrees Celsius everywhere. ramp_rate: m/s, usually 1e-3. */
void hc_init(hc_state *state, const hc_model *model, double ramp_rate);

/* When a command was made, s, for ramps and for the struts' speed: only differences count. `received` is for commands that
 * came by a network, on a clock that nobody sets; NAN in a servo thread, and HC_EARLY then never comes. */
typedef struct {
    double made;
    double received;
} hc_time;

/* Compensate one tool pose: x, y, z, m, and quaternion x, y, z, w, seen from `frame` (a pose in `base`; NULL: the
 * machine's work frame). A refused command leaves the state as it was. */
hc_status hc_command(hc_state *state, const double pose[7], hc_time time, const hc_pose *frame, hc_answer *answer);

/* The same with a pose that is one: position and rotation matrix. */
hc_status hc_command_pose(hc_state *state, const hc_pose *pose, hc_time time, const hc_pose *frame, hc_answer *answer);

/* Note when the last command went out, s, on the clock of its receipt. */
void hc_published(hc_state *state, double time);

/* The same for a controller that plans struts: nominal lengths of the machine without errors, m. The pose is sought from the
 * last one, so they must come in steps; the correction belongs to these very lengths. */
hc_status hc_command_lengths(hc_state *state, const double nominal[6], hc_time time, hc_answer *answer);

/* Say where the tool is when the struts read these lengths, m. A refusal leaves the state as it was. */
hc_status hc_estimate(hc_state *state, const double lengths[6], hc_estimated *estimated);

/* Say what is wrong with all that a model would correct at the last command, before the first one at home: without ramp or
 * switch. Nothing changes. */
hc_status hc_check(const hc_state *state, const hc_model *model, hc_answer *answer);

/* Replace the model; corrections ramp from the old one's to the new one's. It stays with the old one, and says why, where
 * hc_check finds something. */
hc_status hc_set_model(hc_state *state, const hc_model *model);

/* Take the same machine and model with another tool. Nothing moves: the next command must be where the struts are. */
void hc_set_tool(hc_state *state, const hc_model *model);

/* Switch compensation on (1) or off (0); corrections ramp. It stays off, with the reason, when what the model would correct
 * at the last command, before the first one at home, breaks a limit. */
hc_status hc_enable(hc_state *state, int enabled);

/* Take a temperature, degrees Celsius: index 0-5 struts, 6 base, 7 platform. Its effect ramps in. HC_TEMPERATURE for
 * an unknown index or a value outside -40...120: nothing changes then. `time`, s, on the machine's own clock, is needed where
 * the model has late parts (`late.count`): HC_TEMPERATURE without. These need a reading every few seconds, changed or not. */
hc_status hc_set_temperature(hc_state *state, int index, double value, double time);

/* Take the air's relative humidity, 0.01 to 1. Its effect on struts that swell ramps in. HC_HUMIDITY outside: nothing changes. */
hc_status hc_set_humidity(hc_state *state, double value);

/* Take gravity, m/s2, in `base`, and what else acts on the platform: force, N, and torque about the origin of `platform`,
 * N m, both in `platform`. NULL leaves either as it is; a gravity of NAN brings back the model's. What this changes ramps
 * in. HC_LOAD for numbers that are not finite, or a gravity above 100 m/s2: nothing changes then. */
hc_status hc_set_load(hc_state *state, const double gravity[3], const double wrench[6]);

/* Forget the last command and all directions of motion. With `measured`, m, the next command starts from where the
 * struts are and ramps; NULL: it may be anywhere. HC_NOT_FINITE for lengths that are not: nothing changes then. */
hc_status hc_reset(hc_state *state, const double measured[6]);

/* Of the arithmetic: it changes when a bit of an answer does. */
const char *hc_version(void);

/* The name of a status, as the Python package counts refusals: "stroke", "step", ... */
const char *hc_reason(hc_status status);

#ifdef __cplusplus
}
#endif

#endif
