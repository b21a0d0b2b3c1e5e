/* What comes in, checked: clock, sensor readings, the numerical model's motion.
 *
 * A bad sensor reading is replaced by the last good one.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "faults_table.c"
#include "limits_table.c"

/* == Declarations == */

/* The times of the ticks: which came late, and how many were missed. */
typedef struct {
    double period, missing, late_gap, tolerated;
    double time;
    int64_t missed, late;
    bool fatal;
} jaxhil_clock;

/* The bias of the force sensor [N], as the mean of `tare_ticks` readings out of contact. */
typedef struct {
    double ticks, spread, limit, range;
    double sum, lowest, highest, bias;
    int64_t count;
    bool fatal;
} jaxhil_bias_tare;

/* The readings of one tick, checked one by one: `force` [N] without bias and `measured` [m] are what the law
 * is to use, `fatal` the faults that trip. */
typedef struct {
    double clearance, range, lowest, highest, held, force_stuck, position_stuck;
    double free_distance, free_force, settling;
    double force_reading, force_travel, position_travel, desired, force, measured;
    int64_t bad_forces, bad_positions, forces_in_flight, flight;
    uint32_t fatal;
    bool known;
} jaxhil_input_guard;

/* == Definitions == */

/* Periods counted for one gap, so that a wild clock stays a small number. */
#define JAXHIL_MOST_MISSED 1000000

static void jaxhil_clock_pause(jaxhil_clock *clock) {
    clock->time = -INFINITY;
    clock->fatal = false;
}

static void jaxhil_clock_reset(jaxhil_clock *clock) {
    clock->missed = 0;
    clock->late = 0;
    jaxhil_clock_pause(clock);
}

static void jaxhil_clock_init(jaxhil_clock *clock, const jaxhil_limits *limits, double period) {
    clock->period = period;
    clock->missing = 1.5 * period;
    clock->late_gap = (1.0 + limits->late_fraction) * period;
    clock->tolerated = limits->missed_in_a_row;
    jaxhil_clock_reset(clock);
}

static uint32_t jaxhil_clock_tick(jaxhil_clock *clock, double time) {
    clock->fatal = false;
    if (!isfinite(time)) {
        clock->fatal = true;
        return JAXHIL_CLOCK;
    }
    if (clock->time == -INFINITY) { /* the first tick */
        clock->time = time;
        return 0;
    }
    const double gap = time - clock->time;
    if (!(gap > 0.0)) {
        clock->fatal = true;
        return JAXHIL_CLOCK;
    }
    clock->time = time;
    if (gap > clock->missing) {
        const double periods = gap / clock->period + 0.5;
        const int64_t left_out = (periods > JAXHIL_MOST_MISSED ? JAXHIL_MOST_MISSED : (int64_t)periods) - 1;
        clock->missed += left_out;
        clock->fatal = (double)left_out > clock->tolerated;
        return JAXHIL_MISSED_TICK;
    }
    if (gap > clock->late_gap) {
        clock->late++;
        return JAXHIL_LATE_TICK;
    }
    return 0;
}

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
    jaxhil_input_guard_restart(guard);
}

/* Take this tick's position in [m], the numerical model's being `desired` [m]; its fault. */
static uint32_t jaxhil_input_guard_position(jaxhil_input_guard *guard, double position, double desired) {
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
        guard->fatal |= (double)guard->bad_positions > guard->held ? fault : 0;
    }
    guard->desired = desired;
    return fault;
}

/* Take this tick's force reading in [N], the position having moved from `before` [m]; its fault. */
static uint32_t jaxhil_input_guard_force(jaxhil_input_guard *guard, double reading, double before, double bias) {
    const double measured = guard->measured;
    uint32_t fault = 0;
    if (isfinite(reading) && fabs(reading) < guard->range) {
        guard->bad_forces = 0;
        if (reading == guard->force_reading && (measured > 0.0 || measured < -guard->clearance)) {
            guard->force_travel += fabs(measured - before);
            fault = guard->force_travel > guard->force_stuck ? JAXHIL_FORCE_STUCK : 0;
            guard->fatal |= fault;
        } else {
            guard->force_travel = 0.0;
        }
        guard->force_reading = reading;
        guard->force = reading - bias;
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
    if (!guard->known) {
        /* Before the first tick there is no good reading: no force, and the position as desired. */
        guard->known = true;
        guard->desired = desired;
        guard->measured = desired;
        guard->force_reading = INFINITY;
    }
    const double before = guard->measured;
    uint32_t faults = jaxhil_input_guard_position(guard, position, desired);
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
