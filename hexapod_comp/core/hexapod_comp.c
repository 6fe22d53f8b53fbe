/* SPDX-License-Identifier: Apache-2.0
 *
 * See hexapod_comp.h. Compile only this file: it includes the others, each after the files that it uses.
 */
#include "core.h"
#include "elementary.c"
#include "pose.c"
#include "kinematics.c"
#include "limits.c"
#include "field.c"
#include "struts.c"
#include "compensation.c"
