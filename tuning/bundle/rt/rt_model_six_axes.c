/* Controller and numerical model with six axes: two free rigid bodies, target and chaser.
 *
 * The numerical model has the equations of numerical_model_six_axes.py, in the same order of operations, so that
 * the results are the same bit for bit. Quaternions are (w, x, y, z).
 */
#include "rt_model.h"

#include <string.h>

#include "jaxhil_gains.h"

#define MAX_NORM_ERROR 1e-6 /* largest difference of a start's quaternion from norm 1 */
#define MAX_ANGLE 1e6       /* rad; larger rotations in a period give NaN */

typedef struct {
    double mass, inverse_inertia[3][3]; /* [kg]; in body axes [1/(kg m^2)] */
    double interface[3], interface_attitude[4]; /* origin [m] and axes of the interface frame, in body axes */
} rigid_body;

typedef struct {
    double position[3], velocity[3]; /* of the centre of mass, in world axes [m], [m/s] */
    double attitude[4], spin[3];     /* from body to world axes; angular momentum [kg m^2/s] */
} body_state;

typedef struct {
    double origin[3], attitude[4], velocity[3], angular[3]; /* in world axes */
} frame_motion;

jaxhil_controller rt_controller;
rt_motion rt_model;
static const rigid_body bodies[2] = BODIES; /* target, chaser */
static body_state states[2];

static void add(const double *left, double factor, const double *right, double *sum) {
    for (int n = 0; n < 3; n++) {
        sum[n] = left[n] + factor * right[n];
    }
}

static void cross(const double *left, const double *right, double *product) {
    const double a = left[0], b = left[1], c = left[2], x = right[0], y = right[1], z = right[2];
    product[0] = b * z - c * y;
    product[1] = c * x - a * z;
    product[2] = a * y - b * x;
}

static void reverse(const double *rotation, double *reversed) {
    reversed[0] = rotation[0];
    for (int n = 1; n < 4; n++) {
        reversed[n] = -rotation[n];
    }
}

/* Compute the product of two rotations: `first`, followed by `second`. */
static void compose(const double *second, const double *first, double *product) {
    const double a = second[0], x = second[1], y = second[2], z = second[3];
    const double b = first[0], u = first[1], v = first[2], w = first[3];
    product[0] = a * b - x * u - y * v - z * w;
    product[1] = a * u + b * x + y * w - z * v;
    product[2] = a * v + b * y + z * u - x * w;
    product[3] = a * w + b * z + x * v - y * u;
}

static void rotate(const double *rotation, const double *vector, double *rotated) {
    double along[3], twice[3];
    cross(rotation + 1, vector, along);
    for (int n = 0; n < 3; n++) {
        along[n] *= 2.0;
    }
    cross(rotation + 1, along, twice);
    for (int n = 0; n < 3; n++) {
        rotated[n] = vector[n] + rotation[0] * along[n] + twice[n];
    }
}

static double norm3(const double *vector) {
    return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
}

/* Convert a rotation vector [rad] to a quaternion. */
static void exponential(const double *theta, double *rotation) {
    const double angle = norm3(theta);
    if (!(angle < MAX_ANGLE)) {
        rotation[0] = rotation[1] = rotation[2] = rotation[3] = NAN;
        return;
    }
    const double scale = angle > 0.0 ? sin(angle / 2) / angle : 0.5;
    rotation[0] = cos(angle / 2);
    for (int n = 0; n < 3; n++) {
        rotation[n + 1] = scale * theta[n];
    }
}

/* Convert a quaternion to its rotation vector [rad], with a norm of at most pi. */
static void logarithm(const double *rotation, double *theta) {
    const double sign = rotation[0] >= 0.0 ? 1.0 : -1.0, sine = norm3(rotation + 1);
    const double scale = sine > 0.0 ? 2.0 * atan2(sine, sign * rotation[0]) / sine : 2.0;
    for (int n = 0; n < 3; n++) {
        theta[n] = scale * (sign * rotation[n + 1]);
    }
}

/* Compute a body's angular velocity from its angular momentum, in body axes. */
static void angular_velocity(const rigid_body *body, const double *attitude, const double *spin, double *angular) {
    double back[4], inner[3];
    reverse(attitude, back);
    rotate(back, spin, inner);
    for (int n = 0; n < 3; n++) {
        const double *const row = body->inverse_inertia[n];
        angular[n] = row[0] * inner[0] + row[1] * inner[1] + row[2] * inner[2];
    }
}

static frame_motion interface_motion(const rigid_body *body, const body_state *state) {
    frame_motion frame;
    double inner[3], offset[3], turning[3];
    angular_velocity(body, state->attitude, state->spin, inner);
    rotate(state->attitude, inner, frame.angular);
    rotate(state->attitude, body->interface, offset);
    add(state->position, 1.0, offset, frame.origin);
    compose(state->attitude, body->interface_attitude, frame.attitude);
    cross(frame.angular, offset, turning);
    add(state->velocity, 1.0, turning, frame.velocity);
    return frame;
}

/* Compute pose and twist of the chaser's interface frame C relative to the target's frame T. */
static void observe(void) {
    const frame_motion target = interface_motion(&bodies[0], &states[0]);
    const frame_motion chaser = interface_motion(&bodies[1], &states[1]);
    double apart[3], back[4], relative[4], turning[3], linear[3], angular[3];
    add(chaser.origin, -1.0, target.origin, apart);
    reverse(target.attitude, back);
    rotate(back, apart, rt_model.position);
    compose(back, chaser.attitude, relative);
    logarithm(relative, rt_model.position + 3);
    cross(target.angular, apart, turning);
    add(chaser.velocity, -1.0, target.velocity, linear);
    add(linear, -1.0, turning, linear);
    rotate(back, linear, rt_model.velocity);
    add(chaser.angular, -1.0, target.angular, angular);
    rotate(back, angular, rt_model.velocity + 3);
}

/* Rotate the attitude for this duration [s], with the angular velocity of the attitude `at`. */
static void turn(const rigid_body *body, const double *attitude, const double *at, const double *spin,
                 double duration, double *turned) {
    double angular[3], rotation[4];
    angular_velocity(body, at, spin, angular);
    for (int n = 0; n < 3; n++) {
        angular[n] *= duration;
    }
    exponential(angular, rotation);
    compose(attitude, rotation, turned);
}

/* Integrate the motion of a body for one period under a constant load, in world axes. */
static void move(const rigid_body *body, body_state *state, double sign, const double *force, const double *torque) {
    double spin[3], middle[4], attitude[4], square = 0.0;
    for (int n = 0; n < 3; n++) {
        spin[n] = state->spin[n] + VELOCITY_SHARE * PERIOD * (sign * torque[n]);
    }
    turn(body, state->attitude, state->attitude, spin, PERIOD / 2, middle);
    turn(body, state->attitude, middle, spin, PERIOD, attitude);
    for (int n = 0; n < 4; n++) {
        square += attitude[n] * attitude[n];
    }
    const double norm = square != 0.0 ? sqrt(square) : NAN;
    for (int n = 0; n < 4; n++) {
        state->attitude[n] = attitude[n] / norm;
    }
    for (int n = 0; n < 3; n++) {
        const double kick = PERIOD / body->mass * (sign * force[n]);
        state->position[n] += PERIOD * (state->velocity[n] + VELOCITY_SHARE * kick);
        state->velocity[n] += kick;
        state->spin[n] += PERIOD * (sign * torque[n]);
    }
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
        memcpy(states, given, sizeof states);
        observe();
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
    const frame_motion target = interface_motion(&bodies[0], &states[0]);
    double force[3], moment[3], torques[2][3];
    rotate(target.attitude, rt_model.force, force);
    rotate(target.attitude, rt_model.force + 3, moment);
    for (int n = 0; n < 2; n++) {
        double arm[3], torque[3];
        add(target.origin, -1.0, states[n].position, arm);
        cross(arm, force, torque);
        add(moment, 1.0, torque, torques[n]);
    }
    move(&bodies[0], &states[0], -1.0, force, torques[0]);
    move(&bodies[1], &states[1], 1.0, force, torques[1]);
    observe();
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
    memcpy(values, states, sizeof states);
    return START_VALUES;
}
