/* SPDX-License-Identifier: Apache-2.0
 *
 * See hexapod_batch.h. Compile only this file for Python: it includes the core and the functions on arrays.
 */
#include "hexapod_comp.c"
#include "hexapod_batch.h"
#include "single.c"
#include "lanes.c"
#include "batch.c"
#include "examine.c"
#include "travel.c"
#include "drives.c"
