/* No compensation: the numerical model feels the measured force, F_c = F. */
#include <stdbool.h>

#include "gains_table.c"

/* == Declarations == */

typedef struct {
    char stateless; /* C has no empty structs */
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    (void)gains;
    law->stateless = 0;
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)law, (void)position_desired, (void)velocity_desired, (void)position_measured;
    return force_measured;
}
