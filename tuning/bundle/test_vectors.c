/* Replays recorded ticks (vectors.csv, argv[1]) through the controller and compares bit for bit.
 *
 * Exit code 0: all values are equal. 1: a line differs; the program prints its number, the column, and the
 * found and expected values. 2: the vectors cannot be read.
 */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

@controller@
static char line[65536];

static int is_same(double found, double expected) {
    return (isnan(found) && isnan(expected)) || memcmp(&found, &expected, sizeof found) == 0;
}

static int unreadable(const char *file, long number, const char *what) {
    fprintf(stderr, "%s:%ld: %s\n", file, number, what);
    return 2;
}

static int differs(const char *file, long number, const char *column, double found, double expected) {
    printf("%s:%ld: %s: found %.17g, expected %.17g\n", file, number, column, found, expected);
    return 1;
}

@columns@
/* Read the numbers of a row; return whether there are COLUMNS numbers. An empty field is NaN, with `given` 0. */
static int read_row(char *text, double *row, int *given) {
    for (int column = 0; column < COLUMNS; column++) {
        const char last = column + 1 < COLUMNS ? ',' : '\0';
        given[column] = *text != last;
        row[column] = NAN;
        if (given[column]) {
            char *end;
            row[column] = strtod(text, &end);
            if (end == text || *text == ' ' || *text == '\t') {
                return 0;
            }
            text = end;
        }
        if (*text != last) {
            return 0;
        }
        text += last == ',';
    }
    return 1;
}

/* Apply what precedes the row's tick: start of a run (1), start of the next contact (2), or nothing (0). */
static int begin(const char *name, long number, double event, int *begun) {
    if (event == 1.0) {
        *begun = 1;
        return start() ? 0 : unreadable(name, number, "the controller refuses its own gains");
    }
    if (event == 2.0 && *begun) {
        next_contact();
    } else if (event != 0.0 || !*begun) {
        return unreadable(name, number, "an unknown event, or a tick before a run");
    }
    return 0;
}

int main(int count, char **arguments) {
    const char *const name = count == 2 ? arguments[1] : "vectors.csv";
    FILE *const file = fopen(name, "rb");
    double row[COLUMNS];
    int given[COLUMNS];
    int begun = 0;
    int failed = 0;
    long number = 0;

    if (file == NULL) {
        return unreadable(name, 0, strerror(errno));
    }
    while (!failed && fgets(line, (int)sizeof line, file) != NULL) {
        number++;
        line[strcspn(line, "\r\n")] = '\0';
        if (number == 1) {
            failed = strcmp(line, header) != 0 ? unreadable(name, number, "unknown columns") : 0;
            continue;
        }
        failed = read_row(line, row, given) ? begin(name, number, row[EVENT], &begun)
                                            : unreadable(name, number, "not a row of numbers");
        failed = failed ? failed : replay(name, number, row, given);
    }
    if (!failed && (ferror(file) || number < 2)) {
        failed = unreadable(name, number, "no rows");
    }
    fclose(file);
    if (!failed) {
        printf("%s: %ld ticks, the same bit for bit\n", name, number - 1);
    }
    return failed;
}
