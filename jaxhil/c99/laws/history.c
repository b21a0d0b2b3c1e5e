/* What was measured in a run, by tick: of the newest 255 ticks every sample, of the 4 times as many before every
 * 4th, then every 16th, 64th and 256th, the last of each block of so many ticks.
 */
#include <stdbool.h>

/* == Declarations == */

enum { JAXHIL_SLOTS = 256, JAXHIL_LEVELS = 5 };

/* The integral since the run began of the force that the sensor showed [N ticks], over how many ticks that is; the
 * position [m] and velocity [m/s] of the hardware, as old as the force. */
typedef struct {
    double impulse, shown, position, velocity;
} jaxhil_sample;

typedef struct {
    long newest; /* tick, -1 before the first */
    jaxhil_sample samples[JAXHIL_LEVELS][JAXHIL_SLOTS];
    double forces[JAXHIL_SLOTS]; /* N, of the newest 256 ticks */
    bool shows[JAXHIL_SLOTS];    /* whether the sensor showed it */
} jaxhil_history;

/* == Definitions == */

static void jaxhil_history_restart(jaxhil_history *history) {
    history->newest = -1;
}

/* How many ticks lie between the samples that are kept as old as that of `tick`. */
static long jaxhil_history_stride(const jaxhil_history *history, long tick) {
    const long age = history->newest - tick;
    long stride = 1;
    while (age >= (JAXHIL_SLOTS - 1) * stride) {
        stride *= 4;
    }
    return stride;
}

/* The sample of a tick that is kept. */
static const jaxhil_sample *jaxhil_history_recall(const jaxhil_history *history, long tick) {
    const long stride = jaxhil_history_stride(history, tick);
    int level = 0;
    while (1L << (2 * level) < stride) {
        level++;
    }
    return &history->samples[level][(tick / stride) % JAXHIL_SLOTS];
}

/* One more tick. */
static void jaxhil_history_take(jaxhil_history *history, double force, bool shows, double position,
                                double velocity) {
    jaxhil_sample sample = {0.0, 0.0, position, velocity};
    if (history->newest >= 0) {
        const long slot = history->newest % JAXHIL_SLOTS;
        const jaxhil_sample *before = &history->samples[0][slot];
        const bool both = shows && history->shows[slot];
        sample.impulse = before->impulse + (both ? 0.5 * (history->forces[slot] + force) : 0.0);
        sample.shown = before->shown + (both ? 1.0 : 0.0);
    }
    history->newest++;
    const long tick = history->newest;
    for (int level = 0; level < JAXHIL_LEVELS; level++) {
        history->samples[level][(tick >> (2 * level)) % JAXHIL_SLOTS] = sample;
    }
    history->forces[tick % JAXHIL_SLOTS] = force;
    history->shows[tick % JAXHIL_SLOTS] = shows;
}
