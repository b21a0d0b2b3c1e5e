/* Motion of the numerical model on one axis: mass times acceleration is the negative force. */
#ifndef NUMERICAL_MODEL_H
#define NUMERICAL_MODEL_H

enum { INTEGRATOR_SEMI_IMPLICIT_EULER, INTEGRATOR_ZOH, INTEGRATOR_EXPLICIT_EULER };

typedef struct {
    double position, velocity, acceleration; /* [m], [m/s], [m/s^2] */
} numerical_model;

/* Integrate over one control period [s] under a force [N]. */
static inline void move_model(numerical_model *model, int integrator, double period, double force, double mass) {
    const double acceleration = -force / mass, increment = period * acceleration;
    model->acceleration = acceleration;
    if (integrator == INTEGRATOR_EXPLICIT_EULER) {
        model->position += period * model->velocity;
    } else if (integrator == INTEGRATOR_ZOH) {
        model->position += period * (model->velocity + increment / 2.0);
    } else {
        model->position += period * (model->velocity + increment);
    }
    model->velocity += increment;
}

#endif
