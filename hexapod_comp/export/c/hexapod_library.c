/* SPDX-License-Identifier: Apache-2.0
 *
 * For a shared library of a machine, for languages that can call C but cannot include headers:
 *
 *     cc -std=c99 -O2 -fPIC -shared hexapod_comp.c hexapod_library.c -lm -o libhexapod.so
 */
#include <stddef.h>

#include "hexapod_comp.h"
#include "hexapod_model.h"

size_t hc_state_size(void);
const hc_model *hc_machine(void);

size_t hc_state_size(void)
{
    return sizeof(hc_state);
}

const hc_model *hc_machine(void)
{
    return &hexapod_model;
}
