/* Smith predictor of the force: F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F, each factor by Tustin's rule,
 * T_l = phase_lead, filtered with lead_filter as in phase lead, T_s = simulator_lag.
 */
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"
#include "law_status_table.c"

/* == Declarations == */

typedef struct {
    jaxhil_lead_filter lead, predictor;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    const double lag = gains->simulator_lag;
    jaxhil_lead_filter_init(&law->lead, gains->phase_lead, gains->lead_filter, gains->control_period);
    jaxhil_lead_filter_init(&law->predictor, lag, 0.5 * lag, gains->control_period);
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired, (void)velocity_desired, (void)position_measured;
    const double led = jaxhil_lead_filter_step(&law->lead, force_measured);
    return jaxhil_lead_filter_step(&law->predictor, led);
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
    jaxhil_lead_filter_reset(&law->predictor);
}

static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_law_reset(law);
}
