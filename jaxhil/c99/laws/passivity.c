/* Time-domain passivity: the contact never gives back more energy than it has taken (De Stefano et al.).
 * F_c = F, but where E = E_before + T F v_d < 0 such that E becomes 0: F_c = -E_before/(T v_d).
 */
#include <math.h>
#include <stdbool.h>

#include "gains_table.c"

/* == Declarations == */

typedef struct {
    double period, energy;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    law->period = gains->control_period;
    law->energy = 0.0;
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_desired, (void)position_measured;
    const double travel = law->period * velocity_desired;
    const double before = law->energy;
    const double energy = before + force_measured * travel;
    if (energy < 0.0) {
        law->energy = 0.0;
        return -before / travel;
    }
    /* What is beyond all numbers is not taken in: it would stay so. */
    if (energy < INFINITY) {
        law->energy = energy;
    }
    return force_measured;
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    law->energy = 0.0;
}
