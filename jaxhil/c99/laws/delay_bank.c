/* Hypotheses of the force delay and of a lag side by side, each with a map of its own, weighed by what they explain.
 * Hypothesis h takes the force to be d_h older than given: it belongs to the depth X - d_h V - p_h. The surface was
 * met at X_0, with a variance s^2; by this hypothesis it lies at p_h = g (X_0 - d_h v_0) beyond where it was told,
 * with g = spread^2/(spread^2 + s^2), or 1 where the two disagree. It expects to read f_h with a variance s_h (0 with
 * the noise's own variance r out of contact, and where what it expects while the contact opens is not positive). As
 * many others take the sensor to lag by l_h: what the force is linear in is smoothed alike, and the surface was met
 * where lagged_onset.c has it; to first order a lag is a delay, and these count as l_h older. Each delay is there
 * twice, by slopes that wander and by slopes that hardly do. A hypothesis' weight is the product of the likelihoods of
 * all readings of this contact and of those before, (r/s_h)^(1/4) exp(-(y - f_h)^2/(4 s_h)), of how well its damping,
 * of mean B and variance s^2, goes with what is known of contacts: p (s_0/s) exp(-t^2/2) + (1 - p) 2 Phi(t), t = B/s,
 * p = 0.35, and of how likely a surface is there: of a delay by entry.c, of a lag exp(-(X_0 - d_h v_0)^2/(2
 * (spread^2 + s^2))), at least 1/10. The exponentials are (1 + u/n)^-n. What counts is the mean over all hypotheses, of
 * their maps, delays and surfaces. Their maps bend at the same places, wherever they have the surface: which fits best
 * is not to be decided by what a contact that bends between two knots leaves.
 */
#include <math.h>
#include <stdbool.h>

#include "bank.c"
#include "bank_weights.c"
#include "contact_plane.c"
#include "entry.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "history.c"
#include "hypotheses.c"
#include "lagged_onset.c"
#include "onset.c"
#include "reintegration.c"

/* == Definitions == */

static const double jaxhil_misfit = 0.01; /* of a force, by which a map may be wrong */
static const double jaxhil_bank_least = 1e-200;
static const double jaxhil_bank_edge = 0.6;      /* probability of a farthest delay or the longest lag: it may lie beyond */
static const double jaxhil_bank_open = 0.0075;   /* of a restitution of 1, that what is open of the delay makes */
static const double jaxhil_bank_settled = 0.99;  /* probability from which on it is a lag */
static const double jaxhil_bank_beyond_noise = 9.0; /* times its variance: a force that is more than noise */
static const long jaxhil_bank_earlier = 30;  /* ticks before it was met, whose readings count */

/* Variance [1/s^2] of the force that is expected where it was read last. */
static double jaxhil_learnt_variance(const jaxhil_learnt *bank) {
    return bank->variance;
}

static const jaxhil_curve *jaxhil_learnt_curve(const jaxhil_learnt *bank) {
    return &bank->curve;
}

/* By how much the force is older than by the given delay, and the surface deeper than it was met [s]. */
static double jaxhil_learnt_shift(const jaxhil_learnt *bank) {
    return bank->shift * bank->pace;
}

static double jaxhil_learnt_deeper(const jaxhil_learnt *bank) {
    return bank->below;
}

/* Whether the delay is left open, the restitution by it [pi/2 p d], may well lie beyond all hypotheses, or be a lag:
 * readings that speak for one, if not so clearly that its being rare is outweighed. */
static bool jaxhil_learnt_open(const jaxhil_learnt *bank, double peak) {
    const double lagging = bank->lagging;
    const bool doubtful = jaxhil_bank_settled > lagging && lagging > jaxhil_lagging * (1.0 - lagging);
    return doubtful || bank->edge > jaxhil_bank_edge ||
           0.5 * jaxhil_map_pi * (peak * (bank->open * bank->pace)) > jaxhil_bank_open;
}

/* Nothing else is asked of the readings. */
static void jaxhil_learnt_check(jaxhil_learnt *bank, const jaxhil_history *history, const jaxhil_scales *scales,
                                long entry, double variance, int readings) {
    (void)bank;
    (void)history;
    (void)scales;
    (void)entry;
    (void)variance;
    (void)readings;
}

/* Each hypothesis has the surface between where it was met, with a lag by the newest readings, and where it was told,
 * or, where these disagree, where it was met. With a lag the force at the entry is known to what the stiffness makes
 * of the uncertain place; of delays the entry is weighed. How far [s] the hardware was in, by the first to enter, as
 * it was met. */
static double jaxhil_bank_place(jaxhil_learnt *bank, const jaxhil_meeting *meeting, const jaxhil_window *window) {
    const double length = meeting->speed / meeting->pace;
    const double known = bank->plane_spread * bank->plane_spread;
    double first = jaxhil_map_surface;
    jaxhil_entry_of(&bank->entry, meeting, window, known, bank->prior.covariance[JAXHIL_PRELOAD][JAXHIL_PRELOAD],
                    (bank->supposed.offsets[1] - bank->supposed.offsets[0]) * meeting->pace);
    bank->met_at = (meeting->place - meeting->plane) / length;
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        double met = meeting->place, around = meeting->variance;
        if (h >= JAXHIL_FIRST_LAG) {
            double later, square;
            jaxhil_lagged_onset(window, bank->supposed.lags[h - JAXHIL_FIRST_LAG] * meeting->pace, meeting->tick, &later,
                                &square);
            met = meeting->place + later * length;
            around = square * (length * length) + meeting->variance;
        }
        const double both = known + around;
        const double away = met - bank->supposed.offsets[h] * meeting->speed;
        const bool elsewhere = away * away > jaxhil_entry_elsewhere * both;
        const double share = elsewhere ? 1.0 : known / both;
        const double likely = jaxhil_exponential(0.5 * (away * away / both), JAXHIL_DENSITY_SQUARINGS);
        const double place = share * away;
        const double farther = (meeting->place - place) / length;
        double off = bank->entry.preload;
        if (h < JAXHIL_FIRST_LAG) {
            bank->met_deeper[h] = (away - place) / length;
            bank->told[h] = -place / length;
        } else {
            const double inside = (meeting->plane - place - bank->supposed.offsets[h] * meeting->speed) / length;
            off = jaxhil_lagged_usual * (share * (meeting->stiffness * (sqrt(around) / length)));
            /* What is not a number stays. */
            first = inside > first || inside != inside ? inside : first;
        }
        bank->deeper[h] = (place - meeting->plane) / length;
        jaxhil_lagged_knots(farther > jaxhil_lagged_farthest
                                ? jaxhil_lagged_farthest
                                : (farther < -jaxhil_lagged_farthest ? -jaxhil_lagged_farthest : farther),
                            bank->knots[h]);
        bank->likely[h] = likely > jaxhil_entry_unlikely ? likely : jaxhil_entry_unlikely;
        bank->covariance[h][JAXHIL_PRELOAD][JAXHIL_PRELOAD] += off * off;
    }
    return first > jaxhil_map_surface ? first : 0.0;
}

/* A contact begins: the one before is added to what is carried, and the maps are the prior. How many ticks before the
 * meeting readings count. */
static long jaxhil_learnt_begin(jaxhil_learnt *bank, const jaxhil_meeting *meeting, const jaxhil_history *history,
                                const jaxhil_scales *scales, double variance) {
    double weights[JAXHIL_HYPOTHESES];
    jaxhil_window window;
    if (bank->learning) {
        jaxhil_bank_finish(bank);
    }
    bank->pace = meeting->pace;
    jaxhil_bank_restart(bank);
    jaxhil_lagged_newest(meeting, history, scales, variance, &window);
    const double ticks = ceil(jaxhil_bank_place(bank, meeting, &window) / meeting->tick);
    jaxhil_bank_weigh(bank, weights);
    jaxhil_bank_conclude(bank, weights);
    return ticks < (double)jaxhil_bank_earlier ? (long)ticks : jaxhil_bank_earlier;
}

/* What the force is linear in, at a depth [s] and speed, by hypothesis h. */
static void jaxhil_bank_features(const jaxhil_learnt *bank, int h, double x, double rate, double *phi) {
    const double *knots = bank->knots[h];
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        const double beyond = x - knots[j];
        /* Of a delay, the surface may lie before where its map has it. */
        phi[j] = beyond > 0.0 || (j == 0 && h < JAXHIL_FIRST_LAG) ? beyond : 0.0;
        if (j < JAXHIL_SEGMENTS - 1 && beyond > knots[j + 1] - knots[j]) {
            phi[j] = knots[j + 1] - knots[j];
        }
    }
    phi[JAXHIL_DAMPING] = rate;
    phi[JAXHIL_DEPTH_DAMPING] = x * rate / jaxhil_map_reach;
    phi[JAXHIL_UNLOADING] = x - bank->deepest[h];
    phi[JAXHIL_FRICTION] = jaxhil_turning(rate);
    phi[JAXHIL_PRELOAD] = 1.0;
}

/* As a sensor that lags shows it: of phi the mean over the tick, from the entry on where that is within it, as long as
 * the contact pushes. */
static void jaxhil_bank_smooth(jaxhil_learnt *bank, int h, double depth, double rate, double *phi) {
    const int l = h - JAXHIL_FIRST_LAG;
    double *held = bank->held[l], *before = bank->before[l];
    const double tick = bank->period * bank->pace, kept = bank->kept[l];
    double raw = 0.0;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        raw += phi[i] * bank->estimate[h][i];
    }
    const bool pushes = depth > jaxhil_map_surface && (rate > 0.0 || raw > 0.0);
    const bool enters = pushes && !bank->pushed[l];
    double lost = kept;
    if (enters) {
        const double entered = rate > 0.0 ? depth / rate : 0.0;
        const double since = entered < tick ? entered : tick;
        lost = jaxhil_exponential(since / (bank->supposed.lags[l] * bank->pace), JAXHIL_SQUARINGS);
    }
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        const double now = phi[i];
        if (enters) {
            const bool jumps = i == JAXHIL_DAMPING || i == JAXHIL_FRICTION || i == JAXHIL_PRELOAD;
            before[i] = jumps ? now : 0.0;
        }
        const double fresh = (1.0 - lost) * (0.5 * (before[i] + now));
        held[i] = kept * held[i] + (pushes || bank->pushed[l] ? fresh : 0.0);
        before[i] = now;
        phi[i] = held[i];
    }
    bank->pushed[l] = pushes;
}

/* Hypothesis h reads: the square of what it missed, over its variance, times a quarter; how sharply it knew. */
static double jaxhil_bank_read(jaxhil_learnt *bank, int h, double depth, double rate, double force,
                               double variance, bool hidden, double zone, double *sharpness) {
    double(*covariance)[JAXHIL_COLUMNS] = bank->covariance[h];
    double *estimate = bank->estimate[h];
    double phi[JAXHIL_PARAMETERS], g[JAXHIL_COLUMNS] = {0.0}, scaled[JAXHIL_COLUMNS];
    const double x = depth - bank->supposed.offsets[h] * bank->pace * rate - bank->deeper[h];
    const bool lags = h >= JAXHIL_FIRST_LAG;
    const double read = hidden ? 0.0 : force;
    const double noise = hidden ? variance + zone * zone / 12.0 : variance;
    const double seen = hidden ? 0.5 * zone : force;
    if (x > bank->deepest[h]) {
        bank->deepest[h] = x;
    }
    jaxhil_bank_features(bank, h, x, rate, phi);
    if (lags) {
        jaxhil_bank_smooth(bank, h, x, rate, phi);
    }
    double expected = 0.0, s = 0.0;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        for (int j = 0; j < JAXHIL_COLUMNS; j++) {
            g[j] += covariance[i][j] * phi[i];
        }
    }
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        expected += phi[i] * estimate[i];
        s += phi[i] * g[i];
    }
    s = noise + s;
    const bool closes = rate > 0.0;
    const bool pushed = !lags || bank->pushed[h - JAXHIL_FIRST_LAG];
    const double within = lags ? 0.0 : (closes ? depth - bank->met_at : x - bank->within[h]);
    const bool inside = (lags || within > jaxhil_map_surface) && (!hidden || expected > zone);
    const bool nothing = !inside || (!closes && !(expected > 0.0));
    const double innovation = seen - expected;
    double wide = nothing ? noise : s;
    wide = wide > 0.0 ? wide : 1.0;
    const double missed = nothing ? read : innovation;
    *sharpness = sqrt(sqrt(wide > noise ? noise / wide : 1.0));
    if (inside && pushed && s > 0.0 &&
        (closes || expected > 0.0 || seen * seen > jaxhil_bank_beyond_noise * noise)) {
        const double share = 1.0 / s;
        bank->known[h] = noise * ((s - noise) * share);
        for (int j = 0; j < JAXHIL_COLUMNS; j++) {
            scaled[j] = share * g[j];
        }
        for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
            estimate[i] += scaled[i] * innovation;
            for (int j = 0; j < JAXHIL_COLUMNS; j++) {
                covariance[i][j] -= g[i] * scaled[j];
            }
        }
    }
    return 0.25 * (missed * missed) / wide;
}

/* One reading: depth [s] and speed as old as the force by the given delay, force [1/s], its variance [1/s^2], whether
 * the sensor's dead zone hides it, that zone [1/s]. */
static void jaxhil_learnt_read(jaxhil_learnt *bank, double depth, double rate, double deepest, double force,
                               double variance, bool hidden, double zone) {
    double surprise[JAXHIL_HYPOTHESES], sharpness[JAXHIL_HYPOTHESES], weights[JAXHIL_HYPOTHESES];
    double least = INFINITY;
    (void)deepest;
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        surprise[h] = jaxhil_bank_read(bank, h, depth, rate, force, variance, hidden, zone, &sharpness[h]);
        /* What is not a number stays. */
        if (surprise[h] < least || surprise[h] != surprise[h]) {
            least = surprise[h];
        }
    }
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const double likely = jaxhil_exponential(surprise[h] - least, JAXHIL_SQUARINGS);
        bank->likelihood[h] = bank->likelihood[h] * sharpness[h] * likely;
    }
    jaxhil_bank_shares(bank->likelihood, jaxhil_bank_least);
    bank->learning = true;
    jaxhil_bank_weigh(bank, weights);
    jaxhil_bank_conclude(bank, weights);
}
