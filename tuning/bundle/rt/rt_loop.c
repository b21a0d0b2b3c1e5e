/* Real-time loop of the controller and the numerical model on Linux, with one axis.
 *
 *     cc -std=c99 -O2 -ffp-contract=off -pthread -o rt_loop rt_loop.c rt_plant_udp.c jaxhil_controller.c -lm
 *     ./rt_loop [--log session.csv] [--cpu N] [--priority 80] [--seconds S] [--port 0]
 *
 * The plant (sensors and drives) is behind the four functions of `plant_io` in rt_loop.h. After the start, the
 * loop allocates no memory and writes no file: a second thread writes the log, which `jaxhil shadow` reads.
 * SIGTERM and SIGINT trip the controller; the loop ends when the drives are at rest out of contact. The exit
 * code is 1 if the plant is lost or the log cannot be written, and 2 for an unusable option.
 */
#ifdef __linux__
#define _GNU_SOURCE /* for the affinity to a processor */
#else
#define _POSIX_C_SOURCE 200809L
#endif
#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#include "jaxhil_controller.h"
#include "jaxhil_gains.h"
#include "rt_loop.h"

#define START_GRACE 0.1   /* s; overruns before this time are not counted */
#define LATE_SHARE 0.25   /* periods; if the loop wakes up later than this, it was woken too late */
#define BUDGET_SHARE 0.8  /* periods; a tick that computes for longer is an overrun */
#define SILENCE 2.0       /* s; the loop ends if there are no readings for this time */
#define STOP_TIME 5.0     /* s; longest time until the drives are at rest */
#define MAX_INTERPOLATED 10.0 /* ticks without readings in a row that are interpolated */
#define RING_ROWS 8192u   /* rows between both threads, a power of 2 */
#define LATENCIES 100000u /* us; length of the histograms */

volatile sig_atomic_t stop_requested = 0;

/* ---- Ring for the log: one thread adds rows, the other takes them, without a lock ---- */
typedef struct {
    double values[6]; /* time, force reading without bias, model's position and velocity, position, force */
    uint32_t contact, faults;
} log_row;

static struct {
    log_row rows[RING_ROWS];
    uint32_t added, taken; /* counters; each is written by one thread only */
    uint64_t lost;         /* rows that did not fit */
    bool ends;
    FILE *file;
} ring;

static void add_row(const log_row *row) {
    const uint32_t added = ring.added;
    if (added - __atomic_load_n(&ring.taken, __ATOMIC_ACQUIRE) == RING_ROWS) {
        ring.lost++;
        return;
    }
    ring.rows[added % RING_ROWS] = *row;
    __atomic_store_n(&ring.added, added + 1, __ATOMIC_RELEASE);
}

static void *write_log(void *unused) {
    const struct timespec pause = {0, 20000000};
    for (;;) {
        const bool ends = __atomic_load_n(&ring.ends, __ATOMIC_ACQUIRE);
        const uint32_t added = __atomic_load_n(&ring.added, __ATOMIC_ACQUIRE);
        for (uint32_t taken = ring.taken; taken != added; taken++) {
            const log_row *const row = &ring.rows[taken % RING_ROWS];
            if (ring.file != NULL) {
                for (int n = 0; n < 6; n++) {
                    const double value = row->values[n];
                    fprintf(ring.file, value == value ? "%.17g," : "nan,", value);
                }
                fprintf(ring.file, "%u,%u\n", (unsigned)row->contact, (unsigned)row->faults);
            }
            __atomic_store_n(&ring.taken, taken + 1, __ATOMIC_RELEASE);
        }
        if (ends) {
            return unused;
        }
        nanosleep(&pause, NULL);
    }
}

/* Create the log NAME.csv and its mapping NAME.toml, which must not exist; return false on an error. */
static bool create_log(const char *path) {
    char mapping[4096];
    const size_t length = strlen(path);
    if (length < 5 || length >= sizeof mapping || strcmp(path + length - 4, ".csv") != 0) {
        fprintf(stderr, "rt_loop: --log: expected a name that ends in .csv\n");
        return false;
    }
    memcpy(mapping, path, length - 4);
    memcpy(mapping + length - 4, ".toml", 6);
    FILE *const table = access(path, F_OK) != 0 && access(mapping, F_OK) != 0 ? fopen(mapping, "w") : NULL;
    ring.file = table == NULL ? NULL : fopen(path, "w");
    if (ring.file == NULL) {
        fprintf(stderr, "rt_loop: %s: cannot be created, or exists\n", path);
        return false;
    }
    fputs(MAPPING, table);
    fclose(table);
    fputs("time,force_measured,position_desired,velocity_desired,position_measured,force_command,contact,faults\n",
          ring.file);
    return true;
}

/* ---- One tick of controller and numerical model ---- */
static struct {
    jaxhil_controller controller;
    double position, velocity, acceleration, force, command;
    uint32_t run, tick, contact;
    readings last; /* of the last tick */
    bool has_run, is_tared;
} loop;

static void move_model(void) {
    const double acceleration = -loop.force / EQUIVALENT_MASS;
    const double before = loop.velocity, after = before + PERIOD * acceleration;
    loop.position += MODEL_STEP(before, acceleration, after);
    loop.velocity = after;
    loop.acceleration = acceleration;
}

static void command_position(void) {
    loop.command =
        jaxhil_position_command(&loop.controller, loop.position, loop.velocity, loop.acceleration);
}

/* Tare the sensor while the drives wait, then place the model at the start of the run. */
static unsigned prepare(const readings *now) {
    if (now->event == RESET && (!loop.has_run || now->run != loop.run)) {
        jaxhil_reset(&loop.controller);
    }
    if (loop.has_run && now->run == loop.run) {
        return READY;
    }
    loop.is_tared = loop.is_tared || jaxhil_tare(&loop.controller, now->force);
    if (!loop.is_tared) {
        return TARING;
    }
    if (loop.has_run) {
        jaxhil_next_contact(&loop.controller);
        loop.contact++;
    }
    const bool is_given = isfinite(now->start_position) && isfinite(now->start_velocity);
    loop.position = is_given ? now->start_position : START_POSITION;
    loop.velocity = is_given ? now->start_velocity : START_VELOCITY;
    loop.acceleration = loop.force = 0.0;
    loop.has_run = true;
    loop.run = now->run;
    loop.tick = UINT32_MAX; /* the tick before tick 0 */
    command_position();
    return READY;
}

/* Step controller and model by one tick; add a row to the log. */
static void tick(double force, double position, double time, bool is_first) {
    log_row row = {{time, force - jaxhil_bias(&loop.controller), loop.position, loop.velocity, position, 0.0},
                   loop.contact, 0};
    loop.force = jaxhil_step(&loop.controller, force, loop.position, loop.velocity, position, &time);
    if (HAS_NOISE_OR_BIAS && is_first) {
        loop.force = 0.0; /* the mechanism is free: noise must not act on the model */
    }
    move_model();
    command_position();
    row.values[5] = loop.force;
    row.faults = loop.controller.faults | loop.controller.cause;
    add_row(&row);
}

/* Make up for ticks whose readings are missing. Execute a few ticks with interpolated readings. If more ticks
 * are missing, only the model moves, under the last force, and the controller detects the gap in the time. */
static void catch_up(const readings *now, uint32_t missed) {
    const double most = jaxhil_exported_limits.missed_in_a_row;
    if ((double)missed > (most < MAX_INTERPOLATED ? most : MAX_INTERPOLATED)) {
        for (uint32_t n = 0; n < missed && n < 10000; n++) {
            move_model();
        }
        return;
    }
    const bool has_last = loop.tick != UINT32_MAX;
    for (uint32_t n = 0; n < missed; n++) {
        const double weight = has_last ? (double)(n + 1) / (double)(missed + 1) : 1.0;
        tick(loop.last.force + weight * (now->force - loop.last.force),
             loop.last.position + weight * (now->position - loop.last.position),
             now->time - (double)(missed - n) * PERIOD, loop.tick + 1 + n == 0);
    }
}

/* Compute the commands for these readings; return false if they belong to no prepared run. */
static bool compute(const readings *now, commands *answer) {
    if (now->event != TICK) {
        answer->flags = prepare(now);
        answer->model_position = loop.position;
        answer->model_velocity = answer->rate = loop.velocity;
        answer->force = 0.0;
    } else if (!loop.has_run || now->run != loop.run || (int32_t)(now->tick - loop.tick) <= 0) {
        return false;
    } else {
        catch_up(now, now->tick - loop.tick - 1);
        const double before = loop.command;
        answer->flags = 0;
        answer->model_position = loop.position;
        answer->model_velocity = loop.velocity;
        tick(now->force, now->position, now->time, now->tick == 0);
        loop.tick = now->tick;
        loop.last = *now;
        answer->rate = jaxhil_tripped(&loop.controller) ? (loop.command - before) / PERIOD : loop.velocity;
        answer->force = loop.force;
    }
    answer->position = loop.command;
    answer->faults = loop.controller.faults;
    answer->cause = loop.controller.cause;
    answer->flags |= jaxhil_tripped(&loop.controller) ? TRIPPED : 0;
    return true;
}

/* ---- Loop with absolute deadlines ---- */
static struct {
    uint64_t periods, ticks, without_readings, woken_late, too_long, skipped, not_sent;
    uint32_t lateness[LATENCIES + 1], computing[LATENCIES + 1]; /* histograms [us] */
} report;

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static void count_latency(uint32_t *histogram, int64_t ns) {
    const int64_t us = ns < 0 ? 0 : ns / 1000;
    histogram[us < LATENCIES ? us : LATENCIES]++;
}

/* Run until the plant or a signal ends the loop; return false if the plant is lost. */
static bool run_loop(const plant_io *io, double seconds) {
    const int64_t period = (int64_t)(1e9 * PERIOD + 0.5), begin = now_ns();
    const int64_t end = seconds > 0.0 ? begin + (int64_t)(1e9 * seconds) : INT64_MAX;
    int64_t due = begin, last_readings = begin, stopped = 0;
    readings now;
    commands answer;
    for (;;) {
        due += period;
        const struct timespec until = {(time_t)(due / 1000000000), (long)(due % 1000000000)};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {
        }
        const int64_t woken = now_ns();
        const bool counts = woken - begin > (int64_t)(1e9 * START_GRACE);
        report.periods++;
        if (counts) {
            count_latency(report.lateness, woken - due);
            report.woken_late += (double)(woken - due) > LATE_SHARE * (double)period;
        }
        if ((stop_requested || woken > end) && stopped == 0) {
            stopped = woken;
            jaxhil_emergency_stop(&loop.controller, true); /* the force fades, the drives come to rest */
        }
        if (stopped != 0 && (!loop.has_run || (jaxhil_at_rest(&loop.controller) && loop.force == 0.0) ||
                             (double)(woken - stopped) > 1e9 * STOP_TIME)) {
            return true;
        }
        if (io->read(io->plant, &now)) {
            const int64_t started = last_readings = now_ns();
            due += (int64_t)(1e9 * now.shift);
            if (now.event == STOP || (stopped != 0 && now.event != TICK)) {
                return true;
            }
            if (compute(&now, &answer)) {
                report.ticks += now.event == TICK;
                report.not_sent += !io->write(io->plant, &answer);
            }
            const int64_t duration = now_ns() - started;
            if (counts) {
                count_latency(report.computing, duration);
                report.too_long += (double)duration > BUDGET_SHARE * (double)period;
            }
        } else {
            report.without_readings += counts;
            if ((double)(woken - last_readings) > 1e9 * SILENCE) {
                return false;
            }
        }
        for (const int64_t finished = now_ns(); due + period <= finished; due += period) {
            report.skipped += counts; /* the deadline has passed: continue with the next one */
        }
    }
}

static void request_stop(int number) {
    (void)number;
    stop_requested = 1;
}

static void print_latency(const char *name, const uint32_t *histogram) {
    const double shares[3] = {0.5, 0.999, 1.0};
    uint64_t total = 0, sum = 0;
    uint32_t us = 0;
    for (uint32_t n = 0; n <= LATENCIES; n++) {
        total += histogram[n];
    }
    printf("%s_us", name);
    for (int n = 0; n < 3; n++) {
        while (us < LATENCIES && (double)(sum + histogram[us]) < shares[n] * (double)total) {
            sum += histogram[us++];
        }
        printf(" %u", (unsigned)us);
    }
    printf("\n");
}

/* Lock the memory, and request the processor and the priority; continue without what is not permitted. */
static void request_real_time(long cpu, int priority) {
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) {
        fprintf(stderr, "rt_loop: note: memory is not locked: %s\n", strerror(errno));
    }
#ifdef __linux__
    if (cpu >= 0) {
        cpu_set_t set;
        CPU_ZERO(&set);
        CPU_SET((size_t)cpu, &set);
        if (sched_setaffinity(0, sizeof set, &set) != 0) {
            fprintf(stderr, "rt_loop: note: processor %ld is not available: %s\n", cpu, strerror(errno));
        }
    }
#endif
    const struct sched_param parameters = {.sched_priority = priority};
    const int error = priority > 0 ? pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameters) : 0;
    if (error != 0) {
        fprintf(stderr, "rt_loop: note: no real-time priority: %s\n", strerror(error));
    }
}

int main(int count, char **arguments) {
    const plant_io *const io = &rt_plant;
    const char *path = NULL;
    double seconds = 0.0;
    long cpu = -1, priority = 80;
    if (count % 2 == 0) {
        fprintf(stderr, "rt_loop: %s: found no value\n", arguments[count - 1]);
        return 2;
    }
    for (int n = 1; n + 1 < count; n += 2) {
        const char *const name = arguments[n], *const value = arguments[n + 1];
        if (strcmp(name, "--log") == 0) {
            path = value;
        } else if (strcmp(name, "--seconds") == 0) {
            seconds = strtod(value, NULL);
        } else if (strcmp(name, "--cpu") == 0) {
            cpu = strtol(value, NULL, 10);
        } else if (strcmp(name, "--priority") == 0) {
            priority = strtol(value, NULL, 10);
        } else if (!rt_plant_option(name, value)) {
            fprintf(stderr, "rt_loop: %s: unknown option\n", name);
            return 2;
        }
    }
    if (!jaxhil_init(&loop.controller, &jaxhil_exported_gains, &jaxhil_exported_limits)) {
        fprintf(stderr, "rt_loop: jaxhil_gains.h: a gain or limit is out of its range\n");
        return 2;
    }
    if (path != NULL && !create_log(path)) {
        return 2;
    }
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = request_stop;
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    pthread_t writer; /* starts before the priority is raised, and therefore does not inherit it */
    if (pthread_create(&writer, NULL, write_log, NULL) != 0) {
        return 2;
    }
    bool is_complete = io->open(io->plant);
    if (is_complete) {
        request_real_time(cpu, (int)priority);
        is_complete = run_loop(io, seconds);
        io->close(io->plant);
        if (!is_complete) {
            fprintf(stderr, "rt_loop: plant: found no readings for %g s, expected some\n", SILENCE);
        }
    }
    __atomic_store_n(&ring.ends, true, __ATOMIC_RELEASE);
    pthread_join(writer, NULL);
    const bool is_written = ring.file == NULL || fclose(ring.file) == 0;
    printf("periods %llu\nticks %llu\nwithout_readings %llu\nwoken_late %llu\ntoo_long %llu\nskipped %llu\n",
           (unsigned long long)report.periods, (unsigned long long)report.ticks,
           (unsigned long long)report.without_readings, (unsigned long long)report.woken_late,
           (unsigned long long)report.too_long, (unsigned long long)report.skipped);
    printf("not_sent %llu\nlost_rows %llu\nfaults %u\n", (unsigned long long)report.not_sent,
           (unsigned long long)ring.lost, (unsigned)loop.controller.seen);
    print_latency("lateness", report.lateness);
    print_latency("computing", report.computing);
    printf("at_rest %d\n", !loop.has_run || jaxhil_at_rest(&loop.controller));
    return is_complete && is_written ? 0 : 1;
}
