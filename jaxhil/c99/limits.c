/* Limits that a loaded struct has to keep, beyond each one's own range. */
#include <stdbool.h>

#include "limits_table.c"

/* == Definitions == */

static bool jaxhil_limits_fit(const jaxhil_limits *limits) {
    return jaxhil_limits_admitted(limits) && limits->measured_lowest < limits->measured_highest &&
           limits->command_lowest < limits->command_highest &&
           !(limits->retreat_velocity > limits->velocity_limit);
}
