/* What speaks against a contact's being known, scaled by approach speed and equivalent mass: it is unsure, where it
 * was hardly read; too short, where the hardware entered when half of it was over; displaced, where its surface is
 * far from where it was told; noisy, where the force that the map expects is uncertain by a hundredth of its peak,
 * the dead zone is a tenth of that, or second differences show that the measured position is noisy; unexplained,
 * where the readings are not those of contact that the map can be (balance.c); else identified.
 */
#include <stdbool.h>

#include "force_depth_map.c"
#include "law_status_table.c"

/* == Declarations == */

/* Of one contact: position [m] measured last and its step; squares and number of second differences; by how much
 * [s] the hardware entered late; readings in contact; whether its surface is far from where it was told, and whether the
 * readings are unexplained. */
typedef struct {
    double position, step, swings, swung, late;
    long readings;
    bool displaced, unexplained;
} jaxhil_doubts;

/* == Definitions == */

static const long jaxhil_few = 5;
static const double jaxhil_too_late = 0.5;
static const double jaxhil_far = 3.0; /* times the gain plane_spread */
static const double jaxhil_wide = 0.01;
static const double jaxhil_hiding = 0.1;
static const double jaxhil_shaking = 0.0005; /* s, over the approach speed */

/* The run begins in uniform motion: the position [m] before its first, by a tick's stride [m]. */
static void jaxhil_doubts_start(jaxhil_doubts *doubts, double position, double stride) {
    doubts->position = position;
    doubts->step = stride;
}

static void jaxhil_doubts_restart(jaxhil_doubts *doubts) {
    doubts->readings = 0;
    doubts->late = 0.0;
    doubts->displaced = false;
    doubts->unexplained = false;
    doubts->swings = 0.0;
    doubts->swung = 0.0;
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

static int jaxhil_doubts_status(const jaxhil_doubts *doubts, double peak, double variance, double zone,
                                double speed) {
    const double wide = jaxhil_wide * peak;
    const double shaking = jaxhil_shaking * speed;
    if (doubts->readings < jaxhil_few) {
        return JAXHIL_UNSURE;
    }
    if (doubts->late * peak > jaxhil_too_late * jaxhil_map_pi) {
        return JAXHIL_TOO_SHORT;
    }
    if (doubts->displaced) {
        return JAXHIL_DISPLACED;
    }
    if (zone > jaxhil_hiding * peak || variance > wide * wide ||
        doubts->swings > 6.0 * doubts->swung * (shaking * shaking)) {
        return JAXHIL_NOISY;
    }
    return doubts->unexplained ? JAXHIL_UNEXPLAINED : JAXHIL_IDENTIFIED;
}
