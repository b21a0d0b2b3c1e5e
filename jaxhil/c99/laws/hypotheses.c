/* Which delays and lags of the force sensor the bank of delays supposes.
 *
 * 17 delays lie evenly within `delay_spread` of the given one; each is there twice, by slopes that wander and by slopes
 * that hardly do. Where no lag is told, as many hypotheses have the given delay and a lag of 0.25, 0.5, .. 4.25 ms. A
 * lag l that is told is part of the given delay: then nine have the lag l, and a transport delay evenly within
 * `delay_spread` of what is left of the given one, together as likely as all delays, and eight lag by 0.5, 1, .. 4 ms
 * more.
 */
#include <stdbool.h>

#include "gains_table.c"

/* == Declarations == */

/* Each delay by slopes that wander, then by steady ones; then the lags, those that are as told, where one is, first. */
enum {
    JAXHIL_DELAYS = 17,
    JAXHIL_LAGS = 17,
    JAXHIL_FIRST_LAG = 2 * JAXHIL_DELAYS,
    JAXHIL_HYPOTHESES = JAXHIL_FIRST_LAG + JAXHIL_LAGS,
    JAXHIL_AS_TOLD = 9
};

/* By each hypothesis how much older the force is than given [s], but for its lag, `offsets`, and to first order with
 * it; the lags [s]; of each lag what is carried, in terms of a delay; from lag to lag [s]; the first hypothesis of a
 * lag that is not told. */
typedef struct {
    double offsets[JAXHIL_HYPOTHESES], older[JAXHIL_HYPOTHESES], lags[JAXHIL_LAGS], likely[JAXHIL_LAGS], lag_step;
    int untold;
} jaxhil_supposed;

/* == Definitions == */

static const double jaxhil_lag_step = 0.00025;    /* s from lag to lag, */
static const double jaxhil_longer_step = 0.0005;  /* and where one is told */
static const double jaxhil_least_lag = 1e-6;      /* s: a shorter one is none */
static const double jaxhil_lagging = 0.0001; /* of a delay's probability, that of each lag that is not told */

static void jaxhil_suppose(jaxhil_supposed *supposed, const jaxhil_gains *gains) {
    const double told = gains->sensor_lag;
    for (int h = 0; h < JAXHIL_FIRST_LAG; h++) {
        supposed->offsets[h] = (0.125 * (double)(h % JAXHIL_DELAYS) - 1.0) * gains->delay_spread;
        supposed->older[h] = supposed->offsets[h];
    }
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        const double place = (double)l, last = (double)JAXHIL_AS_TOLD;
        double offset = 0.0, lag = jaxhil_lag_step * (place + 1.0), likely = jaxhil_lagging;
        if (told > jaxhil_least_lag && l < JAXHIL_AS_TOLD) {
            offset = (0.25 * place - 1.0) * gains->delay_spread - told;
            lag = told;
            likely = (double)JAXHIL_DELAYS / last;
        } else if (told > jaxhil_least_lag) {
            offset = -told;
            lag = told + jaxhil_longer_step * (place - (last - 1.0));
            likely = jaxhil_longer_step / jaxhil_lag_step * jaxhil_lagging;
        }
        supposed->offsets[JAXHIL_FIRST_LAG + l] = offset;
        supposed->older[JAXHIL_FIRST_LAG + l] = offset + lag;
        supposed->lags[l] = lag;
        supposed->likely[l] = likely;
    }
    supposed->lag_step = told > jaxhil_least_lag ? jaxhil_longer_step : jaxhil_lag_step;
    supposed->untold = told > jaxhil_least_lag ? JAXHIL_FIRST_LAG + JAXHIL_AS_TOLD : JAXHIL_FIRST_LAG;
}
