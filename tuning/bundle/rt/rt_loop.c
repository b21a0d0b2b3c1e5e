/* Real-time loop of the controller and the numerical model on Linux, with one axis or six axes.
 *
 *     cc -std=c99 -O2 -ffp-contract=off -pthread -o rt_loop rt_*.c jaxhil_controller.c -lm
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

#include "rt_log.h"
#include "rt_loop.h"
#include "rt_model.h"
#include "rt_task.h"

#define START_GRACE 0.1   /* s; overruns before this time are not counted */
#define LATE_SHARE 0.25   /* periods; if the loop wakes up later than this, it was woken too late */
#define BUDGET_SHARE 0.8  /* periods; computation, or plant, that takes longer is an overrun */
#define SILENCE 2.0       /* s; the loop ends if there are no readings for this time */
#define STOP_TIME 5.0     /* s; longest time until the drives are at rest */
#define LATENCIES 100000u /* us; length of the histograms */

volatile sig_atomic_t stop_requested = 0;

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
    const bool has_answer = rt_answer(now, answer);
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
            jaxhil_emergency_stop(&rt_controller, true); /* the force fades, the drives come to rest */
        }
        if (stopped != 0 && (rt_is_at_rest() || (double)(woken - stopped) > 1e9 * STOP_TIME)) {
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
    const uint64_t lost = lost_rows(), faults = rt_controller.seen;
    const uint64_t at_rest = rt_is_at_rest();
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
    if (!rt_init()) {
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
    const bool is_open = io->open(io->plant);
    bool is_complete = is_open || stop_requested;
    if (is_open) {
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
