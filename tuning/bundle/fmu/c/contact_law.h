/* Contact laws of a mechanism: the force as a function of the penetration [m] and its rate [m/s]. */
#ifndef CONTACT_LAW_H
#define CONTACT_LAW_H

#include <stdbool.h>

#include "rig_constants.h"

typedef struct {
    int number;     /* index of the contact in the tables of rig_constants.h */
    double deepest; /* deepest penetration so far [m], for a law with memory */
} contact_law;

/* Whether the force depends on the deepest penetration. */
bool contact_law_has_memory(void);

/* Return the law of contact `number`; contacts beyond the end of a list use its last entry. */
contact_law contact_law_of(int number);

/* Force [N] at a positive depth. */
double contact_law_force(const contact_law *law, double depth, double rate);

/* Number that is positive until the surfaces separate. */
double contact_law_separation_function(const contact_law *law, double depth, double rate);

/* Limit of the force [N] as the depth approaches 0 from above. */
double contact_law_onset_force(const contact_law *law, double rate);

#endif
