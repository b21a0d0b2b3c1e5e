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

#include "contact_plane.c"
#include "entry.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "history.c"
#include "hypotheses.c"
#include "lagged_onset.c"
#include "onset.c"
#include "plausible_damping.c"
#include "reintegration.c"

/* == Declarations == */

/* Of each hypothesis by how much [s] it has the surface deeper than told, its knots [s], how likely it is
 * that the surface is there, map, deepest point, the likelihoods of this contact and of those before; how deep the
 * surface was met, `met_at` [s], and of each delay how deep by its own surface it was met, it was told, and it is by
 * its map, `within` [s]; sums over contacts of the damping's precision and of precision times mean, their number
 * `met`; whether this contact is to be added to them. The mean of the maps and, `shift` [s] and `below` [s], of the
 * delays and of how much deeper; the delays' standard deviation [s]; the largest weight of what may lie beyond,
 * `edge`, and that of all lags that are not told; the delay that was `given`. Of each lag what is kept after a tick of
 * what a sensor shows; what is smoothed, `held`, as it was before that, and whether the contact then pushed. */
typedef struct {
    double given, shift, open, edge, lagging, below, met, variance, pace, plane_spread, period;
    double kept[JAXHIL_LAGS];
    jaxhil_supposed supposed;
    double held[JAXHIL_LAGS][JAXHIL_PARAMETERS], before[JAXHIL_LAGS][JAXHIL_PARAMETERS];
    bool pushed[JAXHIL_LAGS];
    double known[JAXHIL_HYPOTHESES];
    jaxhil_force_depth_map prior, steady;
    double deeper[JAXHIL_HYPOTHESES], deepest[JAXHIL_HYPOTHESES];
    double knots[JAXHIL_HYPOTHESES][JAXHIL_SEGMENTS], likely[JAXHIL_HYPOTHESES];
    jaxhil_entry entry;
    double met_at, met_deeper[JAXHIL_FIRST_LAG], told[JAXHIL_FIRST_LAG], within[JAXHIL_FIRST_LAG];
    double likelihood[JAXHIL_HYPOTHESES], carried[JAXHIL_HYPOTHESES];
    double precision[JAXHIL_HYPOTHESES], weighted[JAXHIL_HYPOTHESES];
    double estimate[JAXHIL_HYPOTHESES][JAXHIL_PARAMETERS];
    double covariance[JAXHIL_HYPOTHESES][JAXHIL_PARAMETERS][JAXHIL_COLUMNS];
    jaxhil_curve curve;
    bool learning;
} jaxhil_learnt;

/* == Definitions == */

static const double jaxhil_misfit = 0.01; /* of a force, by which a map may be wrong */
static const double jaxhil_bank_broadening = 2.0;
static const double jaxhil_bank_least = 1e-200;
static const double jaxhil_bank_nothing = 1e-300; /* a smaller product is none: some machines keep such numbers */
static const double jaxhil_bank_least_carried = 1e-12;
static const double jaxhil_bank_least_shift = 1e-12; /* s: where nothing tells delays apart, rounding does not */
static const double jaxhil_bank_steady = 0.125; /* of the spread by which slopes wander, where they hardly do */
static const double jaxhil_bank_edge = 0.6;      /* probability of a farthest delay or the longest lag: it may lie beyond */
static const double jaxhil_bank_open = 0.0075;   /* of a restitution of 1, that what is open of the delay makes */
static const double jaxhil_bank_settled = 0.99;  /* probability from which on it is a lag */
static const double jaxhil_bank_beyond_noise = 9.0; /* times its variance: a force that is more than noise */
static const long jaxhil_bank_earlier = 30;  /* ticks before it was met, whose readings count */

/* Of their sum, at least so much. */
static void jaxhil_bank_shares(double *values, double least) {
    double total = 0.0;
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        values[h] = values[h] < jaxhil_bank_nothing ? 0.0 : values[h];
        total = h > 0 ? total + values[h] : values[h];
    }
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const double share = values[h] / total;
        values[h] = share > least ? share : least;
    }
}

static void jaxhil_bank_restart(jaxhil_learnt *bank) {
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const bool steady = h >= JAXHIL_DELAYS && h < JAXHIL_FIRST_LAG;
        const jaxhil_force_depth_map *prior = steady ? &bank->steady : &bank->prior;
        for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
            for (int j = 0; j < JAXHIL_COLUMNS; j++) {
                bank->covariance[h][i][j] = j < JAXHIL_PARAMETERS ? prior->covariance[i][j] : 0.0;
            }
            bank->estimate[h][i] = prior->estimate[i];
        }
        bank->deepest[h] = 0.0;
        bank->known[h] = 0.0;
        bank->likelihood[h] = 1.0;
    }
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
            bank->held[l][i] = 0.0;
            bank->before[l][i] = 0.0;
        }
        bank->pushed[l] = false;
    }
    bank->learning = false;
    bank->variance = 0.0;
}

static void jaxhil_learnt_reset(jaxhil_learnt *bank) {
    jaxhil_bank_restart(bank);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        bank->deeper[h] = 0.0;
        jaxhil_lagged_knots(0.0, bank->knots[h]);
        bank->likely[h] = 1.0;
        bank->carried[h] = h < JAXHIL_DELAYS ? 1.0 : 0.0;
        bank->precision[h] = 0.0;
        bank->weighted[h] = 0.0;
    }
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        bank->within[h] = 0.0;
    }
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        bank->carried[JAXHIL_FIRST_LAG + l] = bank->supposed.likely[l];
    }
    bank->met_at = 0.0;
    bank->met = 0.0;
    bank->shift = 0.0;
    bank->below = 0.0;
    bank->open = 0.0;
    bank->edge = 0.0;
    bank->lagging = 0.0;
    bank->pace = 1.0;
}

static void jaxhil_learnt_init(jaxhil_learnt *bank, const jaxhil_gains *gains) {
    jaxhil_gains steady = *gains;
    steady.prior_slope_spread = jaxhil_bank_steady * gains->prior_slope_spread;
    bank->given = gains->identification_delay;
    jaxhil_force_depth_map_init(&bank->prior, gains);
    jaxhil_force_depth_map_init(&bank->steady, &steady);
    jaxhil_suppose(&bank->supposed, gains);
    bank->period = gains->control_period;
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        bank->kept[l] = jaxhil_exponential(bank->period / bank->supposed.lags[l], JAXHIL_SQUARINGS);
    }
    bank->plane_spread = gains->plane_spread;
    bank->curve = bank->prior.curve;
    jaxhil_learnt_reset(bank);
}

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

/* Evidence of this contact, weighed by what is carried. Whether it is a lag only maps whose slopes wander decide, as
 * those of lags do: the sum over delays is what it would be if all were such. */
static void jaxhil_bank_weighed(const jaxhil_learnt *bank, const double *evidence, double *weights) {
    double total = 0.0, as_lags = 0.0;
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        weights[h] = bank->carried[h] * evidence[h];
    }
    for (int h = 0; h < JAXHIL_DELAYS; h++) {
        const double wandering = (bank->carried[h] + bank->carried[h + JAXHIL_DELAYS]) * evidence[h];
        as_lags = h > 0 ? as_lags + wandering : wandering;
    }
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        total = h > 0 ? total + weights[h] : weights[h];
    }
    const double ratio = as_lags / total;
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        weights[h] *= ratio;
    }
}

/* What the maps of delays say of the entry: where their surface is, and how likely. */
static void jaxhil_bank_enter(jaxhil_learnt *bank) {
    const jaxhil_entry *entry = &bank->entry;
    jaxhil_entered entered[JAXHIL_FIRST_LAG];
    double since[JAXHIL_FIRST_LAG][JAXHIL_BESIDE + 1], known[JAXHIL_FIRST_LAG][JAXHIL_BESIDE + 1];
    double began[JAXHIL_FIRST_LAG];
    double most = 0.0, greatest = 0.0, likeliest = -INFINITY;
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        entered[h] = jaxhil_entry_place(entry, bank->told[h], bank->estimate[h], bank->covariance[h]);
        bank->within[h] = jaxhil_entry_near(entry, entered[h].place);
        most = jaxhil_entry_since(entry, &entered[h], bank->met_deeper[h], most, since[h], known[h]);
    }
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        began[h] =
            jaxhil_entry_began(entry, &entered[h], bank->met_deeper[h], most, since[h], known[h], &greatest);
        likeliest = began[h] > likeliest || began[h] != began[h] ? began[h] : likeliest;
    }
    const double of_best = likeliest / greatest;
    const double together = sqrt(of_best > jaxhil_entry_least ? of_best : jaxhil_entry_least);
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        const double share = began[h] / likeliest;
        const double agreed = share > jaxhil_entry_least ? share : jaxhil_entry_least;
        bank->likely[h] = entry->level * (agreed * together * entered[h].there);
    }
}

/* Weights of the hypotheses; their sum is 1. */
static void jaxhil_bank_weigh(jaxhil_learnt *bank, double *weights) {
    const double pace = bank->pace;
    double evidence[JAXHIL_HYPOTHESES];
    double total = 0.0;
    jaxhil_bank_enter(bank);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const double own = bank->covariance[h][JAXHIL_DAMPING][JAXHIL_DAMPING] * (pace * pace);
        const double precision = 1.0 / (own > 0.0 ? own : 1.0);
        const double sum = bank->precision[h] + precision;
        const double mean = (bank->weighted[h] + precision * (bank->estimate[h][JAXHIL_DAMPING] * pace)) / sum;
        const double variance = jaxhil_bank_broadening * (bank->met + 1.0) / sum;
        double plausible = 1.0;
        if (own > 0.0) {
            plausible = jaxhil_plausible_damping(mean, variance, bank->prior.damping * (pace * pace));
            plausible = plausible > jaxhil_bank_least_carried ? plausible : jaxhil_bank_least_carried;
        }
        evidence[h] = bank->likelihood[h] * (plausible * bank->likely[h]);
    }
    jaxhil_bank_weighed(bank, evidence, weights);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        total = h > 0 ? total + weights[h] : weights[h];
    }
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        weights[h] = weights[h] / total;
    }
}

/* The mean of the maps, of the force at the usual knots. */
static void jaxhil_bank_average(jaxhil_learnt *bank, const double *weights) {
    jaxhil_curve *curve = &bank->curve;
    const int last = JAXHIL_SEGMENTS - 1;
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const double *slopes = bank->estimate[h];
        const double *knots = bank->knots[h];
        double reached = slopes[JAXHIL_PRELOAD];
        for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
            if (j > 0) {
                reached += slopes[j - 1] * (knots[j] - knots[j - 1]);
            }
            const double past = jaxhil_knots[j] - knots[j];
            const double force = weights[h] * (reached + past * (past < 0.0 ? slopes[j - 1] : slopes[j]));
            curve->at_knots[j] = h > 0 ? curve->at_knots[j] + force : force;
        }
        const double slope = weights[h] * slopes[last];
        curve->slopes[last] = h > 0 ? curve->slopes[last] + slope : slope;
    }
    for (int j = 0; j < last; j++) {
        curve->slopes[j] =
            (curve->at_knots[j + 1] - curve->at_knots[j]) / (jaxhil_knots[j + 1] - jaxhil_knots[j]);
    }
}

/* The mean over the hypotheses, by their weights: the delay, and what counts of the maps. */
static void jaxhil_bank_conclude(jaxhil_learnt *bank, const double *weights) {
    const jaxhil_supposed *supposed = &bank->supposed;
    jaxhil_curve *curve = &bank->curve;
    double lost[4] = {0.0, 0.0, 0.0, 0.0};
    double shift = 0.0, square = 0.0, lagging = 0.0;
    jaxhil_bank_average(bank, weights);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        for (int k = 0; k < 4; k++) {
            const int place = JAXHIL_SEGMENTS + k;
            const double mean =
                jaxhil_positive_mean(bank->estimate[h][place], bank->covariance[h][place][place]) * weights[h];
            lost[k] = h > 0 ? lost[k] + mean : mean;
        }
        const double delay = weights[h] * supposed->older[h];
        const double known = weights[h] * bank->known[h];
        shift = h > 0 ? shift + delay : delay;
        const double below = weights[h] * bank->deeper[h];
        bank->below = h > 0 ? bank->below + below : below;
        bank->variance = h > 0 ? bank->variance + known : known;
    }
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const double off = supposed->older[h] - shift;
        square += weights[h] * (off * off);
        lagging += h < supposed->untold ? 0.0 : weights[h];
    }
    /* Between two lags neither is right. */
    bank->lagging = lagging;
    bank->open = sqrt(square + 0.5 * (supposed->lag_step * supposed->lag_step) * lagging);
    bank->edge = weights[JAXHIL_HYPOTHESES - 1];
    for (int h = 0; h < JAXHIL_DELAYS; h += JAXHIL_DELAYS - 1) {
        double farthest = weights[h] + weights[h + JAXHIL_DELAYS];
        if (supposed->untold > JAXHIL_FIRST_LAG) {
            farthest += weights[h == 0 ? JAXHIL_FIRST_LAG : supposed->untold - 1];
        }
        bank->edge = farthest > bank->edge ? farthest : bank->edge;
    }
    bank->shift = shift > jaxhil_bank_least_shift || shift < -jaxhil_bank_least_shift ? shift : 0.0;
    curve->damping = lost[0];
    curve->depth_damping = lost[1];
    curve->unloading = lost[2];
    curve->friction = lost[3];
}

/* The contact that is over is added to what is carried. */
static void jaxhil_bank_finish(jaxhil_learnt *bank) {
    const double pace = bank->pace;
    double evidence[JAXHIL_HYPOTHESES], weights[JAXHIL_HYPOTHESES];
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        evidence[h] = h < JAXHIL_FIRST_LAG ? bank->likelihood[h] * bank->likely[h] : bank->likelihood[h];
    }
    /* Only where the first contact is over its slopes tell how they are. */
    for (int h = 0; h < JAXHIL_FIRST_LAG && !(bank->met > 0.0); h++) {
        bank->carried[h] = 0.5;
    }
    jaxhil_bank_weighed(bank, evidence, weights);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        bank->carried[h] = weights[h];
        const double variance = bank->covariance[h][JAXHIL_DAMPING][JAXHIL_DAMPING] * (pace * pace);
        const double precision = 1.0 / (variance > 0.0 ? variance : 1.0);
        bank->precision[h] = bank->precision[h] + precision;
        bank->weighted[h] = bank->weighted[h] + precision * (bank->estimate[h][JAXHIL_DAMPING] * pace);
    }
    jaxhil_bank_shares(bank->carried, jaxhil_bank_least_carried);
    bank->met += 1.0;
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
