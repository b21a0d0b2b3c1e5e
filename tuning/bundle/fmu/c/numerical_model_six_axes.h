/* Motion of the numerical model with six axes: two free rigid bodies, target and chaser.
 *
 * The equations are those of numerical_model_six_axes.py, in the same order of operations, so that the results are
 * the same bit for bit. Quaternions are (w, x, y, z). Of two bodies, the target is the first.
 */
#ifndef NUMERICAL_MODEL_H
#define NUMERICAL_MODEL_H

#include <math.h>
#include <string.h>

#define MAX_ANGLE 1e6 /* rad; larger rotations in a period give NaN */

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

typedef struct {
    body_state bodies[2];
    double pose[6], twist[6]; /* of chaser frame C relative to target frame T [m, rad], [m/s, rad/s] */
} numerical_model;

static inline void add(const double *left, double factor, const double *right, double *sum) {
    for (int n = 0; n < 3; n++) {
        sum[n] = left[n] + factor * right[n];
    }
}

static inline void cross(const double *left, const double *right, double *product) {
    const double a = left[0], b = left[1], c = left[2], x = right[0], y = right[1], z = right[2];
    product[0] = b * z - c * y;
    product[1] = c * x - a * z;
    product[2] = a * y - b * x;
}

static inline void reverse(const double *rotation, double *reversed) {
    reversed[0] = rotation[0];
    for (int n = 1; n < 4; n++) {
        reversed[n] = -rotation[n];
    }
}

/* Compute the product of two rotations: `first`, followed by `second`. */
static inline void compose(const double *second, const double *first, double *product) {
    const double a = second[0], x = second[1], y = second[2], z = second[3];
    const double b = first[0], u = first[1], v = first[2], w = first[3];
    product[0] = a * b - x * u - y * v - z * w;
    product[1] = a * u + b * x + y * w - z * v;
    product[2] = a * v + b * y + z * u - x * w;
    product[3] = a * w + b * z + x * v - y * u;
}

static inline void rotate(const double *rotation, const double *vector, double *rotated) {
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

static inline double norm3(const double *vector) {
    return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
}

/* Convert a rotation vector [rad] to a quaternion. */
static inline void exponential(const double *theta, double *rotation) {
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
static inline void logarithm(const double *rotation, double *theta) {
    const double sign = rotation[0] >= 0.0 ? 1.0 : -1.0, sine = norm3(rotation + 1);
    const double scale = sine > 0.0 ? 2.0 * atan2(sine, sign * rotation[0]) / sine : 2.0;
    for (int n = 0; n < 3; n++) {
        theta[n] = scale * (sign * rotation[n + 1]);
    }
}

/* Compute a body's angular velocity from its angular momentum, in body axes. */
static inline void angular_velocity(const rigid_body *body, const double *attitude, const double *spin,
                                    double *angular) {
    double back[4], inner[3];
    reverse(attitude, back);
    rotate(back, spin, inner);
    for (int n = 0; n < 3; n++) {
        const double *const row = body->inverse_inertia[n];
        angular[n] = row[0] * inner[0] + row[1] * inner[1] + row[2] * inner[2];
    }
}

static inline frame_motion interface_motion(const rigid_body *body, const body_state *state) {
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
static inline void observe_model(const rigid_body *bodies, numerical_model *model) {
    const frame_motion target = interface_motion(&bodies[0], &model->bodies[0]);
    const frame_motion chaser = interface_motion(&bodies[1], &model->bodies[1]);
    double apart[3], back[4], relative[4], turning[3], linear[3], angular[3];
    add(chaser.origin, -1.0, target.origin, apart);
    reverse(target.attitude, back);
    rotate(back, apart, model->pose);
    compose(back, chaser.attitude, relative);
    logarithm(relative, model->pose + 3);
    cross(target.angular, apart, turning);
    add(chaser.velocity, -1.0, target.velocity, linear);
    add(linear, -1.0, turning, linear);
    rotate(back, linear, model->twist);
    add(chaser.angular, -1.0, target.angular, angular);
    rotate(back, angular, model->twist + 3);
}

/* Rotate the attitude for this duration [s], with the angular velocity of the attitude `at`. */
static inline void turn(const rigid_body *body, const double *attitude, const double *at, const double *spin,
                        double duration, double *turned) {
    double angular[3], rotation[4];
    angular_velocity(body, at, spin, angular);
    for (int n = 0; n < 3; n++) {
        angular[n] *= duration;
    }
    exponential(angular, rotation);
    compose(attitude, rotation, turned);
}

/* Integrate the motion of a body for one period under a constant load, in world axes.
 *
 * `share` is the share of the velocity change that moves the body in this period.
 */
static inline void move_body(const rigid_body *body, body_state *state, double share, double period, double sign,
                             const double *force, const double *torque) {
    double spin[3], middle[4], attitude[4], square = 0.0;
    for (int n = 0; n < 3; n++) {
        spin[n] = state->spin[n] + share * period * (sign * torque[n]);
    }
    turn(body, state->attitude, state->attitude, spin, period / 2, middle);
    turn(body, state->attitude, middle, spin, period, attitude);
    for (int n = 0; n < 4; n++) {
        square += attitude[n] * attitude[n];
    }
    const double norm = square != 0.0 ? sqrt(square) : NAN;
    for (int n = 0; n < 4; n++) {
        state->attitude[n] = attitude[n] / norm;
    }
    for (int n = 0; n < 3; n++) {
        const double kick = period / body->mass * (sign * force[n]);
        state->position[n] += period * (state->velocity[n] + share * kick);
        state->velocity[n] += kick;
        state->spin[n] += period * (sign * torque[n]);
    }
}

/* Integrate the motion of both bodies for one period [s].
 *
 * The wrench [N, N m] acts on the chaser, in axes of frame T and about its origin.
 */
static inline void move_model(const rigid_body *bodies, double share, double period, const double *wrench,
                              numerical_model *model) {
    const frame_motion target = interface_motion(&bodies[0], &model->bodies[0]);
    double force[3], moment[3], torques[2][3];
    rotate(target.attitude, wrench, force);
    rotate(target.attitude, wrench + 3, moment);
    for (int n = 0; n < 2; n++) {
        double arm[3], torque[3];
        add(target.origin, -1.0, model->bodies[n].position, arm);
        cross(arm, force, torque);
        add(moment, 1.0, torque, torques[n]);
    }
    move_body(&bodies[0], &model->bodies[0], share, period, -1.0, force, torques[0]);
    move_body(&bodies[1], &model->bodies[1], share, period, 1.0, force, torques[1]);
    observe_model(bodies, model);
}

/* Compute the angular momentum of a body, from its angular velocity in body axes, by Cramer's rule. */
static inline void angular_momentum(const rigid_body *body, const double *angular, double *momentum) {
    const double (*const rows)[3] = body->inverse_inertia;
    double columns[3][3], determinant = 0.0;
    for (int n = 0; n < 3; n++) {
        cross(rows[(n + 1) % 3], rows[(n + 2) % 3], columns[n]);
        determinant += rows[0][n] * columns[0][n];
    }
    for (int n = 0; n < 3; n++) {
        momentum[n] = columns[0][n] * angular[0] + columns[1][n] * angular[1] + columns[2][n] * angular[2];
        momentum[n] /= determinant;
    }
}

/* Compute the state of a body from the motion of its interface frame. */
static inline void place_body(const rigid_body *body, const frame_motion *frame, body_state *state) {
    double back[4], offset[3], turning[3], inner[3], momentum[3];
    reverse(body->interface_attitude, back);
    compose(frame->attitude, back, state->attitude);
    rotate(state->attitude, body->interface, offset);
    add(frame->origin, -1.0, offset, state->position);
    cross(frame->angular, offset, turning);
    add(frame->velocity, -1.0, turning, state->velocity);
    reverse(state->attitude, back);
    rotate(back, frame->angular, inner);
    angular_momentum(body, inner, momentum);
    rotate(state->attitude, momentum, state->spin);
}

/* Place both bodies at this pose [m, rad] and twist [m/s, rad/s], with frame T in the world's origin.
 *
 * Of the target's own motion, only its angular velocity [rad/s], in axes of T, changes the relative motion.
 */
static inline void place_model(const rigid_body *bodies, const double *pose, const double *twist,
                               const double *target_angular_velocity, numerical_model *model) {
    frame_motion target = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}}, chaser;
    double turning[3];
    memcpy(target.angular, target_angular_velocity, sizeof target.angular);
    memcpy(chaser.origin, pose, sizeof chaser.origin);
    exponential(pose + 3, chaser.attitude);
    cross(target.angular, pose, turning);
    add(twist, 1.0, turning, chaser.velocity);
    add(twist + 3, 1.0, target.angular, chaser.angular);
    place_body(&bodies[0], &target, &model->bodies[0]);
    place_body(&bodies[1], &chaser, &model->bodies[1]);
    memcpy(model->pose, pose, sizeof model->pose);
    memcpy(model->twist, twist, sizeof model->twist);
}

#endif
