/* Time of a tick: `c99_ticks ROWS REPEATS` runs the driver's rows (doubles, standard input) REPEATS times
 * through the controller, and through a loop that only adds them up; a row whose first number is not 0 begins
 * a contact. Prints nanoseconds a tick, the best of
 * the repeats: the bare loop's, the controller's; the ticks in contact; the cause of a trip, 0 if none; of the ticks in
 * contact the 99.9th percentile, each the least of some repeats.
 */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "jaxhil_controller.h"
#include "jaxhil_gains.h"

enum { ROW = 10, LONGEST = 5 };

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
        if (rows[0] > 0.0) {
            jaxhil_next_contact(controller);
        }
        sum += jaxhil_step(controller, rows[1], rows[2], rows[3], rows[4], &rows[5]);
        sum += jaxhil_position_command(controller, rows[7], rows[8], rows[9]);
    }
    return sum;
}

static int shorter(const void *a, const void *b) {
    const double one = *(const double *)a, other = *(const double *)b;
    return (one > other) - (one < other);
}

/* The 99.9th percentile of the ticks in contact [ns], of the processor: the machine is shared. */
static double longest(jaxhil_controller *controller, size_t count, const double *rows, size_t contact) {
    double *least = malloc((contact + 1) * sizeof *least);
    for (int repeat = 0; least != NULL && repeat < LONGEST; repeat++) {
        const double *row = rows;
        size_t place = 0;
        jaxhil_next_contact(controller);
        for (size_t n = 0; n < count; n++, row += ROW) {
            struct timespec begin, end;
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &begin);
            jaxhil_step(controller, row[1], row[2], row[3], row[4], &row[5]);
            jaxhil_position_command(controller, row[7], row[8], row[9]);
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
            const double spent = 1e9 * (double)(end.tv_sec - begin.tv_sec) + (double)(end.tv_nsec - begin.tv_nsec);
            if (row[4] > 0.0) {
                least[place] = repeat > 0 && least[place] < spent ? least[place] : spent;
                place++;
            }
        }
    }
    if (least == NULL || contact == 0) {
        free(least);
        return 0.0;
    }
    qsort(least, contact, sizeof *least, shorter);
    const double tail = least[(contact - 1) * 999 / 1000];
    free(least);
    return tail;
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
    const double tail = longest(&controller, count, rows, contact);
    printf("%.17g %.17g %lu %u %.17g\n", best[0], best[1], (unsigned long)contact, (unsigned)controller.cause, tail);
    free(rows);
    return 0;
}
