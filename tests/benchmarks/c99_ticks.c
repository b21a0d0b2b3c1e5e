/* Time of a tick: `c99_ticks ROWS REPEATS` runs the driver's rows (doubles, standard input) REPEATS times
 * through the controller, and through a loop that only adds them up. Prints nanoseconds a tick, the best of
 * the repeats: the bare loop's, the controller's; the ticks in contact; the cause of a trip, 0 if none.
 */
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "jaxhil_controller.h"
#include "jaxhil_gains.h"

enum { ROW = 10 };

static double bare(size_t count, const double *rows) {
    double sum = 0.0;
    for (size_t n = 0; n < count; n++, rows += ROW) {
        sum += rows[1] + rows[2] + rows[3] + rows[4] + rows[5] + rows[7] + rows[8] + rows[9];
    }
    return sum;
}

static double ticks(jaxhil_controller *controller, size_t count, const double *rows) {
    double sum = 0.0;
    jaxhil_next_contact(controller);
    for (size_t n = 0; n < count; n++, rows += ROW) {
        sum += jaxhil_step(controller, rows[1], rows[2], rows[3], rows[4], &rows[5]);
        sum += jaxhil_position_command(controller, rows[7], rows[8], rows[9]);
    }
    return sum;
}

int main(int argc, char **argv) {
    static jaxhil_controller controller;
    static volatile double sink;
    const size_t count = argc > 2 ? strtoul(argv[1], NULL, 10) : 0;
    const long repeats = argc > 2 ? atol(argv[2]) : 0;
    double *rows = malloc((count + 1) * ROW * sizeof *rows);
    double best[2] = {1e30, 1e30};
    size_t contact = 0;
    if (rows == NULL || fread(rows, ROW * sizeof *rows, count, stdin) != count || count == 0 ||
        !jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits)) {
        return 2;
    }
    for (size_t n = 0; n < count; n++) {
        contact += rows[n * ROW + 4] > 0.0;
    }
    for (long repeat = 0; repeat < repeats; repeat++) {
        for (int which = 0; which < 2; which++) {
            const clock_t begin = clock();
            sink = which ? ticks(&controller, count, rows) : bare(count, rows);
            const double spent = (double)(clock() - begin) / CLOCKS_PER_SEC / (double)count * 1e9;
            best[which] = spent < best[which] ? spent : best[which];
        }
    }
    (void)sink;
    printf("%.17g %.17g %lu %u\n", best[0], best[1], (unsigned long)contact, (unsigned)controller.cause);
    free(rows);
    return 0;
}
