/* A rig around the exported controller: one contact a run, on its own fine grid and by its own rule for the end.
 *
 * Motion simulator of second order behind a transport delay, spring and damper, delayed force reading with the
 * noise of a file: Runge-Kutta on GRID steps a period. Arguments: mass [kg], approach velocity [m/s], stiffness
 * [N/m], damping [N s/m], natural frequency [Hz], damping ratio, simulator's delay [s], force delay [s], latency
 * [periods], phase, ticks waited for after the force, file of noise [N] (doubles, TICKS a run).
 * Prints of every run the restitution, the tick of its end and the faults that the controller raised.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "jaxhil_controller.c"
#include "jaxhil_gains.h"

enum { GRID = 50, TICKS = 4000, POINTS = GRID * (TICKS + 1), ARGUMENTS = 13 };

static double command[POINTS + 1]; /* to the drives, on the grid */
static double force[POINTS + 1];   /* of the contact, on the grid */
static double noise[TICKS];
static jaxhil_controller controller;

typedef struct {
    double mass, velocity, stiffness, damping, frequency, ratio, simulator_delay, force_delay, latency, phase, waiting;
} rig;

/* A signal of the grid, `delay` before point `at` + `part`; uniform motion before the run. */
static double delayed(const double *signal, double at, double step, double before) {
    if (at <= 0.0) {
        return signal[0] + before * at * step;
    }
    const int whole = (int)at;
    return signal[whole] + (at - whole) * (signal[whole + 1] - signal[whole]);
}

static double contact_force(const rig *r, double position, double velocity) {
    const double size = position > 0.0 ? r->stiffness * position + r->damping * velocity : 0.0;
    return size > 0.0 ? size : 0.0;
}

/* One run: its faults; the restitution and the last tick, as they were if it does not end. */
static uint32_t run(const rig *r, double *restitution, int *last) {
    const double period = jaxhil_exported_gains.control_period;
    const double step = period / GRID, w = 6.283185307179586 * r->frequency;
    double x = -r->velocity * (0.02 + r->phase * period), v = r->velocity, approach = v;
    double actual = x - v * (r->simulator_delay + r->latency * period + 2.0 * r->ratio / w), rate = v;
    double older[3] = {x, x - period * v, x - 2.0 * period * v};
    uint32_t faults = 0;
    int begun = 0, quiet = 0;
    command[0] = older[(int)r->latency];
    force[0] = 0.0;
    if (!jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits)) {
        return UINT32_MAX;
    }
    jaxhil_position_command(&controller, x, v, 0.0);
    for (int n = 0; n < TICKS; n++) {
        const double read = delayed(force, n * GRID - r->force_delay / step, step, 0.0) + noise[n];
        const double given = jaxhil_step(&controller, read, x, v, actual, NULL);
        const int touching = force[n * GRID] != 0.0;
        faults |= controller.faults;
        begun = begun || touching || x > 0.0;
        approach = begun ? approach : v;
        quiet = touching || !begun ? 0 : quiet + 1;
        if (begun && v < 0.0 && quiet >= (int)r->waiting) {
            *restitution = -v / approach;
            *last = n;
            return faults;
        }
        const double acceleration = n == 0 ? 0.0 : -given / r->mass;
        v += period * acceleration;
        x += period * v;
        const double next = jaxhil_position_command(&controller, x, v, acceleration);
        older[2] = older[1];
        older[1] = older[0];
        older[0] = next;
        const double from = older[1 + (int)r->latency], to = older[(int)r->latency];
        for (int i = 1; i <= GRID; i++) {
            command[n * GRID + i] = from + (to - from) * i / GRID;
        }
        for (int i = 0; i < GRID; i++) {
            const double at = n * GRID + i - r->simulator_delay / step;
            double input[3], dx[4], dv[4], p = actual, q = rate;
            for (int k = 0; k < 3; k++) {
                input[k] = delayed(command, at + 0.5 * k, step, r->velocity);
            }
            for (int k = 0; k < 4; k++) {
                const double share = k == 0 ? 0.0 : k == 3 ? 1.0 : 0.5;
                p = actual + (k > 0 ? share * step * dx[k - 1] : 0.0);
                q = rate + (k > 0 ? share * step * dv[k - 1] : 0.0);
                dx[k] = q;
                dv[k] = w * w * (input[(k + 1) / 2] - p) - 2.0 * r->ratio * w * q;
            }
            actual += step * (dx[0] + 2.0 * dx[1] + 2.0 * dx[2] + dx[3]) / 6.0;
            rate += step * (dv[0] + 2.0 * dv[1] + 2.0 * dv[2] + dv[3]) / 6.0;
            force[n * GRID + i + 1] = contact_force(r, actual, rate);
        }
    }
    return faults;
}

int main(int count, char **arguments) {
    double numbers[ARGUMENTS];
    rig r;
    if (count != ARGUMENTS) {
        return 2;
    }
    for (int i = 1; i < ARGUMENTS - 1; i++) {
        numbers[i - 1] = strtod(arguments[i], NULL);
    }
    memcpy(&r, numbers, sizeof r);
    FILE *file = fopen(arguments[ARGUMENTS - 1], "rb");
    while (file && fread(noise, sizeof noise, 1, file) == 1) {
        double restitution = NAN;
        int last = TICKS;
        const uint32_t faults = run(&r, &restitution, &last);
        printf("%.17g %d %lu\n", restitution, last, (unsigned long)faults);
    }
    return 0;
}
