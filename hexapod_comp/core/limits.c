/* SPDX-License-Identifier: Apache-2.0
 *
 * Limits of a pose: strokes, joint cones, clearance, condition, assembly mode. doc/theory.md, 5 and 11.
 */
#include "core.h"

/* The result of a check: HC_OK, or the limit that is broken. */
typedef struct {
    hc_status status;
    int strut;    /* strut that breaks the limit, -1 for none */
    int other;    /* second strut concerned, -1 for none */
    double value; /* value that breaks the limit */
} finding;

static finding found(hc_status status, int strut, double value)
{
    return (finding){status, strut, -1, value};
}

static double clamp(double value, double low, double high)
{
    return fmax(low, fmin(high, value));
}

/* part / whole, clamped to 0...1; 0 if `whole` is 0. */
static double share_of(double part, double whole)
{
    return whole > 0.0 ? clamp(part / whole, 0.0, 1.0) : 0.0;
}

/* The smallest distance between the segments a-b and c-d. */
static double segment_distance(vec a, vec b, vec c, vec d)
{
    const vec u = subtract(b, a), v = subtract(d, c), w = subtract(a, c);
    const double uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w);
    double s = share_of(uv * vw - vv * uw, uu * vv - uv * uv);
    const double t = share_of(uv * s + vw, vv);
    s = share_of(uv * t - uw, uu);
    return norm(subtract(subtract(add(a, scale(s, u)), c), scale(t, v)));
}

/* Write the cosines of the struts' angles to their joints' neutral directions, at base and platform. */
static void joint_cosines(const hc_pose *pose, const six_struts *now, const hc_limits *limits, double cosines[2][6])
{
    for (int i = 0; i < 6; i++) {
        const vec s = now->strut[i];
        const mat r = three_rows(pose->rotation);
        cosines[0][i] = dot(s, row_of(limits->cone_axes[0][i])) / now->length[i];
        cosines[1][i] = dot(combine_rows(s, r.row), row_of(limits->cone_axes[1][i])) / now->length[i];
    }
}

/* Write, for each strut, distance and index of the nearest strut to which clearance is checked; infinite and -1: none. */
static void nearest_struts(const double base[6][3], const six_struts *now, const hc_limits *limits, double distances[6],
                           double nearest[6])
{
    vec starts[6], ends[6];
    for (int i = 0; i < 6; i++) {
        starts[i] = row_of(base[i]);
        ends[i] = add(starts[i], now->strut[i]);
        distances[i] = HUGE_VAL;
        nearest[i] = -1.0;
        for (int j = 0; j < i && limits->clearance > 0.0; j++) {
            const int pair[2] = {i, j};
            if (!(limits->apart[i][j] > 0.0)) {
                continue;
            }
            const double distance = segment_distance(starts[i], ends[i], starts[j], ends[j]);
            for (int k = 0; k < 2; k++) {
                if (distance < distances[pair[k]] || distance != distance) {
                    distances[pair[k]] = distance;
                    nearest[pair[k]] = pair[1 - k];
                }
            }
        }
    }
}

/* The first limit that a pose and its lengths break; `now` are the struts at this pose. */
static finding check_stage(const double base[6][3], const hc_pose *pose, const six_struts *now,
                           const double lengths[6], const hc_limits *limits, double *condition)
{
    double cosines[2][6], distances[6], nearest[6], sign;
    *condition = NAN;
    for (int i = 0; i < 6; i++) {
        if (!finite_number(lengths[i])) {
            return found(HC_NOT_FINITE, i, lengths[i]);
        }
        if (lengths[i] < limits->stroke[i][0]) {
            return found(HC_STROKE_SHORT, i, lengths[i]);
        }
        if (lengths[i] > limits->stroke[i][1]) {
            return found(HC_STROKE_LONG, i, lengths[i]);
        }
    }
    joint_cosines(pose, now, limits, cosines);
    for (int n = 0; n < 12; n++) {
        const int i = n / 2, body = n % 2;
        if (!(cosines[body][i] >= limits->cone_cosines[body][i])) {
            return found(body ? HC_PLATFORM_CONE : HC_BASE_CONE, i, arc_cosine(clamp(cosines[body][i], -1.0, 1.0)));
        }
    }
    nearest_struts(base, now, limits, distances, nearest);
    for (int i = 0; i < 6; i++) {
        if (!(distances[i] >= limits->clearance)) {
            return (finding){HC_CLEARANCE, i, (int)nearest[i], distances[i]};
        }
    }
    *condition = condition_at(base, pose, now, limits->characteristic_length, &sign);
    if (!(*condition <= limits->condition)) {
        return found(HC_CONDITION, -1, *condition);
    }
    return sign == limits->home_sign ? found(HC_OK, -1, 0.0) : found(HC_ASSEMBLY, -1, sign);
}

/* Check that no length changes by more than `largest`; NaN in `previous`: there are no previous lengths. */
static finding check_change(const double lengths[6], const double previous[6], double largest)
{
    for (int i = 0; i < 6; i++) {
        const double change = lengths[i] - previous[i];
        if (fabs(change) > largest) {
            return found(HC_STEP, i, change);
        }
    }
    return found(HC_OK, -1, 0.0);
}
