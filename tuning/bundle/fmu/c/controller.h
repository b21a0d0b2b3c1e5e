/* What the controller's FMU stores besides its variables. */
#ifndef FMU_MODEL_H
#define FMU_MODEL_H

#include "jaxhil_controller.h"

typedef struct {
    jaxhil_controller controller;
    bool stopped; /* whether the emergency stop is active */
} fmu_model;

#endif
