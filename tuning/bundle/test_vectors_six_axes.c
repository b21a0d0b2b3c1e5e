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

#include "jaxhil_controller.h"
#include "jaxhil_gains.h"

/* Index of each quantity's first column; a vector has six columns. */
enum {
    RUN = 0,
    EVENT = 1,
    WRENCH_MEASURED = 2,
    POSE_DESIRED = 8,
    TWIST_DESIRED = 14,
    POSE_MEASURED = 20,
    TIME = 26,
    POSE = 27,
    TWIST = 33,
    WRENCH_COMMAND = 39,
    POSE_COMMAND = 45,
    FAULTS = 51,
    WRENCH_SIMULATED = 52,
    COLUMNS = 58
};

static const char header[] =
    "run,event,wrench_measured_x,wrench_measured_y,wrench_measured_z,wrench_measured_rx,"
    "wrench_measured_ry,wrench_measured_rz,pose_desired_x,pose_desired_y,pose_desired_z,"
    "pose_desired_rx,pose_desired_ry,pose_desired_rz,twist_desired_x,twist_desired_y,twist_desired_z,"
    "twist_desired_rx,twist_desired_ry,twist_desired_rz,pose_measured_x,pose_measured_y,"
    "pose_measured_z,pose_measured_rx,pose_measured_ry,pose_measured_rz,time,pose_x,pose_y,pose_z,"
    "pose_rx,pose_ry,pose_rz,twist_x,twist_y,twist_z,twist_rx,twist_ry,twist_rz,wrench_command_x,"
    "wrench_command_y,wrench_command_z,wrench_command_rx,wrench_command_ry,wrench_command_rz,"
    "pose_command_x,pose_command_y,pose_command_z,pose_command_rx,pose_command_ry,pose_command_rz,"
    "faults,wrench_simulated_x,wrench_simulated_y,wrench_simulated_z,wrench_simulated_rx,"
    "wrench_simulated_ry,wrench_simulated_rz";

static jaxhil_controller controller;
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

/* The row's numbers; an empty field is NaN and `given` 0. False if the line is not COLUMNS numbers. */
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

/* One row through the controller: 0 if it does what the row says. */
static int replay(const char *name, long number, const double *row, const int *given) {
    double wrench[6], pose[6];
    jaxhil_step(&controller, row + WRENCH_MEASURED, row + POSE_DESIRED, row + TWIST_DESIRED,
                row + POSE_MEASURED, given[TIME] ? &row[TIME] : NULL, wrench);
    jaxhil_pose_command(&controller, row + POSE, row + TWIST, pose);
    const double faults = (double)controller.faults;
    for (int axis = 0; axis < 6; axis++) {
        if (!is_same(wrench[axis], row[WRENCH_COMMAND + axis])) {
            return differs(name, number, "wrench_command", wrench[axis], row[WRENCH_COMMAND + axis]);
        }
        if (!is_same(pose[axis], row[POSE_COMMAND + axis])) {
            return differs(name, number, "pose_command", pose[axis], row[POSE_COMMAND + axis]);
        }
    }
    return is_same(faults, row[FAULTS]) ? 0 : differs(name, number, "faults", faults, row[FAULTS]);
}

/* What comes before the row's tick: a run begins (1), the next contact does (2), nothing (0). */
static int begin(const char *name, long number, double event, int *begun) {
    if (event == 1.0) {
        *begun = 1;
        return jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits,
                           &jaxhil_exported_constants)
                   ? 0
                   : unreadable(name, number, "the controller refuses its own gains");
    }
    if (event == 2.0 && *begun) {
        jaxhil_next_contact(&controller);
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
