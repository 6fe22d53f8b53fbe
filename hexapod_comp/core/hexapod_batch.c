/* SPDX-License-Identifier: Apache-2.0
 *
 * See hexapod_batch.h. The core with what Python computes on arrays, as one unit.
 */
#include "hexapod_comp.c"
#include "hexapod_batch.h"
#include "single.c"
#include "lanes.c"
#include "batch.c"
#include "examine.c"
#include "travel.c"
#include "drives.c"
