/* Smith predictor of the force: F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F, the factors as in `smith`. */
#include "smith.c"

/* == Definitions == */

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired, (void)velocity_desired, (void)position_measured;
    return jaxhil_lead_filter_step(&law->predictor, jaxhil_lead_filter_step(&law->lead, force_measured));
}
