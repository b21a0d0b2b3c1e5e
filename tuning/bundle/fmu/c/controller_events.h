/* Parts of the controller's FMU that one axis and six axes share. */
#include <string.h>

#include "fmu.h"
#include "fmu_log.h"
#include "jaxhil_gains.h"

const char *const fmu_log_columns = FMU_LOG_COLUMNS;
const char *const fmu_log_mapping = FMU_LOG_MAPPING;

static double limited_integer(int64_t value) {
    return value < INT32_MAX ? (double)value : (double)INT32_MAX;
}

/* Copy the parameters into the structs of gains and limits, which contain doubles in the same order. */
static void copy_parameters(const fmu_state *state, jaxhil_gains *gains, jaxhil_limits *limits) {
    const size_t gain_bytes = FMU_GAIN_COUNT * sizeof(double);
    *gains = jaxhil_exported_gains; /* the first fields are no parameters */
    memcpy((char *)gains + sizeof *gains - gain_bytes, state->values + FMU_FIRST_GAIN, gain_bytes);
    memcpy(limits, state->values + FMU_FIRST_LIMIT, sizeof *limits);
}

/* Apply the inputs that precede the tick. */
static void apply_events(fmu_state *state) {
    const double *const values = state->values;
    jaxhil_controller *const controller = &state->model.controller;
    const bool stopped = values[V_EMERGENCY_STOP] != 0.0;
    if (stopped != state->model.stopped) {
        jaxhil_emergency_stop(controller, stopped);
        state->model.stopped = stopped;
    }
    if (values[V_RESET] != 0.0) {
        jaxhil_reset(controller);
    }
    if (values[V_NEXT_CONTACT] != 0.0) {
        jaxhil_next_contact(controller);
        state->model.contact += state->model.has_tick;
    }
    state->model.has_tick = state->model.has_tick || values[V_TARE] == 0.0;
}

/* Set the outputs that describe the controller's state. */
static void set_statuses(fmu_state *state) {
    const jaxhil_controller *const controller = &state->model.controller;
    const jaxhil_contact_record contact = jaxhil_last_contact(controller);
    double *const values = state->values;
    values[V_STATUS] = (double)jaxhil_law_status(controller);
    values[V_FAULTS] = (double)controller->faults;
    values[V_SEEN_FAULTS] = (double)controller->seen;
    values[V_TRIP_CAUSE] = (double)controller->cause;
    values[V_TRIPPED] = jaxhil_tripped(controller) ? 1.0 : 0.0;
    values[V_AT_REST] = jaxhil_at_rest(controller) ? 1.0 : 0.0;
    values[V_MISSED_TICKS] = limited_integer(jaxhil_missed_ticks(controller));
    values[V_LATE_TICKS] = limited_integer(jaxhil_late_ticks(controller));
    values[V_CONTACT_NUMBER] = limited_integer(contact.number);
    values[V_CONTACT_STATUS] = (double)contact.status;
}

/* Fill a row of the flight log; a vector has `width` numbers, and the readings are without their bias. */
static size_t fill_row(const fmu_state *state, const double *readings, const double *bias, const double *command,
                       size_t width, double *row) {
    const double *const values = state->values;
    size_t count = 0;
    if (values[V_TARE] != 0.0) {
        return 0;
    }
    row[count++] = values[V_HAS_TICK_TIME] != 0.0 ? values[V_TICK_TIME] : state->begin;
    for (size_t n = 0; n < 4 * width; n++) {
        row[count++] = n < width ? readings[n] - bias[n] : readings[n];
    }
    for (size_t n = 0; n < width; n++) {
        row[count++] = command[n];
    }
    row[count++] = (double)state->model.contact;
    row[count++] = (double)((uint32_t)values[V_FAULTS] | (uint32_t)values[V_TRIP_CAUSE]);
    return count;
}
