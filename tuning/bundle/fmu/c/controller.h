/* What the controller's FMU stores besides its variables. */
#ifndef FMU_MODEL_H
#define FMU_MODEL_H

#include "fmu_variables.h"
#include "jaxhil_controller.h"
#include "numerical_model.h"

typedef struct {
    jaxhil_controller controller;
    bool stopped; /* whether the emergency stop is active */
    bool begins;  /* whether the next step is the first step of a run */
    bool has_tick;    /* whether there was a tick since the initialisation */
    uint32_t contact; /* index of the contact in the flight log */
    numerical_model model; /* only if the FMU integrates the numerical model */
    double position_desired[FMU_AXES], velocity_desired[FMU_AXES]; /* of the last tick */
} fmu_model;

#endif
