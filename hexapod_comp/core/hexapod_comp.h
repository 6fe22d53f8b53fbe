/* SPDX-License-Identifier: Apache-2.0
 *
 * Compensation of a hexapod machine tool: from tool poses to compensated strut lengths.
 *
 * This code is the arithmetic of the Python package hexapod_comp, and also runs in a servo thread: it allocates nothing, has
 * no globals, no input or output and no recursion; every loop is bounded, and it needs only <math.h>. The machine and its
 * error model are one constant, which `hexapod_comp export --c` writes into hexapod_model.h. All data that change are in an
 * hc_state that the caller owns.
 *
 * Units: metres, radians, seconds; temperatures in degrees Celsius. Quaternions are (x, y, z, w). Matrices are stored by
 * rows. Frames: `base` does not move, `platform` carries the tool; poses are commanded in the frame `work`.
 *
 * Compile without contraction of products and sums (gcc: -ffp-contract=off, which -std=c99 implies); otherwise the last
 * digits depend on the target.
 */
#ifndef HEXAPOD_COMP_H
#define HEXAPOD_COMP_H

#ifdef __cplusplus
extern "C" {
#endif

/* Result of a command or an estimate. hc_reason() returns the Python package's name of a result. */
typedef enum {
    HC_OK = 0,
    /* limits of a pose */
    HC_STROKE_SHORT, HC_STROKE_LONG, HC_BASE_CONE, HC_PLATFORM_CONE, HC_CLEARANCE, HC_CONDITION, HC_ASSEMBLY,
    /* limits of a command */
    HC_NOT_FINITE, HC_CORRECTION, HC_STEP, HC_SPEED, HC_EARLY, HC_ACCELERATION,
    HC_NOT_CONVERGED, HC_OUTSIDE_FIELD, HC_QUATERNION,
    HC_SINGULAR, HC_UNREACHABLE, HC_OTHER_ASSEMBLY, /* failures of forward kinematics */
    HC_TEMPERATURE, HC_HUMIDITY, HC_TOOL_CHANGED, HC_LOAD
} hc_status;

/* The strut lengths with which the next command is compared: those of the last command, measured ones, or, after a change of
 * tool, the last nominal lengths, which the next command must keep. */
typedef enum { HC_FROM_LAST = 0, HC_FROM_MEASURED, HC_WITH_NEW_TOOL } hc_start;

/* Position, m, and rotation matrix. */
typedef struct {
    double position[3];
    double rotation[3][3];
} hc_pose;

/* Base or platform, in its own frame. */
typedef struct {
    double joints[6][3];    /* nominal joint centres, m */
    double deviation[6][3]; /* real - nominal joint centres, m */
    double axes[6][3];      /* cardan axes fixed to the body, unit vectors */
    double expansion;       /* thermal expansion, 1/K */
} hc_body;

/* One strut's errors: its actual length is (1 + growth) (command + error - backlash / 2 by direction - screw shift). */
typedef struct {
    double offset;     /* m */
    double pitch;      /* pitch error, m per m of command beyond `reference` */
    double reference;  /* command at which the pitch error adds no length, m */
    double wavenumber; /* of the periodic screw error: rad per m of command */
    double harmonics;  /* number of harmonics used of `wave`, 0 to 4 */
    double backlash;   /* m */
    double lead;       /* m per turn, positive for a right-hand screw; 0: the screw does not turn with the joints */
    double twist_home; /* angle, rad, by which the joints turn the screw from parallel cardan axes to home */
    double expansion;  /* thermal expansion, 1/K */
    double moisture;   /* relative growth from 0 to 100 % relative humidity */
    double wave[4][2]; /* m: cosine and sine of the periodic error with 1, 2, 3 and 4 periods per turn */
} hc_strut;

/* Cubic splines of the struts' length errors and of their additional backlash over the command. */
typedef struct {
    int knot_count;       /* number of spline knots; 0: there is no map */
    const double *knots;  /* knot_count, m */
    const double *pieces; /* 6 x (knot_count - 1) x 2 x 4: length error, then backlash; highest power first */
} hc_map;

/* Error field: polynomials along lines through the nodes of a grid, see GridField. */
typedef struct {
    double probe[3];        /* measured point in `platform`, m */
    int node_count[3];
    const double *nodes[3]; /* in `base`, m */
    int powers[3];          /* coefficients of each polynomial on lines along x, y, z; 0: no lines along this axis */
    const double *lines[3]; /* direction x cross node x cross node x power x 6 */
    int refuse_outside;     /* 1: poses outside the box are refused; 0: the value at the boundary is held */
} hc_field;

/* Limits of poses and commands, see Limits. */
typedef struct {
    double stroke[6][2];          /* shortest and longest length, m */
    double cone_axes[2][6][3];    /* neutral directions of the joints at base and platform, in their body's frame */
    double cone_cosines[2][6];    /* cosines of the largest angles to these directions */
    double apart[6][6];           /* 1 for pairs of struts whose clearance is checked */
    double condition;             /* largest condition number of the Jacobian */
    double correction;            /* largest strut correction, m */
    double step;                  /* largest change of a length between two commands, m */
    double clearance;             /* m, 0: not limited */
    double characteristic_length; /* m */
    double home_sign;             /* sign of det J at home */
    double speed;                 /* m/s */
    double acceleration;          /* m/s2, 0: not limited */
} hc_limits;

/* How the parts' growth follows their temperatures with a delay, see LateGrowth in machine/temperatures.py. */
typedef struct {
    int count;                 /* number of time constants, 0 to 2 */
    double time_constants[2];  /* s */
    double expansion[8][2];    /* delayed expansion of struts 1-6, base, platform, 1/K */
    int sensors[8];            /* index of the part whose sensor gives each part's temperature */
} hc_late;

/* How struts with their joints stretch under load. A strut under tension T is longer by compliance * T + play / 2; a strut
 * under pressure is shorter. The weight is that of platform and tool. */
typedef struct {
    int bends;             /* 0: no strut stretches, and the other members have no effect */
    double compliance[6];  /* m/N */
    double play[6];        /* m: lost motion when the strut's force changes its sign */
    double friction[6];    /* N m: friction torque of each of the strut's bearings, against the direction of motion */
    double take_up;        /* N: a smaller force takes up the play in proportion, so that the length does not jump */
    double mass;           /* kg, of platform and tool */
    double moment[3];      /* kg m: mass times centre of mass, in `platform` */
    double gravity[3];     /* m/s2, in `base`; used until hc_set_load sets another */
} hc_load;

/* A machine with its error model: constant, generated by `hexapod_comp export --c`. */
typedef struct {
    const char *machine;
    const char *model;
    const char *date;
    const char *geometry_sha256; /* of the geometry file */
    const char *model_sha256;    /* of the model file; of an empty text for the ideal model */
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
    double axis_threshold;  /* motion back, m, after which an axis of the measured point counts as reversed */
    double strut_threshold; /* motion back, m, after which a strut counts as reversed */
} hc_model;

/* The state after the last command. Recordings store the members by name, so a member with a new meaning needs a new name.
 * Motion: nine values, the measured point's x, y, z and the six struts. */
typedef struct {
    double motion_low[9];   /* lower end of each value's dead band, m; NAN before the first value */
    double motion_sense[9]; /* +1 forward, -1 backward, 0 not known */
    double nominal[6];      /* m; NAN: no command yet */
    double correction[6];   /* m */
    double command[6];      /* m; after hc_reset with measured lengths: these lengths */
    double ramp[6];         /* part of the correction, m, that still has to be ramped away after a change */
    double time;            /* `made` of the command, s */
    hc_pose platform;       /* pose_platform_in_base commanded */
    hc_pose model;          /* q with q o E(q) = platform */
    int enabled;            /* 1: compensation is on */
    int changed;            /* 1: model, temperatures, load or `enabled` have changed since this command */
    hc_start resumes;           /* with which lengths the next command is compared */
    double received;            /* `received` of the command, s */
    double published;           /* time given to hc_published, s */
    double ahead_by_stamp[6];   /* m by which each strut is ahead of the speed limit, by the commands' times `made` */
    double ahead_by_receipt[6]; /* m by which each strut is ahead of the speed limit, by the times `received` */
    double smooth_speed[6];     /* smoothed strut speeds, m/s */
} hc_last;

/* The state of a compensator, which the caller owns. States are independent of each other. */
typedef struct {
    const hc_model *model;
    double ramp_rate;             /* m/s */
    double temperatures[8];       /* of struts 1-6, base, platform, degrees Celsius */
    double began[8];              /* time of each sensor's first reading, s; NAN before; for delayed growth only */
    double newest[8];             /* time of each sensor's newest reading, s */
    double behind[8][2];          /* delayed temperature - reading, K, for each time constant */
    double base_joints[6][3];     /* real joints at these temperatures, m */
    double platform_joints[6][3]; /* real joints at these temperatures, m */
    double growth[6];             /* relative growth of the struts */
    double humidity;              /* relative humidity, 0 to 1 */
    double gravity[3];            /* m/s2, in `base`; NAN: the model's gravity */
    double external[6];           /* force, N, and torque about the origin of `platform`, N m, in `platform` */
    hc_last last;
    hc_pose estimate;             /* model pose of the last estimate, from which the next one starts */
} hc_state;

/* The answer to a command. After a refusal the lengths are those of the last command (NaN before the first command). */
typedef struct {
    hc_status status;
    int strut;            /* 0-5: the strut that caused a refusal; -1: none */
    int compensated;      /* 1: the compensated value broke the limit, 0: the nominal value */
    double value;         /* value that broke the limit, m, rad, m/s, m/s2 or 1; with HC_EARLY the time to wait, s */
    double condition;     /* condition number of the nominal pose; NaN if it was not computed */
    int outside_field;    /* 1: the field's value was held at the boundary of its box */
    hc_pose platform;     /* pose_platform_in_base that was commanded */
    double nominal[6];    /* m */
    double correction[6]; /* command - nominal, m */
    double command[6];    /* m */
} hc_answer;

/* The tool's pose at measured strut lengths. */
typedef struct {
    hc_status status;
    double condition; /* condition number of the Jacobian at this pose */
    hc_pose tool;     /* pose_tool_in_base; written only if the status is HC_OK */
} hc_estimated;

/* Initialise a state: no command yet, compensation on, 20 degrees Celsius. ramp_rate: m/s, usually 1e-3. */
void hc_init(hc_state *state, const hc_model *model, double ramp_rate);

/* Times of a command, s, for ramps and limits of speed; only differences are used. `made`: when the controller made the
 * command. `received`: when it arrived by a network, on a monotonic clock; NAN in a servo thread, which disables HC_EARLY. */
typedef struct {
    double made;
    double received;
} hc_time;

/* Compensate one tool pose: x, y, z, m, and quaternion x, y, z, w, in `frame` (a pose in `base`; NULL: the machine's work
 * frame). A refused command does not change the state. */
hc_status hc_command(hc_state *state, const double pose[7], hc_time time, const hc_pose *frame, hc_answer *answer);

/* As hc_command, with position and rotation matrix. */
hc_status hc_command_pose(hc_state *state, const hc_pose *pose, hc_time time, const hc_pose *frame, hc_answer *answer);

/* Store the time, s, at which the last answer was published, on the clock of `received`. */
void hc_published(hc_state *state, double time);

/* As hc_command, for a controller that plans strut lengths: `nominal`, m, are lengths of the machine without errors. The
 * search for the pose starts at the last pose, so the lengths must change in small steps. */
hc_status hc_command_lengths(hc_state *state, const double nominal[6], hc_time time, hc_answer *answer);

/* Compute the tool's pose from measured strut lengths, m. A refusal does not change the state. */
hc_status hc_estimate(hc_state *state, const double lengths[6], hc_estimated *estimated);

/* Check the full correction of a model, without ramp, at the last commanded pose (before the first command: at home), also
 * while compensation is off. Does not change the state. */
hc_status hc_check(const hc_state *state, const hc_model *model, hc_answer *answer);

/* Replace the model; corrections ramp from the old to the new model. If hc_check refuses the new model, return the
 * reason and keep the old model. */
hc_status hc_set_model(hc_state *state, const hc_model *model);

/* Set `model`, which differs from the present one only in its tool. The struts keep their lengths: the next command must have
 * the same nominal lengths, otherwise it is refused with HC_TOOL_CHANGED. */
void hc_set_tool(hc_state *state, const hc_model *model);

/* Switch compensation on (1) or off (0); corrections ramp. If hc_check refuses the model, return the reason and stay off. */
hc_status hc_enable(hc_state *state, int enabled);

/* Set a temperature, degrees Celsius: index 0-5 struts, 6 base, 7 platform. Its effect ramps in. `time`: s, monotonic clock.
 * With delayed growth (`late.count`), call this every few seconds, also if the value is unchanged. Return HC_TEMPERATURE and
 * change nothing for an unknown index, a value outside -40...120, or, with delayed growth, a `time` that is not finite. */
hc_status hc_set_temperature(hc_state *state, int index, double value, double time);

/* Set the air's relative humidity, 0.01 to 1. Its effect on struts that swell ramps in. Return HC_HUMIDITY and change nothing
 * for a value outside. */
hc_status hc_set_humidity(hc_state *state, double value);

/* Set gravity, m/s2, in `base`, and the wrench that acts on the platform in addition to weight: force, N, and torque about the
 * origin of `platform`, N m, both in `platform`. An argument NULL changes nothing; a gravity of NAN restores the model's. The
 * effect ramps in. Return HC_LOAD and change nothing for numbers that are not finite, or a gravity above 100 m/s2. */
hc_status hc_set_load(hc_state *state, const double gravity[3], const double wrench[6]);

/* Forget the last command and all directions of motion. If lengths are `measured`, m, the next command may be one `step` from
 * them, and its correction ramps from theirs; if `measured` is NULL, the next command may be anywhere. Return HC_NOT_FINITE and
 * change nothing for lengths that are not finite. */
hc_status hc_reset(hc_state *state, const double measured[6]);

/* Return the version of the arithmetic, which changes when any bit of a result changes. */
const char *hc_version(void);

/* Return the name of a status by which the Python package counts refusals: "stroke", "step", ... */
const char *hc_reason(hc_status status);

#ifdef __cplusplus
}
#endif

#endif
