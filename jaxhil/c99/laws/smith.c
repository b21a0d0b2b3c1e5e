/* What the Smith predictor and its mean with phase lead share: two filters, each by Tustin's rule, the lead
 * 1 + T_l s, T_l = phase_lead, filtered with lead_filter as in phase lead, and behind it the prediction
 * 1 + T_s s/(1 + T_s s/2), T_s = simulator_lag.
 */
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"

/* == Declarations == */

typedef struct {
    jaxhil_lead_filter lead, predictor;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    const double lag = gains->simulator_lag;
    jaxhil_lead_filter_init(&law->lead, gains->phase_lead, gains->lead_filter, gains->control_period);
    jaxhil_lead_filter_init(&law->predictor, lag, 0.5 * lag, gains->control_period);
    return true;
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
    jaxhil_lead_filter_reset(&law->predictor);
}
