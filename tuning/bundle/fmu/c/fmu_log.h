/* Flight log of an instance: a file with one row for every step, only if the parameter `flight_log` is set.
 *
 * The log is no part of the state: if the importing tool restores a state, the rows of repeated steps remain.
 */
#ifndef FMU_LOG_H
#define FMU_LOG_H

#include <stdio.h>

#include "fmu.h"

typedef struct {
    char path[1024]; /* NAME.csv; empty for no log */
    FILE *file;
    long size;       /* of the complete rows [bytes] */
    unsigned rows;   /* number of rows since the last flush */
} fmu_log;

/* Set or get the parameter. */
const char *fmu_set_text(const fmu_state *state, fmu_log *log, uint32_t reference, const char *value);
const char *fmu_get_text(const fmu_log *log, uint32_t reference, const char **value);

/* Create the log and its mapping NAME.toml, which must not exist. */
const char *fmu_open_log(fmu_log *log);

/* Add a row for the last step. After an error, the log ends with a complete row. */
const char *fmu_write_log(fmu_log *log, const fmu_state *state);

/* Close the log, and forget its name. */
const char *fmu_close_log(fmu_log *log);

/* Provided by fmu_model.c: columns, mapping, and values of the last step. The function returns the number of
 * values; 0 if the step has no row. */
enum { FMU_LOG_MAX_VALUES = 40 };
extern const char *const fmu_log_columns, *const fmu_log_mapping;
size_t fmu_model_row(const fmu_state *state, double *row);

#endif
