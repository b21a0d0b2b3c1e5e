/* Ticks in batches, for the tests: the controller, and the law below it without its guards.
 *
 * With DRIVER_MAIN a program: from standard input the gains and the rows, to standard output the results.
 */
#include <stdio.h>
#include <string.h>

#include "jaxhil_controller.c"
#include "jaxhil_gains.h"

/* A row: event, force, desired position and velocity, measured position, time, whether it is given, the
 * model's position, velocity and acceleration. A result: see below. */
enum { ROW = 10, RESULT = 6, GAINS = sizeof(jaxhil_gains) / sizeof(double) };
enum { TICK, RESET, NEXT_CONTACT };

size_t driver_size(void);
size_t driver_gains(double *gains);
int driver_init(jaxhil_controller *controller, const double *gains);
void driver_law(jaxhil_controller *controller, size_t count, const double *rows, double *results);
void driver_run(jaxhil_controller *controller, size_t count, const double *rows, double *results);

size_t driver_size(void) {
    return sizeof(jaxhil_controller);
}

size_t driver_gains(double *gains) {
    memcpy(gains, &jaxhil_exported_gains, sizeof jaxhil_exported_gains);
    return GAINS;
}

int driver_init(jaxhil_controller *controller, const double *gains) {
    jaxhil_gains loaded;
    memcpy(&loaded, gains, sizeof loaded);
    return jaxhil_init(controller, &loaded);
}

void driver_law(jaxhil_controller *controller, size_t count, const double *rows, double *results) {
    jaxhil_law *law = &controller->law;
    for (size_t n = 0; n < count; n++, rows += ROW, results += RESULT) {
        if (rows[0] == RESET) {
            jaxhil_law_reset(law);
        } else if (rows[0] == NEXT_CONTACT) {
            jaxhil_law_next_contact(law);
        }
        results[0] = jaxhil_law_step(law, rows[1], rows[2], rows[3], rows[4]);
        results[1] = jaxhil_law_position_command(law, rows[7], rows[8], rows[9]);
        jaxhil_law_identified(law, &results[2], &results[3]);
        results[4] = 0.0;
        results[5] = 0.0;
    }
}

void driver_run(jaxhil_controller *controller, size_t count, const double *rows, double *results) {
    for (size_t n = 0; n < count; n++, rows += ROW, results += RESULT) {
        if (rows[0] == RESET) {
            jaxhil_reset(controller);
        } else if (rows[0] == NEXT_CONTACT) {
            jaxhil_next_contact(controller);
        }
        results[0] =
            jaxhil_step(controller, rows[1], rows[2], rows[3], rows[4], rows[6] != 0.0 ? &rows[5] : NULL);
        results[1] = jaxhil_position_command(controller, rows[7], rows[8], rows[9]);
        jaxhil_identified(controller, &results[2], &results[3]);
        results[4] = controller->status == JAXHIL_OK ? 0.0 : 1.0;
        results[5] = (double)controller->missed_ticks;
    }
}

#ifdef DRIVER_MAIN
int main(int count, char **arguments) {
    static jaxhil_controller controller;
    double gains[GAINS], row[ROW], result[RESULT];
    (void)arguments;
    if (fread(gains, sizeof gains, 1, stdin) != 1 || !driver_init(&controller, gains)) {
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
