/* Hypotheses of the force delay side by side, each with a map of its own, weighed by what they explain.
 * Hypothesis h takes the force to be d_h older than given: it belongs to the depth X - d_h V. It expects to read
 * f_h with a variance s_h (0 with the noise's own variance r out of contact, and where what it expects while the
 * contact opens is not positive). Its weight is the product of the likelihoods of all readings of this contact and
 * of those before, (r/s_h)^(1/4) exp(-(y - f_h)^2/(4 s_h)), and of how well its damping, of mean B and variance s^2,
 * goes with what is known of contacts: p (s_0/s) exp(-t^2/2) + (1 - p) 2 Phi(t), t = B/s, p = 1/3. The exponentials
 * are (1 + u/n)^-n. What counts is the mean over all hypotheses, of their maps and of their delays.
 */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"
#include "gains_table.c"

/* == Declarations == */

enum { JAXHIL_HYPOTHESES = 17 };

/* Of each hypothesis its delay, map, deepest point, the likelihoods of this contact and of those before; sums over
 * these of the damping's precision and of precision times mean, their number `met`; whether this contact is to be
 * added to them. The mean of the maps and, `shift` [s], of the delays; the delay that was `given`. */
typedef struct {
    double given, shift, met, variance;
    double known[JAXHIL_HYPOTHESES];
    jaxhil_force_depth_map prior;
    double offsets[JAXHIL_HYPOTHESES], deepest[JAXHIL_HYPOTHESES];
    double likelihood[JAXHIL_HYPOTHESES], carried[JAXHIL_HYPOTHESES];
    double precision[JAXHIL_HYPOTHESES], weighted[JAXHIL_HYPOTHESES];
    double estimate[JAXHIL_HYPOTHESES][JAXHIL_PARAMETERS];
    double covariance[JAXHIL_HYPOTHESES][JAXHIL_PARAMETERS][JAXHIL_PARAMETERS];
    jaxhil_curve curve;
    bool learning;
} jaxhil_learnt;

/* == Definitions == */

static const double jaxhil_bank_elastic = 1.0 / 3.0;
static const double jaxhil_bank_broadening = 2.0;
static const double jaxhil_bank_least = 1e-200;
static const double jaxhil_bank_nothing = 1e-300; /* a smaller product is none: some machines keep such numbers */
static const double jaxhil_bank_least_carried = 1e-12;
static const double jaxhil_bank_least_shift = 1e-12; /* s: where nothing tells delays apart, rounding does not */
enum { JAXHIL_SQUARINGS = 10, JAXHIL_DENSITY_SQUARINGS = 8, JAXHIL_DAMPING = JAXHIL_SEGMENTS };

/* (1 + u/n)^-n, n = 2^squarings. */
static double jaxhil_bank_exponential(double u, int squarings) {
    double value = 1.0 / (1.0 + u / (double)(1L << squarings));
    for (int i = 0; i < squarings; i++) {
        value = value * value;
    }
    return value;
}

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
        for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
            for (int j = 0; j < JAXHIL_PARAMETERS; j++) {
                bank->covariance[h][i][j] = bank->prior.covariance[i][j];
            }
            bank->estimate[h][i] = bank->prior.estimate[i];
        }
        bank->deepest[h] = 0.0;
        bank->known[h] = 0.0;
        bank->likelihood[h] = 1.0;
    }
    bank->learning = false;
    bank->variance = 0.0;
}

static void jaxhil_learnt_reset(jaxhil_learnt *bank) {
    jaxhil_bank_restart(bank);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        bank->carried[h] = 1.0;
        bank->precision[h] = 0.0;
        bank->weighted[h] = 0.0;
    }
    bank->met = 0.0;
    bank->shift = 0.0;
}

static void jaxhil_learnt_init(jaxhil_learnt *bank, const jaxhil_gains *gains) {
    bank->given = gains->identification_delay;
    jaxhil_force_depth_map_init(&bank->prior, gains);
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        bank->offsets[h] = (0.125 * (double)h - 1.0) * gains->delay_spread;
    }
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        bank->curve.slopes[j] = 0.0;
        bank->curve.at_knots[j] = 0.0;
    }
    bank->curve.damping = 0.0;
    bank->curve.depth_damping = 0.0;
    bank->curve.unloading = 0.0;
    jaxhil_learnt_reset(bank);
}

/* A contact begins: the one before is added to what is carried, and the maps are the prior. */
static void jaxhil_learnt_begin(jaxhil_learnt *bank) {
    if (bank->learning) {
        for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
            const double variance = bank->covariance[h][JAXHIL_DAMPING][JAXHIL_DAMPING];
            const double precision = 1.0 / (variance > 0.0 ? variance : 1.0);
            bank->carried[h] = bank->carried[h] * bank->likelihood[h];
            bank->precision[h] = bank->precision[h] + precision;
            bank->weighted[h] = bank->weighted[h] + precision * bank->estimate[h][JAXHIL_DAMPING];
        }
        jaxhil_bank_shares(bank->carried, jaxhil_bank_least_carried);
        bank->met += 1.0;
    }
    jaxhil_bank_restart(bank);
}

/* Variance [1/s^2] of the force that is expected where it was read last. */
static double jaxhil_learnt_variance(const jaxhil_learnt *bank) {
    return bank->variance;
}

static const jaxhil_curve *jaxhil_learnt_curve(const jaxhil_learnt *bank) {
    return &bank->curve;
}

static double jaxhil_learnt_shift(const jaxhil_learnt *bank) {
    return bank->shift;
}

/* How much better a damping N(mean, variance) goes with one that is 0 or not negative than one N(0, prior) does. */
static double jaxhil_bank_plausibility(double mean, double variance, double prior) {
    const double spread = sqrt(variance);
    const double ratio = mean / spread;
    const double density = jaxhil_bank_exponential(0.5 * (ratio * ratio), JAXHIL_DENSITY_SQUARINGS);
    const double size = fabs(ratio);
    const double mills =
        jaxhil_map_pi / ((jaxhil_map_pi - 1.0) * size + sqrt(size * size + 2.0 * jaxhil_map_pi));
    const double beyond = density * mills * (2.0 / sqrt(2.0 * jaxhil_map_pi));
    const double at_least_0 = ratio > 0.0 ? 2.0 - beyond : beyond;
    const double known = sqrt(prior > 0.0 ? prior : 1.0);
    return jaxhil_bank_elastic * (known / spread) * density + (1.0 - jaxhil_bank_elastic) * at_least_0;
}

/* Weights of the hypotheses; their sum is 1. */
static void jaxhil_bank_weigh(const jaxhil_learnt *bank, double *weights) {
    double total = 0.0;
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        const double own = bank->covariance[h][JAXHIL_DAMPING][JAXHIL_DAMPING];
        const double precision = 1.0 / (own > 0.0 ? own : 1.0);
        const double sum = bank->precision[h] + precision;
        const double mean = (bank->weighted[h] + precision * bank->estimate[h][JAXHIL_DAMPING]) / sum;
        const double variance = jaxhil_bank_broadening * (bank->met + 1.0) / sum;
        double plausible = 1.0;
        if (own > 0.0) {
            plausible = jaxhil_bank_plausibility(mean, variance, bank->prior.damping);
            plausible = plausible > jaxhil_bank_least_carried ? plausible : jaxhil_bank_least_carried;
        }
        weights[h] = bank->likelihood[h] * bank->carried[h] * plausible;
        total = h > 0 ? total + weights[h] : weights[h];
    }
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        weights[h] = weights[h] / total;
    }
}

/* The mean over the hypotheses, by their weights: the delay, and what counts of the maps. */
static void jaxhil_bank_conclude(jaxhil_learnt *bank, const double *weights) {
    jaxhil_curve *curve = &bank->curve;
    double lost[3] = {0.0, 0.0, 0.0};
    double reached = 0.0;
    double shift = 0.0;
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        double slope = bank->estimate[0][j] * weights[0];
        for (int h = 1; h < JAXHIL_HYPOTHESES; h++) {
            slope += bank->estimate[h][j] * weights[h];
        }
        if (j > 0) {
            reached += curve->slopes[j - 1] * (jaxhil_knots[j] - jaxhil_knots[j - 1]);
        }
        curve->slopes[j] = slope;
        curve->at_knots[j] = reached;
    }
    for (int h = 0; h < JAXHIL_HYPOTHESES; h++) {
        for (int k = 0; k < 3; k++) {
            const int place = JAXHIL_SEGMENTS + k;
            const double mean =
                jaxhil_positive_mean(bank->estimate[h][place], bank->covariance[h][place][place]) * weights[h];
            lost[k] = h > 0 ? lost[k] + mean : mean;
        }
        const double delay = weights[h] * bank->offsets[h];
        const double known = weights[h] * bank->known[h];
        shift = h > 0 ? shift + delay : delay;
        bank->variance = h > 0 ? bank->variance + known : known;
    }
    bank->shift = shift > jaxhil_bank_least_shift || shift < -jaxhil_bank_least_shift ? shift : 0.0;
    curve->damping = lost[0];
    curve->depth_damping = lost[1];
    curve->unloading = lost[2];
}

/* Hypothesis h reads: the square of what it missed, over its variance, times a quarter; how sharply it knew. */
static double jaxhil_bank_read(jaxhil_learnt *bank, int h, double depth, double rate, double force,
                               double variance, bool hidden, double zone, double *sharpness) {
    double(*covariance)[JAXHIL_PARAMETERS] = bank->covariance[h];
    double *estimate = bank->estimate[h];
    double phi[JAXHIL_PARAMETERS], g[JAXHIL_PARAMETERS];
    const double deeper = depth - bank->offsets[h] * rate;
    const double read = hidden ? 0.0 : force;
    const double noise = hidden ? variance + zone * zone / 12.0 : variance;
    const double seen = hidden ? 0.5 * zone : force;
    if (deeper > bank->deepest[h]) {
        bank->deepest[h] = deeper;
    }
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        const double beyond = deeper - jaxhil_knots[j];
        phi[j] = beyond > 0.0 ? beyond : 0.0;
        if (j < JAXHIL_SEGMENTS - 1 && beyond > jaxhil_knots[j + 1] - jaxhil_knots[j]) {
            phi[j] = jaxhil_knots[j + 1] - jaxhil_knots[j];
        }
    }
    phi[12] = rate;
    phi[13] = deeper * rate / jaxhil_map_reach;
    phi[14] = deeper - bank->deepest[h];
    double expected = 0.0;
    double s = 0.0;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        double product = 0.0;
        for (int j = 0; j < JAXHIL_PARAMETERS; j++) {
            product += covariance[i][j] * phi[j];
        }
        g[i] = product;
        expected += phi[i] * estimate[i];
        s += phi[i] * product;
    }
    s = noise + s;
    const bool inside = deeper > jaxhil_map_surface && (!hidden || expected > zone);
    const bool closes = rate > 0.0;
    const bool nothing = !inside || (!closes && !(expected > 0.0));
    const double innovation = seen - expected;
    double wide = nothing ? noise : s;
    wide = wide > 0.0 ? wide : 1.0;
    const double missed = nothing ? read : innovation;
    *sharpness = sqrt(sqrt(wide > noise ? noise / wide : 1.0));
    if (inside && s > 0.0 &&
        (closes || expected > 0.0 || seen * seen > jaxhil_map_outlying * noise)) {
        const double share = 1.0 / s;
        bank->known[h] = noise * ((s - noise) * share);
        for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
            const double scaled = share * g[i];
            estimate[i] += scaled * innovation;
            for (int j = 0; j < JAXHIL_PARAMETERS; j++) {
                covariance[i][j] -= scaled * g[j];
            }
        }
    }
    return 0.25 * (missed * missed) / wide;
}

/* One reading: depth [s] and speed as old as the force by the given delay, force [1/s], its variance [1/s^2], whether the
 * sensor's dead zone hides it, that zone [1/s]. */
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
        const double likely = jaxhil_bank_exponential(surprise[h] - least, JAXHIL_SQUARINGS);
        bank->likelihood[h] = bank->likelihood[h] * sharpness[h] * likely;
    }
    jaxhil_bank_shares(bank->likelihood, jaxhil_bank_least);
    bank->learning = true;
    jaxhil_bank_weigh(bank, weights);
    jaxhil_bank_conclude(bank, weights);
}
