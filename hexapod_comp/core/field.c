/* SPDX-License-Identifier: Apache-2.0
 *
 * The error field on a grid, forwards and backwards. Mou & King (1998); doc/theory.md, 9.
 */
#include "core.h"

/* Cell, weight of its upper node, and whether the coordinate lies outside the grid. */
typedef struct {
    int index;
    double weight;
    int outside;
} place;

static place locate(double value, const double *nodes, int count)
{
    place at;
    at.index = 0;
    at.weight = 0.0;
    at.outside = value < nodes[0];
    if (value <= nodes[0]) {
        return at;
    }
    if (value >= nodes[count - 1]) {
        at.index = count - 2;
        at.weight = 1.0;
        at.outside = value > nodes[count - 1];
        return at;
    }
    while (at.index < count - 2 && value >= nodes[at.index + 1]) {
        at.index++;
    }
    at.weight = (value - nodes[at.index]) / (nodes[at.index + 1] - nodes[at.index]);
    return at;
}

static double along(double value, const double *nodes, int count)
{
    const double first = nodes[0], last = nodes[count - 1];
    return fmin(1.0, fmax(-1.0, (2.0 * value - first - last) / (last - first)));
}

/* Add the family of lines along one axis: four polynomials, weighted by the area opposite to each (Mou & King). */
static void add_family(const hc_field *field, int axis, double u, double sense, const place *first,
                       const place *second, double error[6])
{
    const int across = field->node_count[axis == 2 ? 1 : 2], size = 6 * field->powers[axis];
    const int upper = field->node_count[axis == 0 ? 1 : 0];
    const double s = first->weight, t = second->weight;
    int direction, k, power;
    for (direction = 0; direction < 2; direction++) {
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
        for (power = size - 6; power >= 0; power -= 6) {
            for (k = 0; k < 6; k++) { /* side by side in memory, for the compiler to take two or four at once */
                const int at = power + k;
                value[k] = value[k] * u + (w00 * c00[at] + w01 * c01[at] + w10 * c10[at] + w11 * c11[at]);
            }
        }
        for (k = 0; k < 6; k++) {
            error[k] += value[k];
        }
    }
}

/* field_one: six error components at a point; returns whether it lies outside the box */
static int field_at(const hc_field *field, vec point, const double sense[3], double error[6])
{
    place x, y, z;
    int k;
    if (!(finite_number(point.x) && finite_number(point.y) && finite_number(point.z))) {
        for (k = 0; k < 6; k++) {
            error[k] = NAN;
        }
        return 1;
    }
    x = locate(point.x, field->nodes[0], field->node_count[0]);
    y = locate(point.y, field->nodes[1], field->node_count[1]);
    z = locate(point.z, field->nodes[2], field->node_count[2]);
    for (k = 0; k < 6; k++) {
        error[k] = 0.0;
    }
    if (field->powers[0]) {
        add_family(field, 0, along(point.x, field->nodes[0], field->node_count[0]), sense[0], &y, &z, error);
    }
    if (field->powers[1]) {
        add_family(field, 1, along(point.y, field->nodes[1], field->node_count[1]), sense[1], &x, &z, error);
    }
    if (field->powers[2]) {
        add_family(field, 2, along(point.z, field->nodes[2], field->node_count[2]), sense[2], &x, &y, error);
    }
    return x.outside || y.outside || z.outside;
}

/* Solve q o E(q) = target for q by fixed points; returns whether it was solved. */
static int undo_field(const hc_field *field, const hc_pose *target, const double sense[3], hc_pose *q, int *outside)
{
    const vec target_point = add(row_of(target->position), lever(target, field->probe));
    vec point = target_point;
    double error[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    int solved = 0, count;
    for (count = 0; count < FIELD_ITERATIONS && !solved; count++) {
        vec next;
        *outside = field_at(field, point, sense, error);
        next = subtract(target_point, vector(error[0], error[1], error[2]));
        solved = fabs(point.x - next.x) + fabs(point.y - next.y) + fabs(point.z - next.z) < 1e-15;
        point = next;
    }
    *q = *target;
    if (error[3] != 0.0 || error[4] != 0.0 || error[5] != 0.0) {
        rotate(q->rotation, -error[3], -error[4], -error[5]);
    }
    store(subtract(point, lever(q, field->probe)), q->position);
    return solved;
}

/* Write q o E(q). */
static void apply_field(const hc_field *field, const hc_pose *q, const double sense[3], hc_pose *actual)
{
    const vec point = add(row_of(q->position), lever(q, field->probe));
    double error[6];
    field_at(field, point, sense, error);
    *actual = *q;
    if (error[3] != 0.0 || error[4] != 0.0 || error[5] != 0.0) {
        rotate(actual->rotation, error[3], error[4], error[5]);
    }
    store(subtract(add(point, vector(error[0], error[1], error[2])), lever(actual, field->probe)), actual->position);
}
