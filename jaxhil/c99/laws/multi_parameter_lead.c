/* Multi-parameter phase lead, the measured force and its filtered rate with a gain each:
 * F_c = a F + b w, w = s/(1 + T_2 s) F by Tustin's rule, a = force_gain, b = force_rate_gain, T_2 = lead_filter
 * (Osaki, Konno).
 */
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"

/* == Declarations == */

typedef struct {
    double force_gain, force_rate_gain;
    jaxhil_velocity_filter rate;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    law->force_gain = gains->force_gain;
    law->force_rate_gain = gains->force_rate_gain;
    jaxhil_velocity_filter_init(&law->rate, gains->lead_filter, gains->control_period);
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired, (void)velocity_desired, (void)position_measured;
    const double rate = jaxhil_velocity_filter_step(&law->rate, force_measured);
    return law->force_gain * force_measured + law->force_rate_gain * rate;
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_velocity_filter_start(&law->rate, 0.0, 0.0);
}
