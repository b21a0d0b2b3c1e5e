/* Controller and numerical model of the docking, with one axis or six axes; see rt_model.c. */
#ifndef RT_MODEL_H
#define RT_MODEL_H

#include "jaxhil_controller.h"
#include "rt_loop.h"

extern jaxhil_controller rt_controller;

typedef struct {
    double position[AXES], velocity[AXES]; /* of the numerical model [m, rad], [m/s, rad/s] */
    double force[AXES];                    /* on the model in the last tick [N, N m] */
    double command[AXES];                  /* position command [m, rad] */
} rt_motion;

extern rt_motion rt_model;

/* Initialise the controller; return false if a gain or limit is out of its range. */
bool rt_init(void);

/* Pass a reading out of contact to the tare; return true when the tare has ended. */
bool rt_tare(const double *force);

/* Get the bias of the force sensor. */
void rt_bias(double *bias);

/* Place the model at the start of a run; return false for an unusable start. */
bool rt_place(const double *start);

/* Compute the command of tick 0. */
void rt_begin(void);

/* Advance controller and model by one period. */
void rt_tick(const double *force, const double *position, double time, bool is_first);

/* Advance the model by one period under the last force. */
void rt_coast(void);

/* Get the rates of the model's position. */
void rt_rate(double *rate);

/* Get the states of both bodies, as in udp_protocol.py; return the number of values: 0 with one axis. */
size_t rt_bodies(double *bodies);

#endif
