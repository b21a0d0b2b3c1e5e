/* Response-error force compensation with real-time identification of the contact:
 * F_c = y + gate (g k (x_d - x_m) + g_b b (v_d - v_m)), y the phase-led force, k and b identified.
 *
 * Source: Qi, Zhao, Gao, Ren, Hu, "Divergence compensation for hardware-in-the-loop simulation of
 * stiffness-varying discrete contact in space", Acta Astronautica 2016, and later papers of that group.
 */
#include <math.h>
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"
#include "gates.c"
#include "identification.c"
#include "surfaces.c"

/* == Declarations == */

typedef struct {
    double period, clearance, threshold, response_error, response_error_damping;
    jaxhil_lead_filter lead;
    jaxhil_velocity_filter velocity, aligned_velocity;
    jaxhil_delay_line alignment;
    jaxhil_identification identification;
    double aligned, force, contact_share, force_share;
    bool started;
    double samples[JAXHIL_IDENTIFICATION_DELAY_SAMPLES];
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    const double period = gains->control_period;
    law->period = period;
    law->clearance = gains->clearance;
    law->threshold = gains->contact_threshold;
    law->response_error = gains->response_error;
    law->response_error_damping = gains->response_error_damping;
    jaxhil_lead_filter_init(&law->lead, gains->phase_lead, gains->lead_filter, period);
    jaxhil_velocity_filter_init(&law->velocity, gains->velocity_filter, period);
    jaxhil_velocity_filter_init(&law->aligned_velocity, gains->velocity_filter, period);
    jaxhil_identification_init(&law->identification, gains->initial_stiffness, gains->initial_damping,
                               gains->stiffness_covariance, gains->damping_covariance, gains->forgetting);
    law->aligned = 0.0;
    law->force = 0.0;
    law->contact_share = 0.0;
    law->force_share = 0.0;
    law->started = false;
    return jaxhil_delay_line_init(&law->alignment, law->samples, JAXHIL_IDENTIFICATION_DELAY_SAMPLES,
                                  gains->identification_delay, period);
}

/* Before the first tick the motion is uniform, so every filter begins in steady state. */
static void jaxhil_law_start(jaxhil_law *law, double position, double velocity) {
    jaxhil_delay_line_start(&law->alignment, law->samples, position, velocity);
    jaxhil_velocity_filter_start(&law->velocity, position, velocity);
    const double aligned = jaxhil_delay_line_step(&law->alignment, law->samples, position);
    jaxhil_velocity_filter_start(&law->aligned_velocity, aligned, velocity);
    law->aligned = aligned - law->period * velocity;
    /* That step only asked for the aligned position: the tick itself takes the sample in. */
    jaxhil_delay_line_start(&law->alignment, law->samples, position, velocity);
    law->force = 0.0;
    law->contact_share = 0.0;
    law->force_share = 0.0;
    law->started = true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    if (!law->started) {
        jaxhil_law_start(law, position_measured, velocity_desired);
    }
    const double force = jaxhil_lead_filter_step(&law->lead, force_measured);
    const double velocity_measured = jaxhil_velocity_filter_step(&law->velocity, position_measured);
    const double aligned = jaxhil_delay_line_step(&law->alignment, law->samples, position_measured);
    const double aligned_velocity = jaxhil_velocity_filter_step(&law->aligned_velocity, aligned);

    const double aligned_before = law->aligned;
    const double deflection = jaxhil_deflection(aligned, law->clearance);
    const double contact_share =
        jaxhil_share_beyond(deflection, jaxhil_deflection(aligned_before, law->clearance), aligned - aligned_before);
    const double contact_gate = jaxhil_gate(contact_share, law->contact_share);
    const double threshold = law->threshold;
    const double size = fabs(force_measured);
    const double size_before = law->force;
    const double force_share =
        jaxhil_share_beyond(size > threshold ? size - threshold : 0.0,
                            size_before > threshold ? size_before - threshold : 0.0, size - size_before);
    const double force_gate = jaxhil_gate(force_share, law->force_share);
    law->aligned = aligned;
    law->force = size;
    law->contact_share = contact_share;
    law->force_share = force_share;

    if (contact_gate == 0.0) {
        return force;
    }
    jaxhil_identification *identification = &law->identification;
    if (force_gate != 0.0 && !jaxhil_identification_update(identification, force_measured, deflection,
                                                           aligned_velocity, contact_gate * force_gate)) {
        return NAN;
    }
    return force +
           contact_gate *
               (law->response_error * identification->stiffness * (position_desired - position_measured) +
                law->response_error_damping * identification->damping *
                    (velocity_desired - velocity_measured));
}

#define JAXHIL_LAW_HAS_IDENTIFIED
static void jaxhil_law_identified(const jaxhil_law *law, double *stiffness, double *damping) {
    *stiffness = law->identification.stiffness;
    *damping = law->identification.damping;
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
    jaxhil_identification_reset(&law->identification);
    law->started = false;
}

#define JAXHIL_LAW_HAS_NEXT_CONTACT
static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_lead_filter_reset(&law->lead);
    jaxhil_identification_restart_covariance(&law->identification);
    law->started = false;
}
