/* What comes in, checked: sensor readings, the numerical model's motion.
 *
 * A bad sensor reading is replaced by the last good one.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "faults_table.c"
#include "limits_table.c"

/* == Declarations == */

/* The bias of the force sensor [N], as the mean of `tare_ticks` readings out of contact. */
typedef struct {
    double ticks, spread, limit, range;
    double sum, lowest, highest, bias;
    int64_t count;
    bool fatal;
} jaxhil_bias_tare;

/* The readings of one tick, checked one by one: `force` [N] without bias and `measured` [m] are what the law
 * is to use, `fatal` the faults that trip. `located` [m] is where the drives were read last, NAN before;
 * `is_located`, whether a reading in range of this run said so. */
typedef struct {
    double clearance, range, lowest, highest, held, force_stuck, position_stuck;
    double free_distance, free_force, settling;
    double force_reading, force_travel, position_travel, desired, force, measured, located;
    int64_t bad_forces, bad_positions, forces_in_flight, flight;
    uint32_t fatal;
    bool known, is_located;
} jaxhil_input_guard;

/* == Definitions == */

static const double jaxhil_tare_rounding = 1e-9; /* of a reading */

static void jaxhil_bias_tare_begin(jaxhil_bias_tare *tare) {
    tare->count = 0;
    tare->sum = 0.0;
    tare->lowest = INFINITY;
    tare->highest = -INFINITY;
    tare->fatal = false;
}

static void jaxhil_bias_tare_init(jaxhil_bias_tare *tare, const jaxhil_limits *limits) {
    tare->ticks = limits->tare_ticks;
    tare->spread = limits->tare_spread;
    tare->limit = limits->bias_limit;
    tare->range = limits->force_range;
    tare->bias = 0.0;
    jaxhil_bias_tare_begin(tare);
}

/* Take a reading in; whether the tare is over, well or, then `fatal`, badly. */
static bool jaxhil_bias_tare_take(jaxhil_bias_tare *tare, double reading) {
    if (!((double)tare->count < tare->ticks)) {
        return true;
    }
    if (tare->count == 0) {
        jaxhil_bias_tare_begin(tare);
    }
    tare->count++;
    tare->sum += reading;
    if (reading < tare->lowest) {
        tare->lowest = reading;
    }
    if (reading > tare->highest) {
        tare->highest = reading;
    }
    if (!(isfinite(reading) && fabs(reading) < tare->range)) {
        tare->fatal = true;
    } else if ((double)tare->count < tare->ticks) {
        return false;
    } else {
        const double mean = tare->sum / (double)tare->count;
        const double spread = tare->highest - tare->lowest;
        tare->fatal = !(spread <= tare->spread && fabs(mean) <= tare->limit && isfinite(mean));
        if (!tare->fatal) {
            tare->bias = mean;
        }
    }
    return true;
}

static void jaxhil_input_guard_restart(jaxhil_input_guard *guard) {
    guard->known = false;
    guard->bad_forces = 0;
    guard->bad_positions = 0;
    guard->forces_in_flight = 0;
    guard->flight = 0;
    guard->force_reading = 0.0;
    guard->force_travel = 0.0;
    guard->position_travel = 0.0;
    guard->desired = 0.0;
    guard->force = 0.0;
    guard->measured = 0.0;
    guard->fatal = 0;
}

static void jaxhil_input_guard_init(jaxhil_input_guard *guard, const jaxhil_limits *limits, double period,
                                    double clearance) {
    guard->clearance = clearance;
    guard->range = limits->force_range;
    guard->lowest = limits->measured_lowest;
    guard->highest = limits->measured_highest;
    guard->held = limits->held_readings;
    guard->force_stuck = limits->force_stuck_travel;
    guard->position_stuck = limits->position_stuck_travel;
    guard->free_distance = limits->free_distance;
    guard->free_force = limits->free_force;
    guard->settling = limits->settling / period;
    guard->located = NAN;
    guard->is_located = false;
    jaxhil_input_guard_restart(guard);
}

/* Take note of where the drives read [m], also once tripped. Before a run's first reading in range, any that a
 * rig can have is better than none. */
static void jaxhil_input_guard_locate(jaxhil_input_guard *guard, double position) {
    if (guard->lowest <= position && position <= guard->highest) {
        guard->is_located = true;
        guard->located = position;
    } else if (!guard->is_located && jaxhil_no_limits.measured_lowest <= position &&
               position <= jaxhil_no_limits.measured_highest) {
        guard->located = position;
    }
}

/* Take this tick's position in [m], the numerical model's being `desired` [m]; its fault. On the first tick there
 * is no good one to go on with, and nobody knows where the drives are. */
static uint32_t jaxhil_input_guard_position(jaxhil_input_guard *guard, double position, double desired,
                                            bool first) {
    uint32_t fault = 0;
    if (isfinite(position) && guard->lowest <= position && position <= guard->highest) {
        guard->bad_positions = 0;
        if (position == guard->measured) {
            guard->position_travel += fabs(desired - guard->desired);
            fault = guard->position_travel > guard->position_stuck ? JAXHIL_POSITION_STUCK : 0;
            guard->fatal |= fault;
        } else {
            guard->position_travel = 0.0;
        }
        guard->measured = position;
    } else {
        fault = isfinite(position) ? JAXHIL_POSITION_OUT_OF_RANGE : JAXHIL_POSITION_NOT_FINITE;
        guard->bad_positions++;
        guard->fatal |= first || (double)guard->bad_positions > guard->held ? fault : 0;
    }
    guard->desired = desired;
    return fault;
}

/* The force reads as before, in contact, while the measured position went so much deeper [m]; the fault. */
static uint32_t jaxhil_input_guard_same_force(jaxhil_input_guard *guard, double deeper) {
    if (fabs(guard->force) <= jaxhil_tare_rounding * fabs(guard->force_reading)) {
        /* A damped mechanism comes out without a force, but none can be pressed in without one. */
        const double travel = guard->force_travel + deeper;
        guard->force_travel = travel > 0.0 ? travel : 0.0;
    } else {
        guard->force_travel += fabs(deeper);
    }
    const uint32_t fault = guard->force_travel > guard->force_stuck ? JAXHIL_FORCE_STUCK : 0;
    guard->fatal |= fault;
    return fault;
}

/* Take this tick's force reading in [N], the position having moved from `before` [m]; its fault. */
static uint32_t jaxhil_input_guard_force(jaxhil_input_guard *guard, double reading, double before, double bias) {
    const double measured = guard->measured;
    uint32_t fault = 0;
    if (isfinite(reading) && fabs(reading) < guard->range) {
        guard->bad_forces = 0;
        guard->force = reading - bias;
        if (reading == guard->force_reading && (measured > 0.0 || measured < -guard->clearance)) {
            fault = jaxhil_input_guard_same_force(guard, measured > 0.0 ? measured - before : before - measured);
        } else {
            guard->force_travel = 0.0;
        }
        guard->force_reading = reading;
    } else {
        fault = isfinite(reading) ? JAXHIL_FORCE_OUT_OF_RANGE : JAXHIL_FORCE_NOT_FINITE;
        guard->bad_forces++;
        guard->fatal |= (double)guard->bad_forces > guard->held ? fault : 0;
    }
    return fault;
}

/* The faults of the readings of a tick: force [N], the model's motion [m, m/s], position [m]. */
static uint32_t jaxhil_input_guard_check(jaxhil_input_guard *guard, double reading, double desired,
                                         double velocity, double position, double bias) {
    if (!(isfinite(desired) && isfinite(velocity))) {
        guard->fatal = JAXHIL_MODEL_NOT_FINITE;
        return JAXHIL_MODEL_NOT_FINITE;
    }
    guard->fatal = 0;
    const bool first = !guard->known;
    if (first) {
        /* Before the first tick there is no good reading: no force, and the position as desired. */
        guard->known = true;
        guard->desired = desired;
        guard->measured = desired;
        guard->force_reading = INFINITY;
    }
    const double before = guard->measured;
    uint32_t faults = jaxhil_input_guard_position(guard, position, desired, first);
    faults |= jaxhil_input_guard_force(guard, reading, before, bias);
    const double measured = guard->measured;
    if (measured < -guard->free_distance && measured > guard->free_distance - guard->clearance) {
        guard->flight++;
    } else {
        guard->flight = 0;
    }
    if ((double)guard->flight > guard->settling && fabs(guard->force) > guard->free_force) {
        faults |= JAXHIL_FORCE_IN_FLIGHT;
        guard->forces_in_flight++;
        guard->fatal |= (double)guard->forces_in_flight > guard->held ? JAXHIL_FORCE_IN_FLIGHT : 0;
    } else {
        guard->forces_in_flight = 0;
    }
    return faults;
}
