/* SPDX-License-Identifier: Apache-2.0
 *
 * How far a tool can move in one direction before a limit refuses the pose.
 */
#include "core.h"

#define HALVINGS 32 /* bisections between the last allowed and the first refused pose */

/* Search from a tool pose in `frame` along the unit vector `shift`, or about the unit vector `turn` (the other one is 0), in
 * steps of `step` up to `longest`, m or rad. `state` must have no last command, so that each pose is judged alone. */
void hc_go(const hc_state *state, const hc_pose *tool, const hc_pose *frame, const double shift[3], const double turn[3],
           double step, double longest, hc_way *way)
{
    const hc_time unknown = {NAN, NAN};
    way->inside = -step;
    way->outside = HUGE_VAL;
    way->refused.status = HC_OK;
    for (int halvings = 0; halvings < HALVINGS && way->inside < longest && way->outside > 0.0;) {
        const int beyond = way->outside < HUGE_VAL;
        const double distance = beyond ? 0.5 * (way->inside + way->outside) : fmin(way->inside + step, longest);
        hc_pose at = *tool;
        hc_last next;
        hc_answer answer;
        halvings += beyond;
        for (int i = 0; i < 3; i++) {
            at.position[i] += distance * shift[i];
        }
        rotate(at.rotation, distance * turn[0], distance * turn[1], distance * turn[2]);
        const hc_pose in_base = compose(frame, &at), platform = compose(&in_base, &state->model->tool_inverse);
        const finding f = next_command(state, &platform, unknown, &next, &answer);
        if (f.status == HC_OK) {
            way->inside = distance;
        } else {
            way->outside = distance;
            fill_answer(&next, f, &answer);
            way->refused = answer;
        }
    }
}
