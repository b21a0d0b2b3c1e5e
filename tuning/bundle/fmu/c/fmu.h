/* Instance of an FMU: its variables, phases, steps and states, which FMI 2 and FMI 3 have in common.
 *
 * `fmu_variables.h` and `fmu_variables.c` list the variables. `fmu_model.h` and `fmu_model.c` contain what the
 * FMU computes. A function that can fail returns NULL, or a text that says why nothing was done.
 */
#ifndef FMU_H
#define FMU_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "fmu_model.h"
#include "fmu_variables.h"

typedef enum { FMU_INSTANTIATED, FMU_INITIALISING, FMU_STEPPING, FMU_TERMINATED } fmu_phase;

/* State of an instance. It contains no pointers, so that a copy of its bytes is a copy of the state. */
typedef struct {
    fmu_phase phase;
    double time;               /* communication point [s] */
    double begin;              /* of the last step [s] */
    double values[V_COUNT];    /* values of the variables, by value reference */
    fmu_model model;
} fmu_state;

/* Header of a serialised state; the bytes of the state follow. */
typedef struct {
    char token[40]; /* token of the FMU, padded to whole words */
    uint64_t size;
    uint64_t checksum;
} fmu_header;

/* Set the start values, and go to the first phase. */
void fmu_reset(fmu_state *state);

/* Change the phase. */
const char *fmu_begin(fmu_state *state, double time);
const char *fmu_exit_initialisation(fmu_state *state);
const char *fmu_terminate(fmu_state *state);

/* Get or set the value of one variable. */
const char *fmu_get(fmu_state *state, fmu_type type, uint32_t reference, double *value);
const char *fmu_set(fmu_state *state, fmu_type type, uint32_t reference, double value);

/* Compute one control period. */
const char *fmu_step(fmu_state *state, double time, double step);

/* Return the name of a variable for messages. */
const char *fmu_name_of(uint32_t reference);

/* Number of bytes of a serialised state. */
size_t fmu_serialised_size(void);
void fmu_serialise(const fmu_state *state, uint8_t *bytes);

/* Copies of a state for the importing tool. The first two functions allocate memory if `*copy` is NULL. */
const char *fmu_copy(const fmu_state *state, void **copy);
const char *fmu_restore(const uint8_t *bytes, size_t size, void **copy);
void fmu_free_copy(void **copy);

extern const char *const fmu_argument_missing;

/* Provided by fmu_model.c. The first function sets outputs before the first step, and the second one begins
 * with the parameters and returns false if it refuses their values. */
void fmu_model_initial(fmu_state *state);
bool fmu_model_begin(fmu_state *state);
void fmu_model_step(fmu_state *state);

#endif
