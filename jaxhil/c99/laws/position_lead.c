/* Position lead: F_c = F, and the position command x + a_1 v + a_2 a is ahead of the numerical model by what the
 * motion simulator follows late, a_1 = position_lead, a_2 = acceleration_lead.
 */
#include <stdbool.h>

#include "gains_table.c"

/* == Declarations == */

typedef struct {
    double of_velocity, of_acceleration;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    law->of_velocity = gains->position_lead;
    law->of_acceleration = gains->acceleration_lead;
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)law, (void)position_desired, (void)velocity_desired, (void)position_measured;
    return force_measured;
}

#define JAXHIL_LAW_HAS_POSITION_COMMAND
static double jaxhil_law_position_command(jaxhil_law *law, double position, double velocity,
                                          double acceleration) {
    return position + law->of_velocity * velocity + law->of_acceleration * acceleration;
}
