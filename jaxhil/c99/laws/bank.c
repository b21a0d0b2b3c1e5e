/* What the hypotheses of delay_bank.c know. */
#include <stdbool.h>

#include "entry.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "hypotheses.c"
#include "lagged_onset.c"
#include "onset.c"

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

static const double jaxhil_bank_steady = 0.125; /* of the spread by which slopes wander, where they hardly do */

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
