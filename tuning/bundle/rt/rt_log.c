/* See rt_log.h. The rows wait in a ring. If the disk is full, the log ends with a complete row, and the loop
 * continues without it.
 */
#define _POSIX_C_SOURCE 200809L
#include "rt_log.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define RING_ROWS 8192u   /* rows between both threads, a power of 2 */
#define BATCH_ROWS 64u    /* largest number of rows that are written together */
#define ROW_SIZE (32 * ROW_VALUES) /* bytes, more than the longest row */

static struct {
    log_row rows[RING_ROWS];
    uint32_t added, taken; /* counters; each is written by one thread only */
    uint64_t lost;         /* rows that did not fit */
    bool ends, failed;
    int file;              /* or -1 */
    const char *path;
    pthread_t writer;
} ring = {.file = -1};

void add_row(const log_row *row) {
    const uint32_t added = ring.added;
    if (added - __atomic_load_n(&ring.taken, __ATOMIC_ACQUIRE) == RING_ROWS) {
        ring.lost++;
        return;
    }
    ring.rows[added % RING_ROWS] = *row;
    __atomic_store_n(&ring.added, added + 1, __ATOMIC_RELEASE);
}

/* Write the whole text, or nothing: return false on an error, and remove what was written of the text. */
static bool write_text(int file, const char *text, size_t size) {
    const off_t begin = lseek(file, 0, SEEK_CUR);
    while (size > 0) {
        const ssize_t written = write(file, text, size);
        if (written < 0 && errno != EINTR) {
            const int error = errno;
            const bool is_cut = begin >= 0 && ftruncate(file, begin) == 0;
            errno = is_cut ? error : errno;
            return false;
        }
        text += written > 0 ? written : 0;
        size -= written > 0 ? (size_t)written : 0;
    }
    return true;
}

/* Append a row to the text; return its new end. */
static char *format_row(const log_row *row, char *text) {
    for (int n = 0; n < ROW_VALUES; n++) {
        const double value = row->values[n];
        text += value == value ? sprintf(text, "%.17g,", value) : sprintf(text, "nan,");
    }
    return text + sprintf(text, "%u,%u\n", (unsigned)row->contact, (unsigned)row->faults);
}

/* Write the rows up to the counter `added`. */
static void write_rows(uint32_t added) {
    static char text[BATCH_ROWS * ROW_SIZE];
    while (ring.taken != added) {
        uint32_t taken = ring.taken;
        char *end = text;
        for (; taken != added && taken - ring.taken < BATCH_ROWS; taken++) {
            end = format_row(&ring.rows[taken % RING_ROWS], end);
        }
        if (ring.file >= 0 && !ring.failed && !write_text(ring.file, text, (size_t)(end - text))) {
            ring.failed = true;
            fprintf(stderr, "rt_loop: %s: cannot be written: %s; the log ends here, the loop continues\n",
                    ring.path, strerror(errno));
        }
        __atomic_store_n(&ring.taken, taken, __ATOMIC_RELEASE);
    }
}

static void *write_log(void *unused) {
    const struct timespec pause = {0, 20000000};
    for (;;) {
        const bool ends = __atomic_load_n(&ring.ends, __ATOMIC_ACQUIRE);
        write_rows(__atomic_load_n(&ring.added, __ATOMIC_ACQUIRE));
        if (ends) {
            return unused;
        }
        nanosleep(&pause, NULL);
    }
}

/* Create a file with this text; return its descriptor, or report an error and return -1. */
static int create_file(const char *path, const char *text) {
    const int file = open(path, O_WRONLY | O_CREAT | O_EXCL, 0666);
    if (file < 0 || !write_text(file, text, strlen(text))) {
        fprintf(stderr, "rt_loop: %s: cannot be created: %s\n", path, strerror(errno));
        if (file >= 0) {
            close(file);
            unlink(path);
        }
        return -1;
    }
    return file;
}

bool create_log(const char *path) {
    char mapping[4096];
    const size_t length = strlen(path);
    if (length < 5 || length >= sizeof mapping || strcmp(path + length - 4, ".csv") != 0) {
        fprintf(stderr, "rt_loop: --log: expected a name that ends in .csv\n");
        return false;
    }
    memcpy(mapping, path, length - 4);
    memcpy(mapping + length - 4, ".toml", 6);
    const int table = create_file(mapping, MAPPING);
    if (table < 0) {
        return false;
    }
    close(table);
    ring.path = path;
    ring.file = create_file(path, HEADING);
    if (ring.file < 0) {
        unlink(mapping);
    }
    return ring.file >= 0;
}

bool start_log(void) {
    return pthread_create(&ring.writer, NULL, write_log, NULL) == 0;
}

bool finish_log(void) {
    __atomic_store_n(&ring.ends, true, __ATOMIC_RELEASE);
    pthread_join(ring.writer, NULL);
    return (ring.file < 0 || close(ring.file) == 0) && !ring.failed;
}

uint64_t lost_rows(void) {
    return ring.lost;
}
