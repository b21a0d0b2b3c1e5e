/* State of the rig: numerical model, motion simulator, contact and sensors. */
#ifndef FMU_MODEL_H
#define FMU_MODEL_H

#include <stdint.h>

#include "numerical_model.h"
#include "sensor_lag.h"

typedef struct {
    bool is_used;
    motion_state start, sample, end; /* at the start of the interval, at the force sample, and at its end */
} sampling_interval;

typedef struct {
    numerical_model model;
    double commands[RIG_LATENCY + 1];        /* newest position commands [m], the newest one first */
    double requested, step, shortfall;       /* of the rate limits [m] */
    double simulator[RIG_ORDER];             /* state of the motion simulator */
    double forces[RIG_RING], positions[RIG_RING];
    double drives[RIG_RING]; /* commands of the drives at the ends of the intervals, for a moving average */
    sampling_interval intervals[RIG_RING];
    int64_t tick;
    double lag, force, deepest; /* output of the sensor's lag [N], contact force [N], penetration [m] */
    bool in_contact;
    contact_law law;
    uint64_t noise; /* state of the random generator */
} fmu_model;

#endif
