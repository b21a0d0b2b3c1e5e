/* The readings of a tick as the retrospective laws use them: as old as one another, and how noisy. */
#include <math.h>
#include <stdbool.h>

#include "filters.c"
#include "gains_table.c"

/* == Declarations == */

/* The hardware's position and velocity as old as the force. The line delays by a tick less, where the delay is
 * longer than that, so that the speed can be a difference about the middle. */
typedef struct {
    double period, share, middle, last;
    bool whole;
    jaxhil_delay_line line;
    double samples[JAXHIL_IDENTIFICATION_DELAY_SAMPLES];
} jaxhil_alignment;

/* How noisy the force is: as told, or as differences between readings out of contact show if that is more; the
 * sum of half their squares [N^2], their number, the reading before [N] and whether the sensor showed it. */
typedef struct {
    double known, squares, count, before;
    bool shown_before;
} jaxhil_force_noise;

/* == Definitions == */

static const double jaxhil_seen = 8.0;         /* differences between readings that show how noisy the force is */
static const double jaxhil_outstanding = 32.0; /* times the noise's variance: what hardly is noise */

static bool jaxhil_alignment_init(jaxhil_alignment *alignment, double delay, double period) {
    alignment->whole = delay > period;
    alignment->period = period;
    alignment->share = alignment->whole ? 1.0 : delay / period;
    alignment->middle = 0.0;
    alignment->last = 0.0;
    /* The line delays by less than the capacity allows: a delay is refused like that of the other laws. */
    if (!(floor(delay / period + 1e-9) <= (double)(JAXHIL_IDENTIFICATION_DELAY_SAMPLES - 2))) {
        return false;
    }
    return jaxhil_delay_line_init(&alignment->line, alignment->samples, JAXHIL_IDENTIFICATION_DELAY_SAMPLES,
                                  alignment->whole ? delay - period : 0.0, period);
}

/* Of a position measured at this tick [m]; a run `begins` in uniform motion at this velocity [m/s]. */
static void jaxhil_alignment_step(jaxhil_alignment *alignment, double measured, double velocity_desired,
                                  bool begins, double *position, double *velocity) {
    const double period = alignment->period;
    double newest = measured;
    if (alignment->whole) {
        if (begins) {
            jaxhil_delay_line_start(&alignment->line, alignment->samples, measured, velocity_desired);
        }
        newest = jaxhil_delay_line_step(&alignment->line, alignment->samples, measured);
    }
    if (begins) {
        const double stride = period * velocity_desired;
        alignment->middle = newest - stride;
        alignment->last = newest - 2.0 * stride;
    }
    *position = newest + alignment->share * (alignment->middle - newest);
    *velocity = (newest - alignment->last) / (2.0 * period);
    alignment->last = alignment->middle;
    alignment->middle = newest;
}

static void jaxhil_force_noise_restart(jaxhil_force_noise *noise) {
    noise->squares = 0.0;
    noise->count = 0.0;
    noise->before = 0.0;
    noise->shown_before = false;
}

/* The force's variance [N^2]. */
static double jaxhil_force_noise_variance(const jaxhil_force_noise *noise) {
    const double seen = noise->squares / (noise->count > 0.0 ? noise->count : 1.0);
    return seen > noise->known ? seen : noise->known;
}

/* A reading [N]: whether the sensor showed it, whether the hardware is `free`. */
static void jaxhil_force_noise_take(jaxhil_force_noise *noise, double force, bool shown, bool free) {
    const double step = force - noise->before;
    if (free && shown && noise->shown_before &&
        !(noise->count >= jaxhil_seen &&
          step * step > jaxhil_outstanding * jaxhil_force_noise_variance(noise))) {
        noise->squares += 0.5 * (step * step);
        noise->count += 1.0;
    }
    noise->before = force;
    noise->shown_before = shown;
}
