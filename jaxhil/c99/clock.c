/* Guard of the times of the ticks: early, late and missed ticks, and a clock that parts from the ticks.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "faults_table.c"
#include "limits_table.c"

/* == Declarations == */

/* The times of the ticks: which came early or late, and how many were missed. `drift` are the periods by which
 * the clock has gone ahead of the ticks, with those missed; `awaited` ticks counted as missed that may yet come;
 * `in_a_row` ticks missed since the last one in time. */
typedef struct {
    double period, missing, late_gap, early_gap, tolerated;
    double time, drift;
    int64_t missed, late, awaited, in_a_row;
    bool fatal;
} jaxhil_clock;

/* == Definitions == */

/* Periods counted for one gap, so that a wild clock stays a small number. */
#define JAXHIL_MOST_MISSED 1000000

static const double jaxhil_longest_gap = 1.5; /* periods since the last tick beyond which a tick is missing */
static const double jaxhil_drift_kept = 0.99; /* of the clock's drift, from one tick to the next */
static const double jaxhil_most_drift = 1.5; /* periods */

static void jaxhil_clock_pause(jaxhil_clock *clock) {
    clock->time = -INFINITY;
    clock->drift = 0.0;
    clock->awaited = 0;
    clock->in_a_row = 0;
    clock->fatal = false;
}

static void jaxhil_clock_reset(jaxhil_clock *clock) {
    clock->missed = 0;
    clock->late = 0;
    jaxhil_clock_pause(clock);
}

static void jaxhil_clock_init(jaxhil_clock *clock, const jaxhil_limits *limits, double period) {
    clock->period = period;
    clock->missing = jaxhil_longest_gap * period;
    clock->late_gap = (1.0 + limits->late_fraction) * period;
    clock->early_gap = (1.0 - limits->late_fraction) * period;
    clock->tolerated = limits->missed_in_a_row;
    jaxhil_clock_reset(clock);
}

/* Take note of the drift [periods]; the tick's fault, or that clock and ticks have parted. */
static uint32_t jaxhil_clock_part(jaxhil_clock *clock, double drift, uint32_t fault) {
    clock->drift = drift;
    if (fabs(drift) > jaxhil_most_drift) {
        clock->fatal = true;
        return JAXHIL_CLOCK;
    }
    return fault;
}

/* Count the ticks missed in a gap of so many periods; the fault. */
static uint32_t jaxhil_clock_miss(jaxhil_clock *clock, double periods) {
    int64_t left_out = JAXHIL_MOST_MISSED - 1;
    double drift = 0.0;
    if (!(periods > JAXHIL_MOST_MISSED)) {
        left_out = (int64_t)(periods + 0.5) - 1;
        drift = jaxhil_drift_kept * clock->drift + (periods - 1.0 - (double)left_out);
    }
    clock->missed += left_out;
    clock->awaited = left_out;
    clock->in_a_row += left_out;
    clock->fatal = (double)clock->in_a_row > clock->tolerated;
    return jaxhil_clock_part(clock, drift, JAXHIL_MISSED_TICK);
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
    const double periods = gap / clock->period;
    if (gap > clock->missing) {
        return jaxhil_clock_miss(clock, periods);
    }
    clock->in_a_row = 0;
    double drift = jaxhil_drift_kept * clock->drift + (periods - 1.0);
    uint32_t fault = 0;
    if (gap < clock->early_gap) {
        fault = JAXHIL_EARLY_TICK;
        if (clock->awaited > 0) {
            /* It was late by more than half a period, not missed. */
            clock->awaited--;
            drift += 1.0;
        }
    } else {
        clock->awaited = 0;
        if (gap > clock->late_gap) {
            clock->late++;
            fault = JAXHIL_LATE_TICK;
        }
    }
    return jaxhil_clock_part(clock, drift, fault);
}
