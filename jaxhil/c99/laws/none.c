/* No compensation: the numerical model feels the measured force, F_c = F. */
#include <stdbool.h>

#include "gains_table.c"
#include "law_status_table.c"

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
    (void)law;
}

static void jaxhil_law_next_contact(jaxhil_law *law) {
    (void)law;
}
