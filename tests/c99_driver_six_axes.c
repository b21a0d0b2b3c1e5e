/* Ticks in batches, for the tests of the controller in six axes. */
#include <string.h>

#include "jaxhil_controller.c"
#include "jaxhil_gains.h"

/* A row: event, wrench, desired pose and twist, measured pose, time, whether it is given, the model's pose and
 * twist. A result: see `driver_run`. */
enum { ROW = 39, RESULT = 40 };
enum { TICK, RESET, NEXT_CONTACT, STOP, RELEASE, TARE, COMMAND_FIRST, STEP_ONLY };

size_t driver_size(void);
int driver_init(jaxhil_controller *controller);
int driver_init_with(
    jaxhil_controller *controller, const double *gains, const double *limits, const double *constants
);
size_t driver_exported(double *parameters);
uint32_t driver_faults(const jaxhil_controller *controller);
int driver_contact_status(const jaxhil_controller *controller);
void driver_run(jaxhil_controller *controller, size_t count, const double *rows, double *results);
double driver_ticks(jaxhil_controller *controller, size_t count, const double *rows);

size_t driver_size(void) {
    return sizeof(jaxhil_controller);
}

int driver_init(jaxhil_controller *controller) {
    return jaxhil_init(
        controller, &jaxhil_exported_gains, &jaxhil_exported_limits, &jaxhil_exported_constants
    );
}

int driver_init_with(
    jaxhil_controller *controller, const double *gains, const double *limits, const double *constants
) {
    jaxhil_gains own_gains;
    jaxhil_limits own_limits;
    jaxhil_constants own_constants;
    memcpy(&own_gains, gains, sizeof own_gains);
    memcpy(&own_limits, limits, sizeof own_limits);
    memcpy(&own_constants, constants, sizeof own_constants);
    return jaxhil_init(controller, &own_gains, &own_limits, &own_constants);
}

size_t driver_exported(double *parameters) {
    memcpy(parameters, &jaxhil_exported_gains, sizeof jaxhil_exported_gains);
    parameters += sizeof jaxhil_exported_gains / sizeof *parameters;
    memcpy(parameters, &jaxhil_exported_limits, sizeof jaxhil_exported_limits);
    parameters += sizeof jaxhil_exported_limits / sizeof *parameters;
    memcpy(parameters, &jaxhil_exported_constants, sizeof jaxhil_exported_constants);
    return (sizeof jaxhil_exported_gains + sizeof jaxhil_exported_limits + sizeof jaxhil_exported_constants) /
           sizeof *parameters;
}

uint32_t driver_faults(const jaxhil_controller *controller) {
    return controller->faults;
}

int driver_contact_status(const jaxhil_controller *controller) {
    return jaxhil_last_contact(controller).status;
}

static double event(jaxhil_controller *controller, const double *row) {
    double pose[6];
    const double code = row[0];
    if (code == RESET) {
        return jaxhil_reset(controller);
    }
    if (code == TARE) {
        return jaxhil_tare(controller, row + 1);
    }
    if (code == COMMAND_FIRST) {
        jaxhil_pose_command(controller, row + 27, row + 33, pose);
        return pose[2];
    }
    if (code == NEXT_CONTACT) {
        jaxhil_next_contact(controller);
    } else if (code == STOP || code == RELEASE) {
        jaxhil_emergency_stop(controller, code == STOP);
    }
    return 0.0;
}

void driver_run(jaxhil_controller *controller, size_t count, const double *rows, double *results) {
    for (size_t n = 0; n < count; n++, rows += ROW, results += RESULT) {
        double *result = results;
        const double answer = event(controller, rows);
        const double *time = rows[26] != 0.0 ? &rows[25] : NULL;
        memset(result, 0, RESULT * sizeof *result);
        jaxhil_step(controller, rows + 1, rows + 7, rows + 13, rows + 19, time, result);
        if (rows[0] != STEP_ONLY) {
            jaxhil_pose_command(controller, rows + 27, rows + 33, result + 6);
        }
        jaxhil_bias(controller, result + 12);
        result += 18;
        *result++ = jaxhil_law_status(controller);
        *result++ = controller->faults;
        *result++ = controller->seen;
        *result++ = controller->cause;
        *result++ = (double)jaxhil_channels(controller);
        *result++ = (double)jaxhil_missed_ticks(controller);
        *result++ = (double)jaxhil_late_ticks(controller);
        *result++ = jaxhil_at_rest(controller);
        *result++ = jaxhil_tripped(controller);
        *result++ = answer;
        *result++ = jaxhil_loop_delay(controller);
        *result++ = jaxhil_unpaid_impulse(controller);
        *result++ = controller->watchdog.momentum_error;
        *result++ = controller->watchdog.energy_gain;
        *result++ = controller->watchdog.unpaid_impulse;
        const jaxhil_contact_record record = jaxhil_last_contact(controller);
        *result++ = (double)record.number;
        *result++ = record.status;
        *result++ = (double)record.ticks;
        *result++ = (double)record.unsure;
        *result++ = (double)record.saturated;
        *result++ = (double)record.too_short;
        *result++ = (double)record.noisy;
    }
}

double driver_ticks(jaxhil_controller *controller, size_t count, const double *rows) {
    double sum = 0.0, wrench[6], pose[6];
    for (size_t n = 0; n < count; n++, rows += ROW) {
        jaxhil_step(controller, rows + 1, rows + 7, rows + 13, rows + 19, &rows[25], wrench);
        jaxhil_pose_command(controller, rows + 27, rows + 33, pose);
        sum += wrench[2] + pose[2];
    }
    return sum;
}

#ifdef DRIVER_MAIN
#include <stdio.h>

int main(void) {
    static jaxhil_controller controller;
    double row[ROW], result[RESULT];
    if (!driver_init(&controller)) {
        return 2;
    }
    while (fread(row, sizeof row, 1, stdin) == 1) {
        driver_run(&controller, 1, row, result);
        if (fwrite(result, sizeof result, 1, stdout) != 1) {
            return 2;
        }
    }
    return 0;
}
#endif
