/* Functions of FMI 2.0 for co-simulation. */
#include "fmi2Functions.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu.h"
#include "fmu_log.h"

typedef struct {
    fmu_state state;
    fmu_log flight_log;
    double start_time;
    const fmi2CallbackFunctions *callbacks;
    char name[64];
} fmu_instance;

static void report(const fmi2CallbackFunctions *callbacks, const char *name, const char *subject,
                   const char *problem) {
    if (callbacks != NULL && callbacks->logger != NULL) {
        callbacks->logger(callbacks->componentEnvironment, name, fmi2Error, "logStatusError", "%s: %s", subject,
                          problem);
    }
}

/* Report an error, if there is one, and return the status. */
static fmi2Status finish(const fmu_instance *instance, const char *subject, const char *problem) {
    if (problem == NULL) {
        return fmi2OK;
    }
    if (instance != NULL) {
        report(instance->callbacks, instance->name, subject, problem);
    }
    return fmi2Error;
}

/* Functions that read or write values of one type: `stored` is the type in fmi2.h, `kind` in fmu.h. */
#define GET(function, stored, kind)                                                                           \
    fmi2Status function(fmi2Component component, const fmi2ValueReference references[], size_t count,         \
                        stored values[]) {                                                                    \
        fmu_instance *const self = (fmu_instance *)component;                                                 \
        double value = 0.0;                                                                                   \
        if (self == NULL || (count > 0 && (references == NULL || values == NULL))) {                          \
            return finish(self, #function, fmu_argument_missing);                                         \
        }                                                                                                     \
        for (size_t n = 0; n < count; n++) {                                                                  \
            const char *const problem = fmu_get(&self->state, kind, references[n], &value);                   \
            if (problem != NULL) {                                                                            \
                return finish(self, fmu_name_of(references[n]), problem);                                     \
            }                                                                                                 \
            values[n] = (stored)value;                                                                        \
        }                                                                                                     \
        return fmi2OK;                                                                                        \
    }

#define SET(function, stored, kind, convert)                                                                  \
    fmi2Status function(fmi2Component component, const fmi2ValueReference references[], size_t count,         \
                        const stored values[]) {                                                              \
        fmu_instance *const self = (fmu_instance *)component;                                                 \
        if (self == NULL || (count > 0 && (references == NULL || values == NULL))) {                          \
            return finish(self, #function, fmu_argument_missing);                                         \
        }                                                                                                     \
        for (size_t n = 0; n < count; n++) {                                                                  \
            const char *const problem = fmu_set(&self->state, kind, references[n], convert(values[n]));       \
            if (problem != NULL) {                                                                            \
                return finish(self, fmu_name_of(references[n]), problem);                                     \
            }                                                                                                 \
        }                                                                                                     \
        return fmi2OK;                                                                                        \
    }

#define NUMBER(value) ((double)(value))
#define TRUTH(value) ((value) != fmi2False ? 1.0 : 0.0)

GET(fmi2GetReal, fmi2Real, FMU_REAL)
SET(fmi2SetReal, fmi2Real, FMU_REAL, NUMBER)
GET(fmi2GetInteger, fmi2Integer, FMU_INTEGER)
SET(fmi2SetInteger, fmi2Integer, FMU_INTEGER, NUMBER)
GET(fmi2GetBoolean, fmi2Boolean, FMU_BOOLEAN)
SET(fmi2SetBoolean, fmi2Boolean, FMU_BOOLEAN, TRUTH)

fmi2Status fmi2GetString(fmi2Component component, const fmi2ValueReference references[], size_t count,
                         fmi2String values[]) {
    fmu_instance *const self = (fmu_instance *)component;
    const char *problem = NULL;
    if (self == NULL || (count > 0 && (references == NULL || values == NULL))) {
        return finish(self, "fmi2GetString", fmu_argument_missing);
    }
    for (size_t n = 0; n < count && problem == NULL; n++) {
        problem = fmu_get_text(&self->flight_log, references[n], &values[n]);
    }
    return finish(self, "fmi2GetString", problem);
}

fmi2Status fmi2SetString(fmi2Component component, const fmi2ValueReference references[], size_t count,
                         const fmi2String values[]) {
    fmu_instance *const self = (fmu_instance *)component;
    const char *problem = NULL;
    if (self == NULL || (count > 0 && (references == NULL || values == NULL))) {
        return finish(self, "fmi2SetString", fmu_argument_missing);
    }
    for (size_t n = 0; n < count && problem == NULL; n++) {
        problem = fmu_set_text(&self->state, &self->flight_log, references[n], values[n]);
    }
    return finish(self, "fmi2SetString", problem);
}

const char *fmi2GetTypesPlatform(void) {
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void) {
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean on, size_t count,
                               const fmi2String categories[]) {
    (void)on, (void)count, (void)categories; /* errors are always reported */
    return component != NULL ? fmi2OK : fmi2Error;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    fmu_instance *self;
    (void)resources, (void)visible, (void)logging;
    if (name == NULL || guid == NULL || type != fmi2CoSimulation || strcmp(guid, FMU_TOKEN) != 0) {
        report(callbacks, name == NULL ? "" : name, "instantiation",
               "a name is missing, the GUID is that of another FMU, or the type is not co-simulation");
        return NULL;
    }
    self = (fmu_instance *)calloc(1, sizeof *self);
    if (self != NULL) {
        self->callbacks = callbacks;
        strncpy(self->name, name, sizeof self->name - 1);
        fmu_reset(&self->state);
    }
    return self;
}

void fmi2FreeInstance(fmi2Component component) {
    if (component != NULL) {
        fmu_close_log(&((fmu_instance *)component)->flight_log);
    }
    free(component);
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean has_tolerance, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    fmu_instance *const self = (fmu_instance *)component;
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    if (self == NULL || self->state.phase != FMU_INSTANTIATED) {
        return finish(self, "start time", "the time can be set only after instantiation or reset");
    }
    self->start_time = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component) {
    fmu_instance *const self = (fmu_instance *)component;
    return self == NULL ? fmi2Error : finish(self, "initialisation", fmu_begin(&self->state, self->start_time));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component) {
    fmu_instance *const self = (fmu_instance *)component;
    fmi2Status status;
    if (self == NULL || self->state.phase != FMU_INITIALISING) {
        return finish(self, "initialisation", "the instance is not being initialised");
    }
    status = finish(self, "flight_log", fmu_open_log(&self->flight_log));
    return status == fmi2OK ? finish(self, "initialisation", fmu_exit_initialisation(&self->state)) : status;
}

fmi2Status fmi2Terminate(fmi2Component component) {
    fmu_instance *const self = (fmu_instance *)component;
    fmi2Status status;
    if (self == NULL) {
        return fmi2Error;
    }
    status = finish(self, "termination", fmu_terminate(&self->state));
    return status == fmi2OK ? finish(self, "flight_log", fmu_close_log(&self->flight_log)) : status;
}

fmi2Status fmi2Reset(fmi2Component component) {
    fmu_instance *const self = (fmu_instance *)component;
    if (self == NULL) {
        return fmi2Error;
    }
    self->start_time = 0.0;
    fmu_reset(&self->state);
    return finish(self, "flight_log", fmu_close_log(&self->flight_log));
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real time, fmi2Real step, fmi2Boolean no_return) {
    fmu_instance *const self = (fmu_instance *)component;
    fmi2Status status;
    (void)no_return;
    if (self == NULL) {
        return fmi2Error;
    }
    status = finish(self, "step", fmu_step(&self->state, time, step));
    if (status == fmi2OK) {
        finish(self, "flight_log", fmu_write_log(&self->flight_log, &self->state)); /* reported, no error */
    }
    return status;
}

/* A step is finished when fmi2DoStep returns, so that it cannot be cancelled. */
fmi2Status fmi2CancelStep(fmi2Component component) {
    return finish((const fmu_instance *)component, "step", "there is no step to cancel");
}

fmi2Status fmi2GetFMUstate(fmi2Component component, fmi2FMUstate *copy) {
    const fmu_instance *const self = (const fmu_instance *)component;
    return finish(self, "state", self == NULL ? fmu_argument_missing : fmu_copy(&self->state, copy));
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate copy) {
    fmu_instance *const self = (fmu_instance *)component;
    if (self == NULL || copy == NULL) {
        return finish(self, "state", fmu_argument_missing);
    }
    memcpy(&self->state, copy, sizeof self->state);
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component component, fmi2FMUstate *copy) {
    if (component == NULL) {
        return fmi2Error;
    }
    fmu_free_copy(copy);
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component component, fmi2FMUstate copy, size_t *size) {
    if (component == NULL || copy == NULL || size == NULL) {
        return finish((const fmu_instance *)component, "state", fmu_argument_missing);
    }
    *size = fmu_serialised_size();
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component component, fmi2FMUstate copy, fmi2Byte bytes[], size_t size) {
    if (component == NULL || copy == NULL || bytes == NULL || size != fmu_serialised_size()) {
        return finish((const fmu_instance *)component, "state", "an argument is missing, or the size differs");
    }
    fmu_serialise((const fmu_state *)copy, (uint8_t *)bytes);
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *copy) {
    const fmu_instance *const self = (const fmu_instance *)component;
    return finish(self, "state",
                  self == NULL ? fmu_argument_missing : fmu_restore((const uint8_t *)bytes, size, copy));
}

/* Functions for derivatives, which this FMU does not have. */
fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknowns[],
                                        size_t unknown_count, const fmi2ValueReference knowns[],
                                        size_t known_count, const fmi2Real changes[], fmi2Real results[]) {
    (void)unknowns, (void)unknown_count, (void)knowns, (void)known_count, (void)changes, (void)results;
    return finish((const fmu_instance *)component, "derivative", "this FMU has no derivatives");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference references[],
                                       size_t count, const fmi2Integer orders[], const fmi2Real values[]) {
    (void)references, (void)count, (void)orders, (void)values;
    return finish((const fmu_instance *)component, "derivative", "this FMU has no derivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference references[],
                                        size_t count, const fmi2Integer orders[], fmi2Real values[]) {
    (void)references, (void)count, (void)orders, (void)values;
    return finish((const fmu_instance *)component, "derivative", "this FMU has no derivatives");
}

/* Status of an unfinished step: there is none, because every step is complete when its function returns. */
fmi2Status fmi2GetRealStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Real *value) {
    const fmu_instance *const self = (const fmu_instance *)component;
    if (self == NULL || value == NULL || kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = self->state.time;
    return fmi2OK;
}

#define NO_STATUS(function, stored)                                                                           \
    fmi2Status function(fmi2Component component, const fmi2StatusKind kind, stored *value) {                  \
        (void)component, (void)kind, (void)value;                                                             \
        return fmi2Discard;                                                                                   \
    }

NO_STATUS(fmi2GetStatus, fmi2Status)
NO_STATUS(fmi2GetIntegerStatus, fmi2Integer)
NO_STATUS(fmi2GetBooleanStatus, fmi2Boolean)
NO_STATUS(fmi2GetStringStatus, fmi2String)
