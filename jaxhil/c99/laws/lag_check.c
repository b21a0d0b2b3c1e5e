/* Whether readings are rather those of a force sensor that lags than what the map can be.
 *
 * While the force lasts a lag takes away what a damper gives: of a contact with a damper the map then explains all but
 * how the force begins and ends, which is gradual. So the contact is identified a second time, from the same prior, as a
 * sensor with a time constant of 2 ms would show it: what the force is linear in is smoothed alike, and the surface was
 * met where lagged_onset.c has it. Either is charged for every reading since before the surface was met with
 * (y - f)^2/s, f what it expects and s the variance of that and of the noise. Where the lag is charged less by more than
 * `likelier`, twice the logarithm of odds, the map is not believed, if such a lag makes the restitution err: in slow
 * contact, whose onset is hardly known, it does not.
 */
#include <math.h>
#include <stdbool.h>

#include "contact_plane.c"
#include "contact_readings.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "history.c"
#include "lagged_onset.c"
#include "onset.c"
#include "reintegration.c"

/* == Declarations == */

/* Control period [s]; what it shows is `kept` after a tick; ticks before the surface was met whose readings count. Of the
 * contact its lag and a tick [s], by how much its surface is deeper than it was met [s], knots [s], deepest point [s];
 * what is smoothed, `held`, as it was before that, whether the contact then pushed; what the lag is charged. */
typedef struct {
    double period, kept, lag, tick, below, deepest, surprise;
    long earlier;
    double knots[JAXHIL_SEGMENTS], held[JAXHIL_PARAMETERS], before[JAXHIL_PARAMETERS];
    bool pushed;
    jaxhil_force_depth_map map;
} jaxhil_lag_check;

/* == Definitions == */

static const double jaxhil_check_lag = 0.002; /* s */
static const double jaxhil_likelier = 6.0;
static const double jaxhil_lag_matters = 0.025; /* of a restitution of 1 */

static void jaxhil_lag_check_init(jaxhil_lag_check *check, const jaxhil_gains *gains) {
    check->period = gains->control_period;
    check->kept = jaxhil_exponential(check->period / jaxhil_check_lag, JAXHIL_SQUARINGS);
    check->earlier = (long)ceil(jaxhil_check_lag / check->period) + (long)jaxhil_lagged_before;
    jaxhil_force_depth_map_init(&check->map, gains);
}

/* Whether such a lag makes the restitution of a contact of this peak force [1/s] err, by pi/2 p l. */
static bool jaxhil_lag_check_matters(const jaxhil_lag_check *check, double peak) {
    return 0.5 * jaxhil_map_pi * (peak * check->lag) > jaxhil_lag_matters;
}

/* A contact begins; the newest readings. */
static void jaxhil_lag_check_begin(jaxhil_lag_check *check, const jaxhil_meeting *meeting,
                                   const jaxhil_window *window) {
    const double length = meeting->speed / meeting->pace;
    double later, square;
    check->lag = jaxhil_check_lag * meeting->pace;
    check->tick = meeting->tick;
    jaxhil_lagged_onset(window, check->lag, meeting->tick, &later, &square);
    const double around = square + meeting->variance / (length * length);
    const double off = around > 0.0 ? sqrt(around) : 0.0;
    jaxhil_force_depth_map_restart(&check->map, jaxhil_lagged_usual * (meeting->stiffness * off));
    check->below = (meeting->place - meeting->plane) / length + later;
    const double most = jaxhil_lagged_farthest;
    jaxhil_lagged_knots(-later > most ? most : (-later < -most ? -most : -later), check->knots);
    check->deepest = 0.0;
    check->pushed = false;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        check->held[i] = 0.0;
        check->before[i] = 0.0;
    }
    check->surprise = 0.0;
}

/* What the force is linear in, as a sensor that lags shows it: the mean over the tick, from the entry on where that is
 * within it, as long as the contact pushes. */
static void jaxhil_lag_check_smooth(jaxhil_lag_check *check, double depth, double rate) {
    const double *knots = check->knots;
    double now[JAXHIL_PARAMETERS];
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        const double beyond = depth - knots[j];
        const bool through = j + 1 < JAXHIL_SEGMENTS && beyond > knots[j + 1] - knots[j];
        now[j] = depth > knots[j] ? (through ? knots[j + 1] - knots[j] : beyond) : 0.0;
    }
    double *others = now + JAXHIL_SEGMENTS;
    others[0] = rate;
    others[1] = depth * rate / jaxhil_map_reach;
    others[2] = depth - check->deepest;
    others[3] = jaxhil_turning(rate);
    others[4] = 1.0;
    const bool pushes =
        depth > jaxhil_map_surface &&
        (rate > 0.0 || jaxhil_force_depth_map_expected(&check->map, now, JAXHIL_SEGMENTS, others) > 0.0);
    const bool enters = pushes && !check->pushed;
    double lost = check->kept;
    if (enters) {
        const double since = rate > 0.0 ? depth / rate : 0.0;
        lost = jaxhil_exponential((since < check->tick ? since : check->tick) / check->lag, JAXHIL_SQUARINGS);
    }
    const double half = 0.5 * (1.0 - lost);
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        const bool jumps = i == JAXHIL_DAMPING || i == JAXHIL_FRICTION || i == JAXHIL_PRELOAD;
        const double before = enters ? (jumps ? now[i] : 0.0) : check->before[i];
        check->held[i] = check->kept * check->held[i];
        if (pushes || check->pushed) {
            check->held[i] += half * (before + now[i]);
        }
        check->before[i] = now[i];
    }
    check->pushed = pushes;
}

/* One reading. */
static void jaxhil_lag_check_take(jaxhil_lag_check *check, const jaxhil_reading *reading) {
    const double depth = reading->depth - check->below;
    if (depth > check->deepest) {
        check->deepest = depth;
    }
    jaxhil_lag_check_smooth(check, depth, reading->rate);
    if (!reading->shown) {
        return;
    }
    const double *others = check->held + JAXHIL_SEGMENTS;
    int number = 0;
    while (number < JAXHIL_SEGMENTS && check->knots[number] < check->deepest) {
        number++;
    }
    if (check->pushed) {
        check->surprise += jaxhil_force_depth_map_learn(&check->map, check->held, number, others, reading->rate > 0.0,
                                                        reading->force, reading->variance);
    } else {
        const double expected = jaxhil_force_depth_map_expected(&check->map, check->held, number, others);
        const double missed = reading->force - (expected > 0.0 ? expected : 0.0);
        check->surprise += missed * missed / reading->variance;
    }
}
