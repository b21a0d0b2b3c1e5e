/* Real-time loop of the controller and the numerical model on Linux, with one axis.
 *
 *     cc -std=c99 -O2 -ffp-contract=off -pthread -o rt_loop rt_loop.c rt_log.c rt_plant_udp.c \
 *         jaxhil_controller.c -lm
 *     ./rt_loop [--log session.csv] [--cpu N] [--priority 80] [--seconds S] [--port 0]
 *
 * The plant (sensors and drives) is behind the four functions of `plant_io` in rt_loop.h. After the start, the
 * loop allocates no memory and writes no file: a second thread writes the log, which `jaxhil shadow` reads.
 * SIGTERM, SIGINT and SIGHUP trip the controller; the loop ends when the drives are at rest out of contact. The
 * exit code is 1 if the plant is lost or the log cannot be written, and 2 for an unusable option.
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
#include "rt_log.h"
#include "rt_loop.h"

#define START_GRACE 0.1   /* s; overruns before this time are not counted */
#define LATE_SHARE 0.25   /* periods; if the loop wakes up later than this, it was woken too late */
#define BUDGET_SHARE 0.8  /* periods; computation, or plant, that takes longer is an overrun */
#define SILENCE 2.0       /* s; the loop ends if there are no readings for this time */
#define STOP_TIME 5.0     /* s; longest time until the drives are at rest */
#define MAX_INTERPOLATED 10.0 /* ticks without readings in a row that are interpolated */
#define LATENCIES 100000u /* us; length of the histograms */

volatile sig_atomic_t stop_requested = 0;

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
enum { WAKING, PLANT, COMPUTING, INTERRUPTION, CAUSES }; /* causes of a missed deadline */

static struct {
    uint64_t periods, ticks, without_readings, skipped, not_sent;
    uint64_t overruns[CAUSES], skipped_after[CAUSES]; /* periods that exceed a limit, skipped deadlines */
    uint32_t lateness[LATENCIES + 1], computing[LATENCIES + 1]; /* histograms [us] */
} report;

static int64_t read_clock(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static int64_t now_ns(void) {
    return read_clock(CLOCK_MONOTONIC);
}

static void count_latency(uint32_t *histogram, int64_t ns) {
    const int64_t us = ns < 0 ? 0 : ns / 1000;
    histogram[us < LATENCIES ? us : LATENCIES]++;
}

/* Compute the commands; measure the processor time, and the time during which other work had the processor. */
static bool compute_timed(const readings *now, commands *answer, int64_t *spent) {
    const int64_t started = now_ns(), processor = read_clock(CLOCK_THREAD_CPUTIME_ID);
    const bool has_answer = compute(now, answer);
    spent[COMPUTING] = read_clock(CLOCK_THREAD_CPUTIME_ID) - processor;
    spent[INTERRUPTION] = now_ns() - started - spent[COMPUTING];
    return has_answer;
}

/* Count a period by the time spent in each of its parts [ns], and the deadlines that have passed meanwhile. */
static void count_period(const int64_t *spent, uint64_t skipped, bool has_readings) {
    const double period = 1e9 * PERIOD;
    int longest = WAKING;
    for (int cause = 0; cause < CAUSES; cause++) {
        report.overruns[cause] += (double)spent[cause] > (cause == WAKING ? LATE_SHARE : BUDGET_SHARE) * period;
        longest = spent[cause] > spent[longest] ? cause : longest;
    }
    report.skipped += skipped;
    report.skipped_after[longest] += skipped;
    report.without_readings += !has_readings;
    count_latency(report.lateness, spent[WAKING]);
    if (has_readings) {
        count_latency(report.computing, spent[COMPUTING]);
    }
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
        int64_t spent[CAUSES] = {woken - due, 0, 0, 0};
        report.periods++;
        if ((stop_requested || woken > end) && stopped == 0) {
            stopped = woken;
            jaxhil_emergency_stop(&loop.controller, true); /* the force fades, the drives come to rest */
        }
        if (stopped != 0 && (!loop.has_run || (jaxhil_at_rest(&loop.controller) && loop.force == 0.0) ||
                             (double)(woken - stopped) > 1e9 * STOP_TIME)) {
            return true;
        }
        const bool has_readings = io->read(io->plant, &now);
        const int64_t read = now_ns();
        spent[PLANT] = read - woken;
        if (has_readings) {
            last_readings = read;
            due += (int64_t)(1e9 * now.shift);
            if (now.event == STOP || (stopped != 0 && now.event != TICK)) {
                return true;
            }
            if (compute_timed(&now, &answer, spent)) {
                const int64_t computed = now_ns();
                report.ticks += now.event == TICK;
                report.not_sent += !io->write(io->plant, &answer);
                spent[PLANT] += now_ns() - computed;
            }
        } else if ((double)(woken - last_readings) > 1e9 * SILENCE) {
            return false;
        }
        uint64_t skipped = 0;
        for (const int64_t finished = now_ns(); due + period <= finished; due += period) {
            skipped++; /* the deadline has passed: continue with the next one */
        }
        if (woken - begin > (int64_t)(1e9 * START_GRACE)) {
            count_period(spent, skipped, has_readings);
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
    printf("%s", name);
    for (int n = 0; n < 3; n++) {
        while (us < LATENCIES && (double)(sum + histogram[us]) < shares[n] * (double)total) {
            sum += histogram[us++];
        }
        printf(" %u", (unsigned)us);
    }
    printf("\n");
}

static void print_counts(const char *name, const uint64_t *counts, int number) {
    printf("%s", name);
    for (int n = 0; n < number; n++) {
        printf(" %llu", (unsigned long long)counts[n]);
    }
    printf("\n");
}

/* Print all numbers of the session; return false if they cannot be written. */
static bool print_report(void) {
    const uint64_t lost = lost_rows(), faults = loop.controller.seen;
    const uint64_t at_rest = !loop.has_run || jaxhil_at_rest(&loop.controller);
    print_counts("periods", &report.periods, 1);
    print_counts("ticks", &report.ticks, 1);
    print_counts("without_readings", &report.without_readings, 1);
    print_counts("woken_late", &report.overruns[WAKING], 1);
    print_counts("plant_too_long", &report.overruns[PLANT], 1);
    print_counts("too_long", &report.overruns[COMPUTING], 1);
    print_counts("interrupted", &report.overruns[INTERRUPTION], 1);
    print_counts("skipped", &report.skipped, 1);
    print_counts("skipped_after", report.skipped_after, CAUSES);
    print_counts("not_sent", &report.not_sent, 1);
    print_counts("lost_rows", &lost, 1);
    print_counts("faults", &faults, 1);
    print_latency("lateness_us", report.lateness);
    print_latency("computing_us", report.computing);
    print_counts("at_rest", &at_rest, 1);
    return fflush(stdout) == 0;
}

/* Stop on signals that end a session; a full disk or a closed output must not end the process. */
static void handle_signals(void) {
    const int ends[] = {SIGTERM, SIGINT, SIGHUP}, ignored[] = {SIGPIPE, SIGXFSZ};
    struct sigaction action, before;
    memset(&action, 0, sizeof action);
    action.sa_handler = request_stop;
    for (size_t n = 0; n < sizeof ends / sizeof ends[0]; n++) {
        if (sigaction(ends[n], NULL, &before) == 0 && before.sa_handler != SIG_IGN) { /* SIG_IGN: nohup */
            sigaction(ends[n], &action, NULL);
        }
    }
    action.sa_handler = SIG_IGN;
    for (size_t n = 0; n < sizeof ignored / sizeof ignored[0]; n++) {
        sigaction(ignored[n], &action, NULL);
    }
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
    handle_signals();
    if (!start_log()) { /* before the priority is raised, which the thread therefore does not inherit */
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
    const bool is_written = finish_log();
    return print_report() && is_complete && is_written ? 0 : 1;
}
