/* Whether the readings are those of contact that the map can be: what they tell of energy, onset and turning.
 *
 * W, the energy that the contact took, is the integral of the force that was read over the way, less what the map
 * stores between the ends of that; L is what the map dissipates. With p the map's peak force, no contact that is
 * known explains that
 * - W and L differ by more than 0.014 and chance;
 * - W is beyond that, no more than a force delay wrong by 4 ms makes of it, and the force at the onset is less than 0.7
 *   of a damper's that takes W: it is taken without a jump at the onset;
 * - as the hardware turns, until its speed is -0.15, readings are less than expected by 0.045 p in the mean and chance:
 *   friction.
 * Chance is three standard deviations of the noise. Scaled as in force_depth_map.c, energies over mass and the square
 * of the approach speed.
 */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"

/* == Declarations == */

enum { JAXHIL_LOSSES = 4 };

/* Sums over the readings while the contact pushes: the integrals of force over depth and over speed, the variance of
 * the first, the integrals of what dissipates over depth; the depth where they begin and end; of the last reading the
 * depth as it was taken for, speed, force and what dissipates; of `turned` readings at the turning, by how much less
 * than expected they were, and the variance of that; whether the contact pushes no more. */
typedef struct {
    double work, gained, variance, lost[JAXHIL_LOSSES], first, last, depth, rate, force, terms[JAXHIL_LOSSES];
    double missing, spread, turned;
    bool begun, released;
} jaxhil_balance;

/* == Definitions == */

static const double jaxhil_balance_off = 0.014;     /* of twice the energy that a contact begins with */
static const double jaxhil_balance_damper = 0.7;    /* of the force at the onset of a damper */
static const double jaxhil_balance_delay = 0.004;   /* s, that a force delay may be wrong by */
static const double jaxhil_balance_turning = -0.15; /* the speed until which the hardware turns */
static const double jaxhil_balance_missing = 0.045; /* of the peak force */
static const double jaxhil_balance_shallow = 0.25;  /* of the deepest point: nearly over */

static void jaxhil_balance_restart(jaxhil_balance *balance) {
    balance->work = 0.0;
    balance->gained = 0.0;
    balance->variance = 0.0;
    for (int i = 0; i < JAXHIL_LOSSES; i++) {
        balance->lost[i] = 0.0;
    }
    balance->missing = 0.0;
    balance->spread = 0.0;
    balance->turned = 0.0;
    balance->begun = false;
    balance->released = false;
}

/* A reading that the curve has not learnt from: depth [s], by how much less [s] that counts, speed, deepest point [s],
 * force [1/s], its variance and that of what was expected last [1/s^2]. */
static void jaxhil_balance_take(jaxhil_balance *balance, const jaxhil_curve *curve, double given, double less,
                                double rate, double deepest, double force, double variance, double known) {
    const double depth = given - less;
    const double expected = jaxhil_curve_force(curve, depth, rate, deepest);
    const bool pushes = rate > 0.0 || expected > 0.0 || force * force > jaxhil_map_outlying * variance;
    if (!(depth > 0.0 && pushes)) {
        balance->released = balance->begun && rate < 0.0;
        return;
    }
    const double terms[JAXHIL_LOSSES] = {rate, depth * rate / jaxhil_map_reach, depth - deepest,
                                         jaxhil_turning(rate)};
    if (balance->begun) {
        const double way = given - balance->depth;
        const double mean = 0.5 * (balance->force + force);
        balance->work += mean * way;
        balance->gained += mean * (rate - balance->rate);
        balance->variance += variance * way * way;
        for (int i = 0; i < JAXHIL_LOSSES; i++) {
            balance->lost[i] += 0.5 * (balance->terms[i] + terms[i]) * way;
        }
    } else {
        balance->first = depth;
    }
    balance->begun = true;
    balance->released = false;
    balance->last = depth;
    balance->depth = given;
    balance->rate = rate;
    balance->force = force;
    for (int i = 0; i < JAXHIL_LOSSES; i++) {
        balance->terms[i] = terms[i];
    }
    if (rate < 0.0 && rate > jaxhil_balance_turning) {
        balance->missing += expected - force;
        /* Of readings that no sensor makes, rounding leaves less than nothing. */
        balance->spread += known > 0.0 ? variance + known : variance;
        balance->turned += 1.0;
    }
}

/* Whether the energy of a contact that is nearly over is not explained, its force older by `shift` [s] than it was
 * taken for, on a scale of time slower by `pace`. */
static bool jaxhil_balance_unequal(const jaxhil_balance *balance, const jaxhil_curve *curve, double peak,
                                   double shift, double pace) {
    const double between =
        jaxhil_curve_stored(curve, balance->last) - jaxhil_curve_stored(curve, balance->first);
    const double taken = balance->work - shift * balance->gained - between;
    const double dissipated = curve->damping * balance->lost[0] + curve->depth_damping * balance->lost[1] +
                              curve->unloading * balance->lost[2] + curve->friction * balance->lost[3];
    const double off = jaxhil_balance_off + 3.0 * sqrt(balance->variance);
    const double onset = curve->at_knots[0] + curve->damping + curve->friction;
    const double damper = 2.0 / jaxhil_map_pi * (taken * peak);
    const double most = 0.5 * jaxhil_map_pi * (peak * (jaxhil_balance_delay * pace));
    return taken - dissipated > off || taken - dissipated < -off ||
           (taken > off && taken < most && onset < jaxhil_balance_damper * damper);
}

/* Whether the map that makes this curve, its peak force given, does not explain what was read. */
static bool jaxhil_balance_unexplained(const jaxhil_balance *balance, const jaxhil_curve *curve, double peak,
                                       double deepest, double shift, double pace) {
    const bool over = balance->begun && balance->rate < 0.0 &&
                      (balance->released || balance->last < jaxhil_balance_shallow * deepest);
    const double missing = jaxhil_balance_missing * (peak * balance->turned) + 3.0 * sqrt(balance->spread);
    return balance->missing > missing || (over && jaxhil_balance_unequal(balance, curve, peak, shift, pace));
}
