/* Controller and numerical model with one axis. */
#include "rt_model.h"

#include "jaxhil_gains.h"

jaxhil_controller rt_controller;
rt_motion rt_model;
static double acceleration;

bool rt_init(void) { return jaxhil_init(&rt_controller, &jaxhil_exported_gains, &jaxhil_exported_limits); }

bool rt_tare(const double *force) { return jaxhil_tare(&rt_controller, *force); }

void rt_bias(double *bias) { *bias = jaxhil_bias(&rt_controller); }

static void command_position(void) {
    *rt_model.command =
        jaxhil_position_command(&rt_controller, *rt_model.position, *rt_model.velocity, acceleration);
}

bool rt_place(const double *start) {
    const bool is_given = isfinite(start[0]) && isfinite(start[1]);
    *rt_model.position = is_given ? start[0] : START_POSITION;
    *rt_model.velocity = is_given ? start[1] : START_VELOCITY;
    acceleration = 0.0;
    return true;
}

void rt_begin(void) {
    *rt_model.force = 0.0;
    command_position();
}

void rt_tick(const double *force, const double *position, double time, bool is_first) {
    *rt_model.force =
        jaxhil_step(&rt_controller, *force, *rt_model.position, *rt_model.velocity, *position, &time);
    if (HAS_NOISE_OR_BIAS && is_first) {
        *rt_model.force = 0.0; /* the mechanism is free: noise must not act on the model */
    }
    rt_coast();
    command_position();
}

void rt_coast(void) {
    const double before = *rt_model.velocity;
    acceleration = -*rt_model.force / EQUIVALENT_MASS;
    *rt_model.velocity = before + PERIOD * acceleration;
    *rt_model.position += MODEL_STEP(before, acceleration, *rt_model.velocity);
}

void rt_rate(double *rate) { *rate = *rt_model.velocity; }

size_t rt_bodies(double *bodies) {
    (void)bodies;
    return 0;
}
