/* What goes out, limited: the force on the numerical model and the position command to the drives.
 *
 * Both guards hold the last value that they let out, so that nothing jumps: not on a trip, not on a reset. Where a
 * run begins, the position command goes on from where the drives read.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "faults_table.c"
#include "limits_table.c"
#include "surfaces.c"

/* == Declarations == */

/* The force on the numerical model within `force_limit`, its change within `force_slew`. */
typedef struct {
    double limit, most, cut_tolerated;
    double output;
    int64_t cut;
    uint32_t fatal;
} jaxhil_force_guard;

/* The position command within the stroke, its change within `velocity_limit`; the retreat after a trip. No command
 * is further from the last one than the velocity limit allows in a period. A run's first one is as near to where the
 * drives read; out of contact, where they follow late, within `start_distance` of it. A command is outside the
 * stroke only on the way back from there. */
typedef struct {
    double clearance, lowest, highest, most, braking, retreat, distance, start, cut_tolerated;
    double output, rate;
    int64_t cut;
    uint32_t fatal;
    bool engaged, known, at_rest;
} jaxhil_position_guard;

/* == Definitions == */

/* The value nearest to the target that is at most `most` from the start. */
static double jaxhil_towards(double start, double target, double most) {
    if (target > start) {
        const double up = start + most;
        return up < target ? up : target;
    }
    const double down = start - most;
    return down > target ? down : target;
}

static void jaxhil_force_guard_restart(jaxhil_force_guard *guard) {
    guard->cut = 0;
    guard->fatal = 0;
}

static void jaxhil_force_guard_init(jaxhil_force_guard *guard, const jaxhil_limits *limits, double period) {
    guard->limit = limits->force_limit;
    guard->most = limits->force_slew * period;
    guard->cut_tolerated = limits->limited_in_a_row;
    guard->output = 0.0;
    jaxhil_force_guard_restart(guard);
}

/* Let the command [N] out as far as the limits allow; the faults of that. */
static uint32_t jaxhil_force_guard_limit(jaxhil_force_guard *guard, double command) {
    guard->fatal = 0;
    if (!isfinite(command)) {
        guard->fatal = JAXHIL_COMMAND_NOT_FINITE;
        return JAXHIL_COMMAND_NOT_FINITE;
    }
    if (fabs(command) > guard->limit) {
        guard->fatal = JAXHIL_FORCE_LIMIT;
        return JAXHIL_FORCE_LIMIT;
    }
    if (fabs(command - guard->output) <= guard->most) {
        guard->cut = 0;
        guard->output = command;
        return 0;
    }
    guard->cut++;
    if ((double)guard->cut > guard->cut_tolerated) {
        guard->fatal = JAXHIL_FORCE_SLEW;
    } else {
        guard->output = jaxhil_towards(guard->output, command, guard->most);
    }
    return JAXHIL_FORCE_SLEW;
}

/* Lead the output towards 0. */
static void jaxhil_force_guard_fade(jaxhil_force_guard *guard) {
    guard->output = jaxhil_towards(guard->output, 0.0, guard->most);
}

static void jaxhil_position_guard_restart(jaxhil_position_guard *guard) {
    guard->cut = 0;
    guard->engaged = false;
    guard->rate = 0.0;
    guard->at_rest = false;
    guard->fatal = 0;
}

static void jaxhil_position_guard_init(jaxhil_position_guard *guard, const jaxhil_limits *limits,
                                       double period, double clearance) {
    /* In a narrow gap the safest place is its middle. */
    const double distance = limits->free_distance;
    const double middle = 0.5 * clearance;
    guard->clearance = clearance;
    guard->lowest = limits->command_lowest;
    guard->highest = limits->command_highest;
    guard->most = limits->velocity_limit * period;
    guard->braking = limits->deceleration * period * period;
    guard->retreat = limits->retreat_velocity * period;
    guard->distance = distance < middle ? distance : middle;
    guard->cut_tolerated = limits->limited_in_a_row;
    guard->start = limits->start_distance;
    guard->output = 0.0;
    guard->known = false;
    jaxhil_position_guard_restart(guard);
}

/* Forget the last output: the drives have been brought elsewhere. */
static void jaxhil_position_guard_release(jaxhil_position_guard *guard) {
    guard->known = false;
    jaxhil_position_guard_restart(guard);
}

/* Begin where the drives read; if they never were, where the model is, but free and in the stroke. */
static void jaxhil_position_guard_stand(jaxhil_position_guard *guard, double measured, double position) {
    guard->known = true;
    guard->output = measured;
    if (isfinite(measured)) {
        return;
    }
    double start = position;
    if (!isfinite(position) || position > 0.0) {
        start = -guard->distance;
    } else if (position < -guard->clearance) {
        start = guard->distance - guard->clearance;
    }
    if (start < guard->lowest) {
        start = guard->lowest;
    } else if (start > guard->highest) {
        start = guard->highest;
    }
    guard->output = start;
}

/* Let the command [m] out as far as the limits allow; the faults of that. `position` [m] is the numerical model's;
 * `measured` [m] is where the drives were read last, NAN if they never were; `is_fresh`, whether that was in this
 * run. */
static uint32_t jaxhil_position_guard_limit(jaxhil_position_guard *guard, double command, double position,
                                            double measured, bool is_fresh) {
    guard->fatal = 0;
    if (!isfinite(command)) {
        guard->fatal = JAXHIL_MODEL_NOT_FINITE;
        return JAXHIL_MODEL_NOT_FINITE;
    }
    if (command < guard->lowest || command > guard->highest) {
        guard->fatal = JAXHIL_STROKE;
        return JAXHIL_STROKE;
    }
    if (!guard->known) {
        /* Drives in motion follow late. Without a reading they have been brought to where the model is. */
        const bool near = fabs(command - (is_fresh ? measured : position)) <= guard->start;
        if (near && jaxhil_deflection(position, guard->clearance) == 0.0) {
            guard->known = true;
            guard->output = command;
        } else {
            jaxhil_position_guard_stand(guard, measured, position);
        }
    }
    const double before = guard->output;
    if (fabs(command - before) <= guard->most) {
        guard->engaged = true;
        guard->cut = 0;
        guard->rate = command - before;
        guard->output = command;
        return 0;
    }
    if (guard->engaged) {
        guard->cut++;
        if ((double)guard->cut > guard->cut_tolerated) {
            guard->fatal = JAXHIL_VELOCITY_LIMIT;
            return JAXHIL_VELOCITY_LIMIT;
        }
    }
    guard->output = jaxhil_towards(before, command, guard->most);
    guard->rate = guard->output - before;
    return JAXHIL_VELOCITY_LIMIT;
}

/* One period of the way to rest out of contact, from where the drives are; positions as above. */
static void jaxhil_position_guard_retreat(jaxhil_position_guard *guard, double measured, double position) {
    if (!guard->known) {
        jaxhil_position_guard_stand(guard, measured, position);
    }
    const double output = guard->output;
    double wanted = 0.0;
    if (output > -guard->distance) {
        wanted = -guard->retreat;
    } else if (output < guard->distance - guard->clearance) {
        wanted = guard->retreat;
    }
    double rate = guard->rate;
    const double change = wanted - rate;
    if (change > guard->braking) {
        rate += guard->braking;
    } else if (change < -guard->braking) {
        rate -= guard->braking;
    } else {
        rate = wanted;
    }
    double moved = output + rate;
    /* What begins outside the stroke may come back, and goes no further out. */
    if (moved < guard->lowest && rate < 0.0) {
        moved = output < guard->lowest ? output : guard->lowest;
        rate = 0.0;
    } else if (moved > guard->highest && rate > 0.0) {
        moved = output > guard->highest ? output : guard->highest;
        rate = 0.0;
    }
    guard->rate = rate;
    guard->output = moved;
    guard->at_rest = rate == 0.0 && wanted == 0.0;
}
