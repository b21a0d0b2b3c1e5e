/* See fmu.h. */
#include "fmu.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

const char *const fmu_argument_missing = "an argument is missing";

static const double step_tolerance = 1e-6; /* accepted difference from the control period, in periods */

void fmu_reset(fmu_state *state) {
    memset(state, 0, sizeof *state); /* also the bytes between the fields, for equal serialised states */
    state->phase = FMU_INSTANTIATED;
    for (size_t n = 0; n < V_COUNT; n++) {
        state->values[n] = fmu_variables[n].start;
    }
}

const char *fmu_begin(fmu_state *state, double time) {
    if (state->phase != FMU_INSTANTIATED) {
        return "initialisation begins only after instantiation or reset";
    }
    if (!isfinite(time)) {
        return "the start time is not finite";
    }
    state->time = state->values[V_TIME] = time;
    state->phase = FMU_INITIALISING;
    return NULL;
}

const char *fmu_exit_initialisation(fmu_state *state) {
    if (state->phase != FMU_INITIALISING) {
        return "the instance is not being initialised";
    }
    if (!fmu_model_begin(state)) {
        return "the limits contradict each other: compare the limits whose descriptions name another limit";
    }
    fmu_model_initial(state);
    state->phase = FMU_STEPPING;
    return NULL;
}

const char *fmu_terminate(fmu_state *state) {
    if (state->phase != FMU_STEPPING) {
        return "the instance is not initialised";
    }
    state->phase = FMU_TERMINATED;
    return NULL;
}

const char *fmu_get(fmu_state *state, fmu_type type, uint32_t reference, double *value) {
    if (reference >= V_COUNT || fmu_variables[reference].type != type) {
        return "no variable of this type has this value reference";
    }
    if (state->phase == FMU_INITIALISING) {
        fmu_model_initial(state);
    }
    *value = state->values[reference];
    return NULL;
}

const char *fmu_set(fmu_state *state, fmu_type type, uint32_t reference, double value) {
    const fmu_variable *const variable = reference < V_COUNT ? &fmu_variables[reference] : NULL;
    if (variable == NULL || variable->type != type) {
        return "no variable of this type has this value reference";
    }
    if (variable->causality != FMU_PARAMETER && variable->causality != FMU_INPUT) {
        return "an output cannot be set";
    }
    if (state->phase == FMU_TERMINATED || (state->phase == FMU_STEPPING && variable->causality == FMU_PARAMETER)) {
        return "it is too late to set the value; reset the instance first";
    }
    if (variable->causality == FMU_PARAMETER && !(value >= variable->lowest && value <= variable->highest)) {
        return "the value is beyond the variable's bounds";
    }
    state->values[reference] = value;
    return NULL;
}

const char *fmu_step(fmu_state *state, double time, double step) {
    if (state->phase != FMU_STEPPING) {
        return "the instance is not initialised";
    }
    if (!isfinite(time)) {
        return "the communication point is not finite";
    }
    if (!(fabs(step - FMU_PERIOD) <= step_tolerance * FMU_PERIOD)) {
        return "the communication step differs from the control period; they must be equal";
    }
    fmu_model_step(state);
    state->begin = time;
    state->time = state->values[V_TIME] = time + step;
    return NULL;
}

const char *fmu_name_of(uint32_t reference) {
    return reference < V_COUNT ? fmu_variables[reference].name : "unknown variable";
}

/* Fowler-Noll-Vo hash FNV-1a: detects accidental changes of a serialised state. */
static uint64_t checksum_of(const uint8_t *bytes, size_t size) {
    uint64_t hash = 14695981039346656037u;
    for (size_t n = 0; n < size; n++) {
        hash = (hash ^ bytes[n]) * 1099511628211u;
    }
    return hash;
}

size_t fmu_serialised_size(void) {
    return sizeof(fmu_header) + sizeof(fmu_state);
}

/* Header of the bytes of a state. All its bytes are determined, also those between the fields. */
static fmu_header header_of(const uint8_t *bytes) {
    fmu_header header;
    memset(&header, 0, sizeof header);
    memcpy(header.token, FMU_TOKEN, sizeof FMU_TOKEN);
    header.size = sizeof(fmu_state);
    header.checksum = checksum_of(bytes, sizeof(fmu_state));
    return header;
}

void fmu_serialise(const fmu_state *state, uint8_t *bytes) {
    fmu_header header;
    memcpy(bytes + sizeof header, state, sizeof *state);
    header = header_of(bytes + sizeof header);
    memcpy(bytes, &header, sizeof header);
}

static const char *deserialise(fmu_state *state, const uint8_t *bytes, size_t size) {
    fmu_header expected;
    if (size != fmu_serialised_size()) {
        return "the serialised state has another size";
    }
    expected = header_of(bytes + sizeof expected);
    if (memcmp(bytes, &expected, sizeof expected) != 0) {
        return "the serialised state is damaged, or belongs to another FMU";
    }
    memcpy(state, bytes + sizeof expected, sizeof *state);
    return NULL;
}

/* Allocate memory for a copy of a state, unless there is a copy already. */
static const char *reserve(void **copy) {
    if (copy == NULL) {
        return fmu_argument_missing;
    }
    if (*copy == NULL) {
        *copy = malloc(sizeof(fmu_state));
    }
    return *copy == NULL ? "no memory is left" : NULL;
}

const char *fmu_copy(const fmu_state *state, void **copy) {
    const char *const problem = reserve(copy);
    if (problem == NULL) {
        memcpy(*copy, state, sizeof *state);
    }
    return problem;
}

const char *fmu_restore(const uint8_t *bytes, size_t size, void **copy) {
    const bool is_new = copy != NULL && *copy == NULL;
    const char *problem = bytes == NULL ? fmu_argument_missing : reserve(copy);
    if (problem == NULL) {
        problem = deserialise((fmu_state *)*copy, bytes, size);
        if (problem != NULL && is_new) {
            fmu_free_copy(copy);
        }
    }
    return problem;
}

void fmu_free_copy(void **copy) {
    if (copy != NULL) {
        free(*copy);
        *copy = NULL;
    }
}
