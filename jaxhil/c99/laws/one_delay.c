/* What is learnt of a contact where the delay of the force is known: a force-depth map. */
#include <stdbool.h>

#include "contact_plane.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "history.c"
#include "reintegration.c"

/* == Declarations == */

typedef struct {
    jaxhil_force_depth_map map;
} jaxhil_learnt;

/* == Definitions == */

static const double jaxhil_misfit = 0.003; /* of a force, by which the map may be wrong */

static void jaxhil_learnt_init(jaxhil_learnt *learnt, const jaxhil_gains *gains) {
    jaxhil_force_depth_map_init(&learnt->map, gains);
}

static void jaxhil_learnt_reset(jaxhil_learnt *learnt) {
    (void)learnt;
}

/* A contact begins. How many ticks before the meeting readings count. */
static long jaxhil_learnt_begin(jaxhil_learnt *learnt, const jaxhil_meeting *meeting, const jaxhil_history *history,
                                const jaxhil_scales *scales, double variance) {
    (void)meeting;
    (void)history;
    (void)scales;
    (void)variance;
    jaxhil_force_depth_map_restart(&learnt->map);
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

/* Whether its delay is left open: it is told. */
static bool jaxhil_learnt_open(const jaxhil_learnt *learnt, double peak) {
    (void)learnt;
    (void)peak;
    return false;
}

/* One reading: depth [s], speed, deepest point [s], force [1/s], its variance [1/s^2], whether the sensor's dead
 * zone hides it, that zone [1/s]. */
static void jaxhil_learnt_read(jaxhil_learnt *learnt, double depth, double rate, double deepest, double force,
                               double variance, bool hidden, double zone) {
    jaxhil_force_depth_map *map = &learnt->map;
    if (depth > 0.0) {
        if (!hidden) {
            jaxhil_force_depth_map_update(map, depth, rate, deepest, force, variance);
        } else if (jaxhil_curve_force(&map->curve, depth, rate, deepest) > zone) {
            jaxhil_force_depth_map_update(map, depth, rate, deepest, 0.5 * zone,
                                          variance + zone * zone / 12.0);
        }
    }
}
