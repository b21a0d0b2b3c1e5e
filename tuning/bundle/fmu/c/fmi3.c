/* Functions of FMI 3.0 for co-simulation. Functions of other kinds of FMUs return errors. */
#if defined(__clang__)
#pragma clang diagnostic ignored "-Wstrict-prototypes" /* in the header of the standard */
#endif
#include "fmi3Functions.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu.h"
#include "fmu_log.h"

typedef struct {
    fmu_state state;
    fmu_log flight_log;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} fmu_instance;

/* Report an error, if there is one, and return the status. */
static fmi3Status finish(const fmu_instance *instance, const char *subject, const char *problem) {
    char message[256];
    if (problem == NULL) {
        return fmi3OK;
    }
    if (instance != NULL && instance->log != NULL) {
        snprintf(message, sizeof message, "%s: %s", subject, problem);
        instance->log(instance->environment, fmi3Error, "logStatusError", message);
    }
    return fmi3Error;
}

static fmi3Status missing(fmi3Instance instance, const char *function) {
    return finish((const fmu_instance *)instance, function, "this FMU has no such function");
}

/* Functions that read or write values of one type: `stored` is the type in fmi3.h, `kind` in fmu.h. */
#define GET(function, stored, kind)                                                                           \
    fmi3Status function(fmi3Instance instance, const fmi3ValueReference references[], size_t count,           \
                        stored values[], size_t size) {                                                       \
        fmu_instance *const self = (fmu_instance *)instance;                                                  \
        double value = 0.0;                                                                                   \
        if (self == NULL || count != size || (count > 0 && (references == NULL || values == NULL))) {         \
            return finish(self, #function, "an argument is missing, or the numbers of values differ");        \
        }                                                                                                     \
        for (size_t n = 0; n < count; n++) {                                                                  \
            const char *const problem = fmu_get(&self->state, kind, references[n], &value);                   \
            if (problem != NULL) {                                                                            \
                return finish(self, fmu_name_of(references[n]), problem);                                     \
            }                                                                                                 \
            values[n] = (stored)value;                                                                        \
        }                                                                                                     \
        return fmi3OK;                                                                                        \
    }

#define SET(function, stored, kind)                                                                           \
    fmi3Status function(fmi3Instance instance, const fmi3ValueReference references[], size_t count,           \
                        const stored values[], size_t size) {                                                 \
        fmu_instance *const self = (fmu_instance *)instance;                                                  \
        if (self == NULL || count != size || (count > 0 && (references == NULL || values == NULL))) {         \
            return finish(self, #function, "an argument is missing, or the numbers of values differ");        \
        }                                                                                                     \
        for (size_t n = 0; n < count; n++) {                                                                  \
            const char *const problem = fmu_set(&self->state, kind, references[n], (double)values[n]);        \
            if (problem != NULL) {                                                                            \
                return finish(self, fmu_name_of(references[n]), problem);                                     \
            }                                                                                                 \
        }                                                                                                     \
        return fmi3OK;                                                                                        \
    }

/* Functions for types that no variable has; they return an error if values are requested. */
#define NO_VALUES(name, stored)                                                                               \
    fmi3Status fmi3Get##name(fmi3Instance instance, const fmi3ValueReference references[], size_t count,      \
                             stored values[], size_t size) {                                                  \
        (void)references, (void)values, (void)size;                                                           \
        return count == 0 && instance != NULL ? fmi3OK : missing(instance, "fmi3Get" #name);                  \
    }                                                                                                         \
    fmi3Status fmi3Set##name(fmi3Instance instance, const fmi3ValueReference references[], size_t count,      \
                             const stored values[], size_t size) {                                            \
        (void)references, (void)values, (void)size;                                                           \
        return count == 0 && instance != NULL ? fmi3OK : missing(instance, "fmi3Set" #name);                  \
    }

GET(fmi3GetFloat64, fmi3Float64, FMU_REAL)
SET(fmi3SetFloat64, fmi3Float64, FMU_REAL)
GET(fmi3GetInt32, fmi3Int32, FMU_INTEGER)
SET(fmi3SetInt32, fmi3Int32, FMU_INTEGER)
GET(fmi3GetBoolean, fmi3Boolean, FMU_BOOLEAN)
SET(fmi3SetBoolean, fmi3Boolean, FMU_BOOLEAN)
NO_VALUES(Float32, fmi3Float32)
NO_VALUES(Int8, fmi3Int8)
NO_VALUES(UInt8, fmi3UInt8)
NO_VALUES(Int16, fmi3Int16)
NO_VALUES(UInt16, fmi3UInt16)
NO_VALUES(UInt32, fmi3UInt32)
NO_VALUES(Int64, fmi3Int64)
NO_VALUES(UInt64, fmi3UInt64)

fmi3Status fmi3GetString(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                         fmi3String values[], size_t size) {
    fmu_instance *const self = (fmu_instance *)instance;
    const char *problem = NULL;
    if (self == NULL || count != size || (count > 0 && (references == NULL || values == NULL))) {
        return finish(self, "fmi3GetString", "an argument is missing, or the numbers of values differ");
    }
    for (size_t n = 0; n < count && problem == NULL; n++) {
        problem = fmu_get_text(&self->flight_log, references[n], &values[n]);
    }
    return finish(self, "fmi3GetString", problem);
}

fmi3Status fmi3SetString(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                         const fmi3String values[], size_t size) {
    fmu_instance *const self = (fmu_instance *)instance;
    const char *problem = NULL;
    if (self == NULL || count != size || (count > 0 && (references == NULL || values == NULL))) {
        return finish(self, "fmi3SetString", "an argument is missing, or the numbers of values differ");
    }
    for (size_t n = 0; n < count && problem == NULL; n++) {
        problem = fmu_set_text(&self->state, &self->flight_log, references[n], values[n]);
    }
    return finish(self, "fmi3SetString", problem);
}

const char *fmi3GetVersion(void) {
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t count, const fmi3String names[]) {
    (void)on, (void)count, (void)names; /* errors are always reported */
    return instance != NULL ? fmi3OK : fmi3Error;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events,
                                         fmi3Boolean early, const fmi3ValueReference required[], size_t count,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    fmu_instance *self;
    (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)update;
    if (name == NULL || token == NULL || strcmp(token, FMU_TOKEN) != 0 || count > 0) {
        if (log != NULL) {
            log(environment, fmi3Error, "logStatusError",
                "instantiation: a name is missing, the token is that of another FMU, or intermediate values "
                "are required");
        }
        return NULL;
    }
    self = (fmu_instance *)calloc(1, sizeof *self);
    if (self != NULL) {
        self->log = log;
        self->environment = environment;
        fmu_reset(&self->state);
    }
    return self;
}

void fmi3FreeInstance(fmi3Instance instance) {
    if (instance != NULL) {
        fmu_close_log(&((fmu_instance *)instance)->flight_log);
    }
    free(instance);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    fmu_instance *const self = (fmu_instance *)instance;
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return self == NULL ? fmi3Error : finish(self, "initialisation", fmu_begin(&self->state, start));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    fmu_instance *const self = (fmu_instance *)instance;
    fmi3Status status;
    if (self == NULL || self->state.phase != FMU_INITIALISING) {
        return finish(self, "initialisation", "the instance is not being initialised");
    }
    status = finish(self, "flight_log", fmu_open_log(&self->flight_log));
    return status == fmi3OK ? finish(self, "initialisation", fmu_exit_initialisation(&self->state)) : status;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    fmu_instance *const self = (fmu_instance *)instance;
    fmi3Status status;
    if (self == NULL) {
        return fmi3Error;
    }
    status = finish(self, "termination", fmu_terminate(&self->state));
    return status == fmi3OK ? finish(self, "flight_log", fmu_close_log(&self->flight_log)) : status;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    if (instance == NULL) {
        return fmi3Error;
    }
    fmu_reset(&((fmu_instance *)instance)->state);
    return finish((fmu_instance *)instance, "flight_log", fmu_close_log(&((fmu_instance *)instance)->flight_log));
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_return,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
    fmu_instance *const self = (fmu_instance *)instance;
    fmi3Status status;
    (void)no_return;
    if (self == NULL || event == NULL || terminate == NULL || early == NULL || reached == NULL) {
        return finish(self, "step", fmu_argument_missing);
    }
    status = finish(self, "step", fmu_step(&self->state, time, step));
    if (status == fmi3OK) {
        finish(self, "flight_log", fmu_write_log(&self->flight_log, &self->state)); /* reported, no error */
    }
    *event = *terminate = *early = false;
    *reached = self->state.time;
    return status;
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *copy) {
    const fmu_instance *const self = (const fmu_instance *)instance;
    return finish(self, "state", self == NULL ? fmu_argument_missing : fmu_copy(&self->state, copy));
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState copy) {
    fmu_instance *const self = (fmu_instance *)instance;
    if (self == NULL || copy == NULL) {
        return finish(self, "state", fmu_argument_missing);
    }
    memcpy(&self->state, copy, sizeof self->state);
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *copy) {
    if (instance == NULL) {
        return fmi3Error;
    }
    fmu_free_copy(copy);
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState copy, size_t *size) {
    if (instance == NULL || copy == NULL || size == NULL) {
        return finish((const fmu_instance *)instance, "state", fmu_argument_missing);
    }
    *size = fmu_serialised_size();
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState copy, fmi3Byte bytes[], size_t size) {
    if (instance == NULL || copy == NULL || bytes == NULL || size != fmu_serialised_size()) {
        return finish((const fmu_instance *)instance, "state", "an argument is missing, or the size differs");
    }
    fmu_serialise((const fmu_state *)copy, bytes);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *copy) {
    const fmu_instance *const self = (const fmu_instance *)instance;
    return finish(self, "state", self == NULL ? fmu_argument_missing : fmu_restore(bytes, size, copy));
}
