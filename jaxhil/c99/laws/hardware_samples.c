/* What the hardware shows of a contact, moved to the times of the reference motion. The numerical model and the
 * hardware enter the contact at two moments, both between two ticks; the reference motion counts its ticks from the
 * model's entry, so the hardware's samples are moved, straight between two of them, to the same times after its own.
 */
#include <math.h>
#include <stdbool.h>

#include "reintegration.c"

/* == Declarations == */

/* The tick's sample before: force [1/s], depth [s], speed, deepest point [s], whether the sensor shows the force;
 * of the history its integral so far [ticks/s], over how many ticks; `first` [s]: the time of the first tick after
 * the numerical model's entry. */
typedef struct {
    double period, first, fraction, impulse, read, moved;
    double force, depth, speed, deepest;
    long offset, ticks;
    bool shown, moved_shown;
} jaxhil_hardware_samples;

/* == Definitions == */

/* The numerical model has entered `first` [s] ago; the sample before this tick's. */
static void jaxhil_hardware_samples_begin(jaxhil_hardware_samples *samples, double first, double force, bool shown,
                                          double depth, double speed) {
    samples->first = first;
    samples->force = force;
    samples->shown = shown;
    samples->depth = depth;
    samples->speed = speed;
    samples->deepest = 0.0;
}

static void jaxhil_hardware_samples_reset(jaxhil_hardware_samples *samples) {
    jaxhil_hardware_samples_begin(samples, 0.0, 0.0, true, 0.0, 0.0);
    samples->fraction = 0.0;
    samples->offset = 0;
    samples->ticks = 0;
    samples->impulse = 0.0;
    samples->read = 0.0;
    samples->moved = 0.0;
    samples->moved_shown = true;
}

/* The hardware has entered: at this tick it is at this depth [s], with this speed. */
static void jaxhil_hardware_samples_enter(jaxhil_hardware_samples *samples, double depth, double speed) {
    const double period = samples->period;
    double since = 0.5 * period;
    if (speed > 0.0) {
        since = depth / speed;
        if (!(since <= period)) {
            since = period;
        }
    }
    const double shift = (samples->first - since) / period;
    const double whole = floor(shift);
    samples->fraction = shift - whole;
    samples->offset = -1 - (long)whole;
    samples->ticks = 0;
}

/* The sample that lies between the one before and this one, into the reference's history. */
static void jaxhil_hardware_samples_move(jaxhil_hardware_samples *samples, jaxhil_reference_motion *reference,
                                         double force, bool shown, double depth, double speed, double deepest) {
    const double fraction = samples->fraction;
    const double moved = samples->force + fraction * (force - samples->force);
    const bool moved_shown = shown && samples->shown;
    const long index = samples->ticks + samples->offset;
    samples->ticks++;
    if (index == 0) {
        const double ticks = moved_shown ? samples->first / samples->period : 0.0;
        samples->impulse = 0.5 * moved * ticks;
        samples->read = ticks;
    } else if (index > 0 && moved_shown && samples->moved_shown) {
        samples->impulse += 0.5 * (samples->moved + moved);
        samples->read += 1.0;
    }
    samples->moved = moved;
    samples->moved_shown = moved_shown;
    if (index >= 0) {
        jaxhil_reference_motion_remember(reference, index, samples->impulse, samples->read,
                                         samples->depth + fraction * (depth - samples->depth),
                                         samples->speed + fraction * (speed - samples->speed),
                                         samples->deepest + fraction * (deepest - samples->deepest));
    }
}

/* This tick's sample; it goes into the history once the hardware has `entered`. */
static void jaxhil_hardware_samples_take(jaxhil_hardware_samples *samples, jaxhil_reference_motion *reference,
                                         bool entered, double force, bool shown, double depth, double speed,
                                         double deepest) {
    if (entered) {
        jaxhil_hardware_samples_move(samples, reference, force, shown, depth, speed, deepest);
    }
    samples->force = force;
    samples->shown = shown;
    samples->depth = depth;
    samples->speed = speed;
    samples->deepest = deepest;
}
