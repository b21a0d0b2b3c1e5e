/* Plant for tests of the real-time loop: a free mechanism, and delays at every 20th call.
 *
 * --slow read: the plant's read sleeps; --slow write: its write sleeps; --slow step: the controller computes.
 * The linker passes the calls of jaxhil_step to __wrap_jaxhil_step (option --wrap=jaxhil_step).
 */
#define _POSIX_C_SOURCE 200809L
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "jaxhil_controller.h"
#include "rt_loop.h"

double __real_jaxhil_step(jaxhil_controller *, double, double, double, double, const double *);
double __wrap_jaxhil_step(jaxhil_controller *, double, double, double, double, const double *);

static const char *slow = "";
static double begin;
static unsigned calls[3];

static double seconds(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static bool is_slow(const char *name, unsigned *count) {
    return ++*count % 20 == 0 && strcmp(slow, name) == 0;
}

static void sleep_ms(long ms) {
    const struct timespec pause = {0, ms * 1000000};
    nanosleep(&pause, NULL);
}

double __wrap_jaxhil_step(jaxhil_controller *controller, double force, double position, double velocity,
                          double measured, const double *time) {
    if (is_slow("step", &calls[0])) {
        const double end = seconds(CLOCK_THREAD_CPUTIME_ID) + 3e-3;
        while (seconds(CLOCK_THREAD_CPUTIME_ID) < end) {
        }
    }
    return __real_jaxhil_step(controller, force, position, velocity, measured, time);
}

static bool open_plant(void *plant) {
    (void)plant;
    begin = seconds(CLOCK_MONOTONIC);
    printf("open\n");
    fflush(stdout);
    return true;
}

static bool read_plant(void *plant, readings *now) {
    static bool is_prepared;
    (void)plant;
    if (is_slow("read", &calls[1])) {
        sleep_ms(3);
    }
    memset(now, 0, sizeof *now);
    now->event = is_prepared ? TICK : PREPARE;
    is_prepared = true;
    now->run = 1;
    now->time = seconds(CLOCK_MONOTONIC) - begin;
    now->tick = (uint32_t)(now->time / PERIOD);
    now->position[0] = now->start[0] = -1.0;
    return true;
}

static bool write_plant(void *plant, const commands *answer) {
    (void)plant, (void)answer;
    if (is_slow("write", &calls[2])) {
        sleep_ms(3);
    }
    return true;
}

static void close_plant(void *plant) { (void)plant; }

bool rt_plant_option(const char *name, const char *value) {
    slow = value;
    return strcmp(name, "--slow") == 0;
}

const plant_io rt_plant = {open_plant, read_plant, write_plant, close_plant, NULL};
