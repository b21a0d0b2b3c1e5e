/* Phase-lead force compensation, the filtered first-order inverse of a force delay:
 * F_c = (1 + T_1 s)/(1 + T_2 s) F by Tustin's rule, T_1 = phase_lead + lead_filter, T_2 = lead_filter.
 */
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"

/* == Declarations == */

typedef struct {
    jaxhil_lead_filter lead;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    jaxhil_lead_filter_init(&law->lead, gains->phase_lead, gains->lead_filter, gains->control_period);
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired, (void)velocity_desired, (void)position_measured;
    return jaxhil_lead_filter_step(&law->lead, force_measured);
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
}
