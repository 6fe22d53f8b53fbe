/* SPDX-License-Identifier: Apache-2.0
 *
 * See hexapod_comp.h. This is the one file to compile; the order is that of the computation.
 */
#include "core.h"
#include "elementary.c"
#include "pose.c"
#include "kinematics.c"
#include "limits.c"
#include "field.c"
#include "struts.c"
#include "compensation.c"
