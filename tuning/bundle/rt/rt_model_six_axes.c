/* Controller and numerical model with six axes: two free rigid bodies, target and chaser. */
#include "rt_model.h"

#include <string.h>

#include "jaxhil_gains.h"
#include "numerical_model.h"

#define MAX_NORM_ERROR 1e-6 /* largest difference of a start's quaternion from norm 1 */

jaxhil_controller rt_controller;
rt_motion rt_model;
static const rigid_body bodies[2] = BODIES;
static numerical_model model;

static void copy_motion(void) {
    memcpy(rt_model.position, model.pose, sizeof model.pose);
    memcpy(rt_model.velocity, model.twist, sizeof model.twist);
}

bool rt_init(void) {
    return jaxhil_init(&rt_controller, &jaxhil_exported_gains, &jaxhil_exported_limits,
                       &jaxhil_exported_constants);
}

bool rt_tare(const double *force) { return jaxhil_tare(&rt_controller, force); }

void rt_bias(double *bias) { jaxhil_bias(&rt_controller, bias); }

static void command_pose(void) {
    jaxhil_pose_command(&rt_controller, rt_model.position, rt_model.velocity, rt_model.command);
}

bool rt_place(const double *start) {
    body_state given[2];
    bool is_usable = true;
    for (int n = 0; n < START_VALUES; n++) {
        is_usable = is_usable && isfinite(start[n]);
    }
    memcpy(given, start, sizeof given);
    for (int n = 0; n < 2; n++) {
        const double w = given[n].attitude[0], vector = norm3(given[n].attitude + 1);
        is_usable = is_usable && fabs(sqrt(w * w + vector * vector) - 1.0) <= MAX_NORM_ERROR;
    }
    if (is_usable) {
        memcpy(model.bodies, given, sizeof given);
        observe_model(bodies, &model);
        copy_motion();
    }
    return is_usable;
}

void rt_begin(void) {
    memset(rt_model.force, 0, sizeof rt_model.force);
    command_pose();
}

void rt_tick(const double *force, const double *position, double time, bool is_first) {
    (void)is_first;
    jaxhil_step(&rt_controller, force, rt_model.position, rt_model.velocity, position, &time, rt_model.force);
    rt_coast();
    command_pose();
}

void rt_coast(void) {
    move_model(bodies, VELOCITY_SHARE, PERIOD, rt_model.force, &model);
    copy_motion();
}

/* The rates of the rotation vector theta are a power series with an error of |theta|^4/720. */
void rt_rate(double *rate) {
    const double *const angular = rt_model.velocity + 3;
    double once[3], twice[3];
    cross(rt_model.position + 3, angular, once);
    cross(rt_model.position + 3, once, twice);
    for (int n = 0; n < 3; n++) {
        rate[n] = rt_model.velocity[n];
        rate[n + 3] = angular[n] - once[n] / 2 + twice[n] / 12;
    }
}

size_t rt_bodies(double *values) {
    memcpy(values, model.bodies, sizeof model.bodies);
    return START_VALUES;
}
