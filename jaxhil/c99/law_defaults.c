/* The law's functions that it leaves out: a law that does have one says so by defining JAXHIL_LAW_HAS_... beside
 * it. By default a law has no state, commands the numerical model's position, identifies nothing, estimates no
 * delay, says nothing of itself, and keeps nothing from one contact to the next.
 */
#include <stdbool.h>

#include "gains_table.c"
#include "law.c"
#include "law_status_table.c"

/* == Definitions == */

#ifndef JAXHIL_LAW_HAS_POSITION_COMMAND
static double jaxhil_law_position_command(jaxhil_law *law, double position, double velocity,
                                          double acceleration) {
    (void)law, (void)velocity, (void)acceleration;
    return position;
}
#endif

#ifndef JAXHIL_LAW_HAS_IDENTIFIED
static void jaxhil_law_identified(const jaxhil_law *law, double *stiffness, double *damping) {
    (void)law;
    *stiffness = 0.0;
    *damping = 0.0;
}
#endif

#ifndef JAXHIL_LAW_HAS_FORCE_DELAY
static double jaxhil_law_force_delay(const jaxhil_law *law) {
    (void)law;
    return 0.0;
}
#endif

#ifndef JAXHIL_LAW_HAS_STATUS
static int jaxhil_law_own_status(const jaxhil_law *law) {
    (void)law;
    return JAXHIL_UNSTATED;
}
#endif

#ifndef JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    (void)law;
}
#endif

#ifndef JAXHIL_LAW_HAS_NEXT_CONTACT
static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_law_reset(law);
}
#endif
