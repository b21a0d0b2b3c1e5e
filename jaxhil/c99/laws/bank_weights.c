/* What the hypotheses of delay_bank.c weigh, and the mean of their maps by these weights. */
#include <math.h>

#include "bank.c"
#include "entry.c"
#include "force_depth_map.c"
#include "hypotheses.c"
#include "plausible_damping.c"

/* == Definitions == */

static const double jaxhil_bank_broadening = 2.0;
static const double jaxhil_bank_nothing = 1e-300; /* a smaller product is none: some machines keep such numbers */
static const double jaxhil_bank_least_carried = 1e-12;
static const double jaxhil_bank_least_shift = 1e-12; /* s: where nothing tells delays apart, rounding does not */

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
