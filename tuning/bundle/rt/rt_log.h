/* Log of the real-time loop: one thread adds rows, another one writes them to a file. */
#ifndef RT_LOG_H
#define RT_LOG_H

#include <stdbool.h>
#include <stdint.h>

#include "rt_loop.h"

enum { ROW_VALUES = 1 + 5 * AXES };

typedef struct {
    double values[ROW_VALUES]; /* time, force reading without bias, model's position and velocity, position, force */
    uint32_t contact, faults;
} log_row;

/* Create the log NAME.csv and its mapping NAME.toml, which must not exist; report an error and return false. */
bool create_log(const char *path);

/* Start the thread that writes; return false on an error. */
bool start_log(void);

/* Add a row without waiting and without a lock; the row is lost if the buffer is full. */
void add_row(const log_row *row);

/* Write the remaining rows and close the file; return false if a row could not be written. */
bool finish_log(void);

/* Return the number of rows for which the buffer was full. */
uint64_t lost_rows(void);

#endif
