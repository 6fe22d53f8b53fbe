/* SPDX-License-Identifier: Apache-2.0
 *
 * This machine and its error model, for compensation.cpp: the header of constants is C.
 */
#include "core/hexapod_comp.h"
#include "core/hexapod_model.h"

const hc_model *hc_machine(void);

const hc_model *hc_machine(void)
{
    return &hexapod_model;
}
