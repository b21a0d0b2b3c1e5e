/* Ticks in batches, for the tests: the controller, and the law below it without its guards.
 *
 * With DRIVER_MAIN a program: from standard input the gains and the rows, to standard output the results.
 */
#include <stdio.h>
#include <string.h>

#include "jaxhil_controller.c"
#include "jaxhil_gains.h"

/* A row: event, force, desired position and velocity, measured position, time, whether it is given, the
 * model's position, velocity and acceleration. A result: see `result`. */
enum { ROW = 10, RESULT = 26 };
enum { TICK, RESET, NEXT_CONTACT, STOP, RELEASE, TARE, COMMAND_FIRST, STEP_ONLY };
enum { GAINS = sizeof(jaxhil_gains) / sizeof(double), LIMITS = sizeof(jaxhil_limits) / sizeof(double) };

size_t driver_size(void);
size_t driver_exported(double *parameters);
int driver_init(jaxhil_controller *controller, const double *parameters);
void driver_law(jaxhil_controller *controller, size_t count, const double *rows, double *results);
void driver_run(jaxhil_controller *controller, size_t count, const double *rows, double *results);

size_t driver_size(void) {
    return sizeof(jaxhil_controller);
}

size_t driver_exported(double *parameters) {
    memcpy(parameters, &jaxhil_exported_gains, sizeof jaxhil_exported_gains);
    memcpy(parameters + GAINS, &jaxhil_exported_limits, sizeof jaxhil_exported_limits);
    return GAINS + LIMITS;
}

int driver_init(jaxhil_controller *controller, const double *parameters) {
    jaxhil_gains gains;
    jaxhil_limits limits;
    memcpy(&gains, parameters, sizeof gains);
    memcpy(&limits, parameters + GAINS, sizeof limits);
    return jaxhil_init(controller, &gains, &limits);
}

void driver_law(jaxhil_controller *controller, size_t count, const double *rows, double *results) {
    for (size_t n = 0; n < count; n++, rows += ROW, results += RESULT) {
        if (rows[0] == RESET) {
            jaxhil_law_reset(&controller->law);
        } else if (rows[0] == NEXT_CONTACT) {
            jaxhil_law_next_contact(&controller->law);
        }
        memset(results, 0, RESULT * sizeof *results);
#ifdef LAW_CAN_FAIL
        bool error = false;
        results[0] = jaxhil_law_step(&controller->law, rows[1], rows[2], rows[3], rows[4], &error);
        results[0] = error ? NAN : results[0];
#else
        results[0] = jaxhil_law_step(&controller->law, rows[1], rows[2], rows[3], rows[4]);
#endif
        results[1] = jaxhil_law_position_command(&controller->law, rows[7], rows[8], rows[9]);
        jaxhil_identified(controller, &results[2], &results[3]);
        results[4] = jaxhil_law_status(controller);
    }
}

static double event(jaxhil_controller *controller, const double *row) {
    const double code = row[0];
    if (code == RESET) {
        return jaxhil_reset(controller);
    }
    if (code == TARE) {
        return jaxhil_tare(controller, row[1]);
    }
    if (code == COMMAND_FIRST) {
        return jaxhil_position_command(controller, row[7], row[8], row[9]);
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
        const double *time = rows[6] != 0.0 ? &rows[5] : NULL;
        *result++ = jaxhil_step(controller, rows[1], rows[2], rows[3], rows[4], time);
        *result++ = rows[0] == STEP_ONLY ? 0.0 : jaxhil_position_command(controller, rows[7], rows[8], rows[9]);
        jaxhil_identified(controller, result, result + 1);
        result += 2;
        *result++ = jaxhil_law_status(controller);
        *result++ = controller->faults;
        *result++ = controller->seen;
        *result++ = controller->cause;
        *result++ = (double)jaxhil_missed_ticks(controller);
        *result++ = (double)jaxhil_late_ticks(controller);
        *result++ = jaxhil_at_rest(controller);
        *result++ = jaxhil_tripped(controller);
        *result++ = jaxhil_bias(controller);
        *result++ = answer;
        *result++ = (double)controller->watchdog.contacts;
        *result++ = controller->watchdog.restitution;
        *result++ = controller->watchdog.expected;
        *result++ = controller->watchdog.balance;
        const jaxhil_contact_record record = jaxhil_last_contact(controller);
        *result++ = (double)record.number;
        *result++ = record.status;
        *result++ = (double)record.ticks;
        *result++ = (double)record.unsure;
        *result++ = (double)record.saturated;
        *result++ = (double)record.too_short;
        *result++ = (double)record.noisy;
        *result++ = jaxhil_force_delay(controller);
    }
}

#ifdef DRIVER_MAIN
int main(int count, char **arguments) {
    static jaxhil_controller controller;
    double parameters[GAINS + LIMITS], row[ROW], result[RESULT];
    (void)arguments;
    if (fread(parameters, sizeof parameters, 1, stdin) != 1 || !driver_init(&controller, parameters)) {
        return 2;
    }
    while (fread(row, sizeof row, 1, stdin) == 1) {
        (count > 1 ? driver_law : driver_run)(&controller, 1, row, result);
        if (fwrite(result, sizeof result, 1, stdout) != 1) {
            return 2;
        }
    }
    return 0;
}
#endif
