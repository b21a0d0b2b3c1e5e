/* State of the rig with six axes: the numbers of the generated program. */
#ifndef FMU_MODEL_H
#define FMU_MODEL_H

#include "rig_program.h"

typedef struct {
    double numbers[RIG_NUMBERS];
} fmu_model;

#endif
