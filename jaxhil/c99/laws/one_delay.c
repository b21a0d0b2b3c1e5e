/* What is learnt of a contact where the delay of the force is known: a force-depth map, and whether a lag of the sensor
 * would explain the readings better. */
#include <stdbool.h>

#include "contact_plane.c"
#include "contact_readings.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "history.c"
#include "lag_check.c"
#include "lagged_onset.c"
#include "reintegration.c"

/* == Declarations == */

/* How many readings were checked, and whether these are all; what the map is charged for them. */
typedef struct {
    jaxhil_force_depth_map map;
    jaxhil_lag_check check;
    long checked;
    bool all;
    double surprise;
} jaxhil_learnt;

/* == Definitions == */

static const double jaxhil_misfit = 0.003; /* of a force, by which the map may be wrong */

static void jaxhil_learnt_init(jaxhil_learnt *learnt, const jaxhil_gains *gains) {
    jaxhil_force_depth_map_init(&learnt->map, gains);
    jaxhil_lag_check_init(&learnt->check, gains);
}

static void jaxhil_learnt_reset(jaxhil_learnt *learnt) {
    (void)learnt;
}

/* A contact begins. How many ticks before the meeting readings count. */
static long jaxhil_learnt_begin(jaxhil_learnt *learnt, const jaxhil_meeting *meeting, const jaxhil_history *history,
                                const jaxhil_scales *scales, double variance) {
    jaxhil_window window;
    jaxhil_force_depth_map_restart(&learnt->map, 0.0);
    jaxhil_lagged_newest(meeting, history, scales, variance, &window);
    jaxhil_lag_check_begin(&learnt->check, meeting, &window);
    learnt->checked = 0;
    learnt->all = false;
    learnt->surprise = 0.0;
    return 0;
}

static const jaxhil_curve *jaxhil_learnt_curve(const jaxhil_learnt *learnt) {
    return &learnt->map.curve;
}

/* Variance [1/s^2] of the force that is expected where it was read last. */
static double jaxhil_learnt_variance(const jaxhil_learnt *learnt) {
    return learnt->map.variance;
}

/* By how much the force is older than by the given delay, and the surface deeper than it was met [s]. */
static double jaxhil_learnt_shift(const jaxhil_learnt *learnt) {
    (void)learnt;
    return 0.0;
}

static double jaxhil_learnt_deeper(const jaxhil_learnt *learnt) {
    (void)learnt;
    return 0.0;
}

/* Whether a lag would explain the readings better, if it makes the restitution err. */
static bool jaxhil_learnt_open(const jaxhil_learnt *learnt, double peak) {
    const bool likelier = learnt->all && learnt->surprise - learnt->check.surprise > jaxhil_likelier;
    return likelier && jaxhil_lag_check_matters(&learnt->check, peak);
}

/* A reading out of contact, for which the map is charged: the surface is known to a tick. */
static void jaxhil_learnt_miss(jaxhil_learnt *learnt, double depth, double force, double variance) {
    if (depth <= -learnt->check.tick) {
        learnt->surprise += force * force / variance;
    }
}

/* One reading: depth [s], speed, deepest point [s], force [1/s], its variance [1/s^2], whether the sensor's dead
 * zone hides it, that zone [1/s]. */
static void jaxhil_learnt_read(jaxhil_learnt *learnt, double depth, double rate, double deepest, double force,
                               double variance, bool hidden, double zone) {
    jaxhil_force_depth_map *map = &learnt->map;
    if (!hidden) {
        if (depth > 0.0) {
            learnt->surprise += jaxhil_force_depth_map_update(map, depth, rate, deepest, force, variance);
        } else {
            jaxhil_learnt_miss(learnt, depth, force, variance);
        }
    } else if (depth > 0.0 && jaxhil_curve_force(&map->curve, depth, rate, deepest) > zone) {
        jaxhil_force_depth_map_update(map, depth, rate, deepest, 0.5 * zone, variance + zone * zone / 12.0);
    }
}

/* What else is asked of a reading, the next of so many, noise of a `variance` [1/s^2]; the surface was met after the tick
 * `entry`. */
static void jaxhil_learnt_check(jaxhil_learnt *learnt, const jaxhil_history *history, const jaxhil_scales *scales,
                                long entry, double variance, int readings) {
    jaxhil_lag_check *check = &learnt->check;
    const long first = entry + 1 - check->earlier;
    for (int i = 0; i < readings && first + learnt->checked <= history->newest; i++) {
        const long tick = first + learnt->checked++;
        if (tick >= 0) {
            const jaxhil_reading reading =
                jaxhil_reading_at(history, scales, tick, variance, jaxhil_misfit, check->tick);
            jaxhil_lag_check_take(check, &reading);
            if (reading.shown && tick <= entry) {
                jaxhil_learnt_miss(learnt, reading.depth, reading.force, reading.variance);
            }
        }
    }
    learnt->all = first + learnt->checked > history->newest;
}
