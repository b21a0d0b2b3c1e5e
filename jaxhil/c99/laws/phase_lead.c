/* Phase-lead force compensation, the filtered first-order inverse of a force delay:
 * F_c = (1 + T_1 s)/(1 + T_2 s) F by Tustin's rule, T_1 = phase_lead + lead_filter, T_2 = lead_filter.
 */
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"
#include "law_status_table.c"

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

static double jaxhil_law_position_command(jaxhil_law *law, double position, double velocity,
                                          double acceleration) {
    (void)law, (void)velocity, (void)acceleration;
    return position;
}

static void jaxhil_law_identified(const jaxhil_law *law, double *stiffness, double *damping) {
    (void)law;
    *stiffness = 0.0;
    *damping = 0.0;
}

static int jaxhil_law_own_status(const jaxhil_law *law) {
    (void)law;
    return JAXHIL_UNSTATED;
}

static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
}

static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
}
