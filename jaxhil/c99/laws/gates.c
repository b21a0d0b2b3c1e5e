/* Gates that open and close smoothly with the time, between two ticks, at which a threshold is crossed. */
#include <stdbool.h>

/* == Definitions == */

/* Share of the last period that a reading, straight between two ticks, spent beyond a threshold.
 * `excess`: by how much the reading is beyond, 0 short of the threshold and of slope 1 beyond it (negative
 * beyond the lower one of two thresholds); `excess_before`: the tick before; `moved`: the reading's
 * change. */
static double jaxhil_share_beyond(double excess, double excess_before, double moved) {
    bool crossed;
    if (excess > 0.0) {
        crossed = excess_before <= 0.0;
    } else if (excess < 0.0) {
        crossed = excess_before >= 0.0;
    } else {
        crossed = excess_before != 0.0;
    }
    if (crossed && moved != 0.0) {
        return (excess - excess_before) / moved;
    }
    return excess == 0.0 ? 0.0 : 1.0;
}

/* Time beyond a threshold, weighed with a triangle two periods wide: 0 to 1. From the shares of the last
 * period and of the one before. */
static double jaxhil_gate(double share, double share_before) {
    return (share * share + share_before * share_before) / 2.0 +
           share * share_before * (2.0 - share - share_before);
}
