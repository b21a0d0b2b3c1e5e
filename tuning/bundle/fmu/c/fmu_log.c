/* See fmu_log.h. */
#if defined(__unix__)
#define _POSIX_C_SOURCE 200809L /* for ftruncate */
#endif
#include "fmu_log.h"

#include <locale.h>
#include <string.h>
#if defined(__unix__)
#include <unistd.h>
#endif

enum { FLUSH_ROWS = 64 };

static bool is_text(uint32_t reference) {
    return reference < V_COUNT && fmu_variables[reference].type == FMU_STRING;
}

const char *fmu_set_text(const fmu_state *state, fmu_log *log, uint32_t reference, const char *value) {
    const size_t length = value == NULL ? 0 : strlen(value);
    if (value == NULL || !is_text(reference)) {
        return "no text, or no variable of this type has this value reference";
    }
    if (state->phase == FMU_STEPPING || state->phase == FMU_TERMINATED) {
        return "it is too late to set the value; reset the instance first";
    }
    if (length >= sizeof log->path || (length > 0 && (length < 5 || strcmp(value + length - 4, ".csv") != 0))) {
        return "expected a path of at most 1023 bytes that ends in .csv";
    }
    memcpy(log->path, value, length + 1);
    return NULL;
}

const char *fmu_get_text(const fmu_log *log, uint32_t reference, const char **value) {
    if (!is_text(reference)) {
        return "no variable of this type has this value reference";
    }
    *value = log->path;
    return NULL;
}

/* Create a file with this text; return NULL if it exists, or cannot be created. */
static FILE *create(const char *path, const char *text) {
    FILE *file = fopen(path, "rb");
    if (file != NULL) {
        fclose(file);
        return NULL;
    }
    file = fopen(path, "wb");
    if (file != NULL && (fputs(text, file) < 0 || fflush(file) != 0)) {
        fclose(file);
        remove(path);
        return NULL;
    }
    return file;
}

const char *fmu_open_log(fmu_log *log) {
    char mapping[sizeof log->path + 1];
    const size_t length = strlen(log->path);
    FILE *table;
    if (length == 0) {
        return NULL;
    }
    memcpy(mapping, log->path, length - 4);
    memcpy(mapping + length - 4, ".toml", 6);
    table = create(mapping, fmu_log_mapping);
    if (table == NULL) {
        return "the mapping of the flight log (.toml) cannot be created, or exists";
    }
    fclose(table);
    log->file = create(log->path, fmu_log_columns);
    if (log->file == NULL) {
        remove(mapping);
        return "the flight log cannot be created, or exists";
    }
    log->size = ftell(log->file);
    return NULL;
}

/* Write a number with 17 significant digits and a point, whatever the locale of the importing tool is. */
static void write_number(FILE *file, double value) {
    const char *const point = localeconv()->decimal_point;
    char text[64];
    char *separator;
    snprintf(text, sizeof text, "%.17g", value);
    separator = strstr(text, point);
    if (separator != NULL) {
        *separator = '.';
        memmove(separator + 1, separator + strlen(point), strlen(separator + strlen(point)) + 1);
    }
    fputs(value == value ? text : "nan", file);
}

/* Write the rows to the disk. After an error, close the file after its last complete row. */
static const char *flush(fmu_log *log) {
    if (fflush(log->file) == 0 && !ferror(log->file)) {
        log->size = ftell(log->file);
        log->rows = 0;
        return NULL;
    }
#if defined(__unix__)
    if (ftruncate(fileno(log->file), log->size) != 0) {
        /* the log ends with an incomplete row */
    }
#endif
    fclose(log->file);
    log->file = NULL;
    return "the flight log cannot be written, and ends here; the controller continues";
}

const char *fmu_write_log(fmu_log *log, const fmu_state *state) {
    double row[FMU_LOG_MAX_VALUES];
    size_t count;
    if (log->file == NULL) {
        return NULL;
    }
    count = fmu_model_row(state, row);
    for (size_t n = 0; n < count; n++) {
        write_number(log->file, row[n]);
        fputc(n + 1 < count ? ',' : '\n', log->file);
    }
    return count > 0 && ++log->rows >= FLUSH_ROWS ? flush(log) : NULL;
}

const char *fmu_close_log(fmu_log *log) {
    const char *problem = log->file == NULL ? NULL : flush(log);
    if (log->file != NULL && fclose(log->file) != 0) {
        problem = "the flight log cannot be closed";
    }
    memset(log, 0, sizeof *log);
    return problem;
}
