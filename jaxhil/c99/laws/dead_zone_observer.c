/* Phase lead, and an observer of what the force sensor's dead zone withholds: F_c = lead(F + w),
 * w = Q clip(k_n d, -limit, limit), Q = 1/(1 + s/(2 pi f)) by Tustin's rule, d the deflection by the measured
 * position as late as the force: w = ((2 - c) w_prev + c (u + u_prev)) / (2 + c), c = 2 pi f T.
 *
 * After Li et al. 2026 (phase lead and a disturbance observer near 1 below 15 Hz).
 */
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"
#include "surfaces.c"

/* == Declarations == */

typedef struct {
    double clearance, stiffness, limit, corner, of_observed, denominator;
    jaxhil_lead_filter lead;
    jaxhil_delay_line alignment;
    double withheld, observed;
    bool started;
    double samples[JAXHIL_IDENTIFICATION_DELAY_SAMPLES];
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    const double period = gains->control_period;
    jaxhil_lead_filter_init(&law->lead, gains->phase_lead, gains->lead_filter, period);
    law->clearance = gains->clearance;
    law->stiffness = gains->observer_stiffness;
    law->limit = gains->observer_limit;
    law->corner = 2.0 * 3.141592653589793 * gains->observer_bandwidth * period;
    law->of_observed = 2.0 - law->corner;
    law->denominator = 2.0 + law->corner;
    law->withheld = 0.0;
    law->observed = 0.0;
    law->started = false;
    return jaxhil_delay_line_init(&law->alignment, law->samples, JAXHIL_IDENTIFICATION_DELAY_SAMPLES,
                                  gains->identification_delay, period);
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired;
    if (!law->started) {
        jaxhil_delay_line_start(&law->alignment, law->samples, position_measured, velocity_desired);
        law->started = true;
    }
    const double aligned = jaxhil_delay_line_step(&law->alignment, law->samples, position_measured);
    const double force = law->stiffness * jaxhil_deflection(aligned, law->clearance);
    const double limit = law->limit;
    const double withheld = force > limit ? limit : force < -limit ? -limit : force;
    const double observed =
        (law->of_observed * law->observed + law->corner * (withheld + law->withheld)) / law->denominator;
    law->withheld = withheld;
    law->observed = observed;
    return jaxhil_lead_filter_step(&law->lead, force_measured + observed);
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
    law->withheld = 0.0;
    law->observed = 0.0;
    law->started = false;
}
