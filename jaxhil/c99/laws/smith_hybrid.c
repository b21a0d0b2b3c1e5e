/* The mean of Smith predictor and phase lead: F_c = (F_smith + F_lead)/2, of `smith_predictor` and `phase_lead`
 * with these gains.
 */
#include "smith.c"

/* == Definitions == */

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired, (void)velocity_desired, (void)position_measured;
    const double led = jaxhil_lead_filter_step(&law->lead, force_measured);
    return 0.5 * (jaxhil_lead_filter_step(&law->predictor, led) + led);
}
