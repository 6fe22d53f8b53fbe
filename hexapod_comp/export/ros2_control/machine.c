/* SPDX-License-Identifier: Apache-2.0
 *
 * Gives compensation.cpp access to the machine's constants, whose header is C, not C++.
 */
#include "core/hexapod_comp.h"
#include "core/hexapod_model.h"

const hc_model *hc_machine(void);

const hc_model *hc_machine(void)
{
    return &hexapod_model;
}
