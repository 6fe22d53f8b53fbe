/* Replacement of the functions of LinuxCNC's HAL that genhexkins.so calls, so that it can be loaded without LinuxCNC;
 * and timed loops around its two functions, so that the time of a caller in Python is not counted.
 *
 * Names and argument lists are LinuxCNC's public ones (2.9): src/hal/hal.h, src/rtapi/rtapi.h,
 * src/emc/kinematics/kinematics.h; a pose is EmcPose of src/emc/nml_intf/emcpos.h: x y z a b c u v w.
 */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MOST_PINS 256
#define POSE 9
#define STRUTS 6

static struct pin {
    char name[64];
    union { double real; unsigned whole; unsigned char bit; } value;
} pins[MOST_PINS];
static int pin_count;

static int make_pin(void *where, const char *form, va_list parts)
{
    if (pin_count == MOST_PINS)
        return -1;
    vsnprintf(pins[pin_count].name, sizeof pins[pin_count].name, form, parts);
    *(void **)where = &pins[pin_count++].value;
    return 0;
}

#define FORMATTED_PIN(function)                                              \
    int function(int way, void *where, int owner, const char *form, ...)     \
    {                                                                        \
        va_list parts;                                                       \
        va_start(parts, form);                                               \
        int result = make_pin(where, form, parts);                           \
        va_end(parts);                                                       \
        return result;                                                       \
    }
FORMATTED_PIN(hal_pin_float_newf)
FORMATTED_PIN(hal_pin_u32_newf)
FORMATTED_PIN(hal_pin_bit_newf)

int hal_pin_bit_new(const char *name, int way, void *where, int owner)
{
    return hal_pin_bit_newf(way, where, owner, "%s", name);
}

int hal_pin_s32_new(const char *name, int way, void *where, int owner)
{
    return hal_pin_bit_newf(way, where, owner, "%s", name);
}

int hal_init(const char *name) { return 1; }
int hal_ready(int owner) { return 0; }
int hal_exit(int owner) { return 0; }
void *hal_malloc(long size) { return calloc(1, size); }
void rtapi_print(const char *form, ...) {}
void rtapi_print_msg(int level, const char *form, ...) {}

/* Return the address of a pin's value, or NULL if there is no such pin. */
void *pin_value(const char *name)
{
    for (int i = 0; i < pin_count; i++)
        if (!strcmp(pins[i].name, name))
            return &pins[i].value;
    return NULL;
}

/* Return the processor time of this thread, s; other threads and processes are not counted. */
static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

typedef int kinematics(const double *, double *, unsigned long *, unsigned long *);

/* Solve `count` rows of joints from one guess or, if `step` is 9, from one guess per row; return the time, s. */
double forward_many(kinematics *solve, long count, const double *joints, const double *guess, long step,
                    double *poses, int *codes)
{
    unsigned long forward = 0, inverse = 0;
    double begun = seconds();
    for (long i = 0; i < count; i++) {
        memcpy(poses + POSE * i, guess + step * i, POSE * sizeof(double));
        codes[i] = solve(joints + STRUTS * i, poses + POSE * i, &forward, &inverse);
    }
    return seconds() - begun;
}

/* Compute the joints of `count` poses; return the time, s. */
double inverse_many(kinematics *solve, long count, const double *poses, double *joints, int *codes)
{
    unsigned long forward = 0, inverse = 0;
    double begun = seconds();
    for (long i = 0; i < count; i++)
        codes[i] = solve(poses + POSE * i, joints + STRUTS * i, &inverse, &forward);
    return seconds() - begun;
}
