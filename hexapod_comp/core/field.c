/* SPDX-License-Identifier: Apache-2.0
 *
 * The error field on a grid, forwards and backwards. Mou & King (1998); doc/theory.md, 9.
 */
#include "core.h"

/* The cell of a grid that contains a coordinate, the weight of its upper node, and whether the coordinate is outside. */
typedef struct {
    int index;
    double weight;
    int outside;
} place;

static place locate(double value, const double *nodes, int count)
{
    place at = {0, 0.0, value < nodes[0] || value > nodes[count - 1]};
    while (at.index < count - 2 && value >= nodes[at.index + 1]) {
        at.index++;
    }
    if (value > nodes[0]) {
        at.weight = value >= nodes[count - 1] ? 1.0 : (value - nodes[at.index]) / (nodes[at.index + 1] - nodes[at.index]);
    }
    return at;
}

/* The coordinate u, -1...1 over the nodes, clamped outside. */
static double along(double value, const double *nodes, int count)
{
    const double first = nodes[0], last = nodes[count - 1];
    return fmin(1.0, fmax(-1.0, (2.0 * value - first - last) / (last - first)));
}

/* Add the error of the lines along one axis: four polynomials, each weighted by the opposite area (Mou & King). */
static void add_family(const hc_field *field, int axis, double u, double sense, const place *first,
                       const place *second, double error[6])
{
    const int across = field->node_count[axis == 2 ? 1 : 2], size = 6 * field->powers[axis];
    const int upper = field->node_count[axis == 0 ? 1 : 0];
    const double s = first->weight, t = second->weight;
    for (int direction = 0; direction < 2; direction++) {
        const double share = direction == 0 ? 0.5 * (1.0 + sense) : 0.5 * (1.0 - sense);
        const int cell = (direction * upper + first->index) * across + second->index;
        const double *c00 = field->lines[axis] + cell * size, *c01 = c00 + size;
        const double *c10 = c00 + across * size, *c11 = c10 + size;
        const double w00 = share * (1.0 - s) * (1.0 - t), w01 = share * (1.0 - s) * t;
        const double w10 = share * s * (1.0 - t), w11 = share * s * t;
        double value[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
        if (share == 0.0) {
            continue;
        }
        for (int power = size - 6; power >= 0; power -= 6) {
            for (int k = 0; k < 6; k++) { /* contiguous in memory, so that the compiler can use vector instructions */
                const int at = power + k;
                value[k] = value[k] * u + (w00 * c00[at] + w01 * c01[at] + w10 * c10[at] + w11 * c11[at]);
            }
        }
        for (int k = 0; k < 6; k++) {
            error[k] += value[k];
        }
    }
}

/* Write the six error components at a point; return whether the point is outside the box. */
static int field_at(const hc_field *field, vec point, const double sense[3], double error[6])
{
    const double coordinates[3] = {point.x, point.y, point.z};
    const int finite = finite_number(point.x) && finite_number(point.y) && finite_number(point.z);
    place at[3];
    for (int k = 0; k < 6; k++) {
        error[k] = finite ? 0.0 : NAN;
    }
    if (!finite) {
        return 1;
    }
    for (int axis = 0; axis < 3; axis++) {
        at[axis] = locate(coordinates[axis], field->nodes[axis], field->node_count[axis]);
    }
    for (int axis = 0; axis < 3; axis++) {
        if (field->powers[axis]) {
            const double u = along(coordinates[axis], field->nodes[axis], field->node_count[axis]);
            add_family(field, axis, u, sense[axis], &at[axis == 0 ? 1 : 0], &at[axis == 2 ? 1 : 2], error);
        }
    }
    return at[0].outside || at[1].outside || at[2].outside;
}

/* Turn a rotation by the field's three small rotations times `sign`; without rotations, no bit changes. */
static void turn_by_field(double rotation[3][3], const double error[6], double sign)
{
    if (error[3] != 0.0 || error[4] != 0.0 || error[5] != 0.0) {
        rotate(rotation, sign * error[3], sign * error[4], sign * error[5]);
    }
}

/* Solve q o E(q) = target for q by fixed-point iteration; return whether it converged. */
static int undo_field(const hc_field *field, const hc_pose *target, const double sense[3], hc_pose *q, int *outside)
{
    const vec target_point = point_at(target, field->probe);
    vec point = target_point;
    double error[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    int solved = 0;
    for (int count = 0; count < FIELD_ITERATIONS && !solved; count++) {
        *outside = field_at(field, point, sense, error);
        const vec next = subtract(target_point, vector(error[0], error[1], error[2]));
        solved = fabs(point.x - next.x) + fabs(point.y - next.y) + fabs(point.z - next.z) < 1e-15;
        point = next;
    }
    *q = *target;
    turn_by_field(q->rotation, error, -1.0);
    store(subtract(point, lever(q, field->probe)), q->position);
    return solved;
}

/* Write the actual pose q o E(q). */
static void apply_field(const hc_field *field, const hc_pose *q, const double sense[3], hc_pose *actual)
{
    const vec point = point_at(q, field->probe);
    double error[6];
    field_at(field, point, sense, error);
    *actual = *q;
    turn_by_field(actual->rotation, error, 1.0);
    store(subtract(add(point, vector(error[0], error[1], error[2])), lever(actual, field->probe)), actual->position);
}
