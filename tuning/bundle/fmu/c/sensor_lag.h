/* Response of a force sensor with a first-order lag, and the deepest penetration, in smooth motion. */
#ifndef SENSOR_LAG_H
#define SENSOR_LAG_H

#include "contact_law.h"

typedef struct {
    double position; /* of the mechanism relative to its surface [m] */
    double velocity; /* [m/s] */
} motion_state;

/* Output of the lag [N] at the end of a segment that lasts `duration` [s], from its output at the start. The
 * deepest penetration before the segment is `deepest` [m]. */
double apply_sensor_lag(double reading, const contact_law *law, motion_state start, motion_state end,
                        double duration, double deepest);

/* Deepest penetration during a segment [m]; 0 without contact. */
double deepest_penetration(const contact_law *law, motion_state start, motion_state end, double duration);

#endif
