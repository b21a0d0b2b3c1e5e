/* The retrospective reference where the force delay is hardly known: a bank of delays, weighed as one goes. */
#include <stdbool.h>

#include "delay_bank.c"
#include "retrospective_law.c"

/* == Definitions == */

#define JAXHIL_LAW_HAS_FORCE_DELAY
static double jaxhil_law_force_delay(const jaxhil_law *law) {
    return law->learnt.given + law->learnt.shift;
}
