/* SPDX-License-Identifier: Apache-2.0
 *
 * What a pose must keep: strokes, joint cones, clearance, condition, assembly mode. doc/theory.md, 5 and 11.
 */
#include "core.h"

/* What was found, and of what. */
typedef struct {
    hc_status status;
    int strut;
    int other; /* second strut that it is about, -1 for none */
    double value;
} finding;

static finding found(hc_status status, int strut, double value)
{
    finding f;
    f.status = status;
    f.strut = strut;
    f.other = -1;
    f.value = value;
    return f;
}

static double held(double value, double low, double high)
{
    return fmax(low, fmin(high, value));
}

/* _share: a quotient held within 0...1; 0 where there is nothing to divide by */
static double share_of(double part, double whole)
{
    return whole > 0.0 ? held(part / whole, 0.0, 1.0) : 0.0;
}

static double segment_distance(const double a[3], const double b[3], const double c[3], const double d[3])
{
    double uu = 0.0, uv = 0.0, vv = 0.0, uw = 0.0, vw = 0.0, determinant, s, t, square = 0.0;
    int k;
    for (k = 0; k < 3; k++) {
        const double u = b[k] - a[k], v = d[k] - c[k], w = a[k] - c[k];
        uu += u * u;
        uv += u * v;
        vv += v * v;
        uw += u * w;
        vw += v * w;
    }
    determinant = uu * vv - uv * uv;
    s = share_of(uv * vw - vv * uw, determinant);
    t = share_of(uv * s + vw, vv);
    s = share_of(uv * t - uw, uu);
    for (k = 0; k < 3; k++) {
        const double apart = a[k] + s * (b[k] - a[k]) - c[k] - t * (d[k] - c[k]);
        square += apart * apart;
    }
    return sqrt(square);
}

/* Cosines of the struts' angles to the neutral directions of their joints, at the base and at the platform. */
static void joint_cosines(const hc_pose *pose, const six_struts *now, const hc_limits *limits, double cosines[2][6])
{
    int i, k;
    for (i = 0; i < 6; i++) {
        const vec s = now->strut[i];
        double at_platform = 0.0;
        for (k = 0; k < 3; k++) {
            const double along = pose->rotation[0][k] * s.x + pose->rotation[1][k] * s.y + pose->rotation[2][k] * s.z;
            at_platform += along * limits->cone_axes[1][i][k];
        }
        cosines[0][i] = dot(s, row_of(limits->cone_axes[0][i])) / now->length[i];
        cosines[1][i] = at_platform / now->length[i];
    }
}

/* The distance of each strut to the nearest other one that counts, and which that is; infinite and -1 where none does. */
static void nearest_struts(const double base[6][3], const six_struts *now, const hc_limits *limits, double distances[6],
                           double nearest[6])
{
    double ends[6][3];
    int i, j, k;
    for (i = 0; i < 6; i++) {
        store(add(row_of(base[i]), now->strut[i]), ends[i]);
        distances[i] = HUGE_VAL;
        nearest[i] = -1.0;
        for (j = 0; j < i && limits->clearance > 0.0; j++) {
            const int pair[2] = {i, j};
            double distance;
            if (!(limits->apart[i][j] > 0.0)) {
                continue;
            }
            distance = segment_distance(base[i], ends[i], base[j], ends[j]);
            for (k = 0; k < 2; k++) {
                if (distance < distances[pair[k]] || distance != distance) {
                    distances[pair[k]] = distance;
                    nearest[pair[k]] = pair[1 - k];
                }
            }
        }
    }
}

/* The first limit that a pose and its lengths break. `now` are the struts at the pose: whoever asks has needed them already. */
static finding check_stage(const double base[6][3], const hc_pose *pose, const six_struts *now,
                           const double lengths[6], const hc_limits *limits, double *condition)
{
    double cosines[2][6], distances[6], nearest[6], sign;
    int i, body;
    *condition = NAN;
    for (i = 0; i < 6; i++) {
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
    for (i = 0; i < 6; i++) {
        for (body = 0; body < 2; body++) {
            const double cosine = cosines[body][i];
            if (!(cosine >= limits->cone_cosines[body][i])) {
                return found(body ? HC_PLATFORM_CONE : HC_BASE_CONE, i, arc_cosine(held(cosine, -1.0, 1.0)));
            }
        }
    }
    nearest_struts(base, now, limits, distances, nearest);
    for (i = 0; i < 6; i++) {
        if (!(distances[i] >= limits->clearance)) {
            finding f = found(HC_CLEARANCE, i, distances[i]);
            f.other = (int)nearest[i];
            return f;
        }
    }
    *condition = condition_at(base, pose, now, limits->characteristic_length, &sign);
    if (!(*condition <= limits->condition)) {
        return found(HC_CONDITION, -1, *condition);
    }
    return sign == limits->home_sign ? found(HC_OK, -1, 0.0) : found(HC_ASSEMBLY, -1, sign);
}

/* A NaN in `previous` means that there is none. */
static finding check_change(const double lengths[6], const double previous[6], double largest)
{
    int i;
    for (i = 0; i < 6; i++) {
        const double change = lengths[i] - previous[i];
        if (fabs(change) > largest) {
            return found(HC_STEP, i, change);
        }
    }
    return found(HC_OK, -1, 0.0);
}
