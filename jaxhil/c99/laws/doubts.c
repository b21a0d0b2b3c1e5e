/* What speaks against a contact's being known, scaled by approach speed and equivalent mass: it is unsure, where it
 * was hardly read; too short, where the hardware entered when half of it was over; displaced, where readings stood
 * out of the noise before the hardware should enter, or there was hardly any force on the first 10 ms of its way
 * in; noisy, where the force that the map expects is uncertain by a hundredth of its peak, the dead zone is a tenth
 * of that, or second differences show that the measured position is noisy; else identified.
 */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"
#include "law_status_table.c"

/* == Declarations == */

/* Of one contact: position [m] measured last and its step; squares and number of second differences; sums over the
 * readings of the first 10 ms; by how much [s] the hardware entered late; readings in contact, those of the first
 * 10 ms, those that stood out of the noise too early. */
typedef struct {
    double position, step, swings, swung, force, depth, variance, late;
    long readings, shallow, early;
} jaxhil_doubts;

/* == Definitions == */

static const long jaxhil_few = 5;
static const double jaxhil_too_late = 0.5;
static const long jaxhil_early = 2;
enum { JAXHIL_SHALLOW = 3, JAXHIL_DEEP = 5 }; /* the knots at 10 and 24 ms of depth */
static const double jaxhil_softest = 0.25;
static const double jaxhil_wide = 0.01;
static const double jaxhil_hiding = 0.1;
static const double jaxhil_shaking = 0.0005; /* s, over the approach speed */

/* The run begins in uniform motion: the position [m] before its first, by a tick's stride [m]. */
static void jaxhil_doubts_start(jaxhil_doubts *doubts, double position, double stride) {
    doubts->position = position;
    doubts->step = stride;
}

static void jaxhil_doubts_restart(jaxhil_doubts *doubts) {
    doubts->early = 0;
    doubts->readings = 0;
    doubts->late = 0.0;
    doubts->swings = 0.0;
    doubts->swung = 0.0;
    doubts->shallow = 0;
    doubts->force = 0.0;
    doubts->depth = 0.0;
    doubts->variance = 0.0;
}

/* The position [m] measured at this tick. */
static void jaxhil_doubts_move(jaxhil_doubts *doubts, double position) {
    const double step = position - doubts->position;
    const double swing = step - doubts->step;
    doubts->swings += swing * swing;
    doubts->swung += 1.0;
    doubts->position = position;
    doubts->step = step;
}

/* A reading in contact: its depth and the deepest point so far [s], the force [1/s], its variance [1/s^2]. */
static void jaxhil_doubts_read(jaxhil_doubts *doubts, double depth, double deepest, double force,
                               double variance) {
    doubts->readings++;
    if (deepest <= jaxhil_knots[JAXHIL_SHALLOW]) {
        doubts->shallow++;
        doubts->force += force;
        doubts->depth += depth;
        doubts->variance += variance;
    }
}

/* Whether the first readings are, but for chance, far below what those deeper tell of. */
static bool jaxhil_doubts_deeper(const jaxhil_doubts *doubts, const jaxhil_curve *curve) {
    const double slope = curve->at_knots[JAXHIL_DEEP] / jaxhil_knots[JAXHIL_DEEP];
    return doubts->shallow >= jaxhil_few &&
           doubts->force + 2.0 * sqrt(doubts->variance) < jaxhil_softest * (slope * doubts->depth);
}

static int jaxhil_doubts_status(const jaxhil_doubts *doubts, const jaxhil_curve *curve, double peak,
                                double deepest, double variance, double zone, double speed) {
    const double wide = jaxhil_wide * peak;
    const double shaking = jaxhil_shaking * speed;
    if (doubts->readings < jaxhil_few) {
        return JAXHIL_UNSURE;
    }
    if (doubts->late * peak > jaxhil_too_late * jaxhil_map_pi) {
        return JAXHIL_TOO_SHORT;
    }
    if (deepest >= jaxhil_knots[JAXHIL_DEEP] && jaxhil_doubts_deeper(doubts, curve)) {
        return JAXHIL_DISPLACED;
    }
    if (zone > jaxhil_hiding * peak || variance > wide * wide ||
        doubts->swings > 6.0 * doubts->swung * (shaking * shaking)) {
        return JAXHIL_NOISY;
    }
    return JAXHIL_IDENTIFIED;
}
