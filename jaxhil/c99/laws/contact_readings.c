/* What was read at a tick of a contact, scaled by it. */
#include <stdbool.h>

#include "history.c"
#include "reintegration.c"

/* == Declarations == */

/* Depth [s] and speed as old as the force by the given delay, force [1/s] and its variance [1/s^2]; whether the sensor
 * showed it. */
typedef struct {
    double depth, rate, force, variance;
    bool shown;
} jaxhil_reading;

/* == Definitions == */

static const double jaxhil_misfit_time = 0.001; /* s, over which a force may be off by the law's misfit */

/* With noise of a `variance` [1/s^2], by this share of which a map may be wrong, ticks of this period [s]. */
static jaxhil_reading jaxhil_reading_at(const jaxhil_history *history, const jaxhil_scales *scales, long tick,
                                        double variance, double misfit, double period) {
    const jaxhil_sample *sample = jaxhil_history_recall(history, tick);
    const long slot = tick % JAXHIL_SLOTS;
    const double force = jaxhil_scales_force(scales, history->forces[slot]);
    const double off = misfit * force;
    const jaxhil_reading reading = {jaxhil_scales_depth(scales, sample->position),
                                    jaxhil_scales_rate(scales, sample->velocity), force,
                                    variance + off * off * (jaxhil_misfit_time / period), history->shows[slot]};
    return reading;
}
