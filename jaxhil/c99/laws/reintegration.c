/* The motion that a contact should have had, integrated over again from its entry while the map improves. */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"

/* == Declarations == */

enum {
    JAXHIL_HISTORY = 1024, /* samples kept; a longer contact is not integrated over again */
    JAXHIL_STRIDE = 24     /* steps per tick of the pass from the entry */
};

/* A motion under a curve of its own, at one sample: depth [s], speed, deepest point so far [s], force without
 * damping [1/s]; of the measured sample there, the force's integral since the entry [ticks/s], over how many ticks
 * that is, and the map's force [1/s]; whether it has separated. */
typedef struct {
    double depth, speed, deepest, force, impulse, read, expected;
    bool free;
    jaxhil_curve curve;
} jaxhil_path;

/* From depth 0 at speed 1: x' = v, v' = -f, f = F(x, v, x_m) + rho [y - F(X, V, X_m)], rho = `replay`, the bracket
 * only as far as the hardware has been measured and y could be read, until it separates. A pass from the entry
 * makes up to JAXHIL_STRIDE steps of up to 2 ms per tick; when it has caught up with the present it becomes the
 * `live` motion. The force is older by `shift` [s] than it was taken for when samples were remembered: it belongs
 * to X - shift V. */
typedef struct {
    double replay, shift, period, first;
    long coarse, number, present, reached;
    jaxhil_path live, behind;
    double impulses[JAXHIL_HISTORY], reads[JAXHIL_HISTORY], depths[JAXHIL_HISTORY], speeds[JAXHIL_HISTORY];
    double deepest[JAXHIL_HISTORY];
} jaxhil_reference_motion;

/* == Definitions == */

static const double jaxhil_reference_coarse = 0.002; /* s, the longest step of a pass, at least a tick */

static void jaxhil_path_enter(jaxhil_path *path) {
    path->depth = 0.0;
    path->speed = 1.0;
    path->deepest = 0.0;
    path->force = 0.0;
    path->impulse = 0.0;
    path->read = 0.0;
    path->expected = 0.0;
    path->free = false;
}

/* A contact whose sample 0, the next tick's, comes `first` [s] after its entry. */
static void jaxhil_reference_motion_restart(jaxhil_reference_motion *reference, double first) {
    reference->first = first;
    reference->number = 0;
    reference->present = -1;
    reference->reached = -1;
    jaxhil_path_enter(&reference->behind);
}

static void jaxhil_reference_motion_init(jaxhil_reference_motion *reference, double period) {
    const double steps = jaxhil_reference_coarse / period;
    reference->replay = 0.0;
    reference->shift = 0.0;
    reference->period = period;
    /* A pass takes no longer steps than the history is long. */
    reference->coarse = JAXHIL_HISTORY;
    if (steps < (double)JAXHIL_HISTORY) {
        reference->coarse = steps > 1.0 ? (long)floor(steps + 1e-9) : 1;
    }
    for (int slot = 0; slot < JAXHIL_HISTORY; slot++) {
        reference->impulses[slot] = 0.0;
        reference->reads[slot] = 0.0;
        reference->depths[slot] = 0.0;
        reference->speeds[slot] = 0.0;
        reference->deepest[slot] = 0.0;
    }
    jaxhil_path_enter(&reference->live);
    jaxhil_reference_motion_restart(reference, 0.0);
}

/* A measured sample: the integral since the entry [ticks/s] of the force that could be read, over how many ticks that
 * is, depth [s], speed, deepest point [s]. */
static void jaxhil_reference_motion_remember(jaxhil_reference_motion *reference, long index, double impulse,
                                             double read, double depth, double speed, double deepest) {
    const long slot = index % JAXHIL_HISTORY;
    reference->impulses[slot] = impulse;
    reference->reads[slot] = read;
    reference->depths[slot] = depth;
    reference->speeds[slot] = speed;
    reference->deepest[slot] = deepest;
    reference->number = index + 1;
}

/* The path to the sample `index`, over so many ticks. */
static void jaxhil_reference_advance(const jaxhil_reference_motion *reference, jaxhil_path *path, long index,
                                     double ticks) {
    const jaxhil_curve *curve = &path->curve;
    double missing = 0.0;
    if (index < reference->number && ticks > 0.0) {
        const long slot = index % JAXHIL_HISTORY;
        const double impulse = reference->impulses[slot];
        const double read = reference->reads[slot];
        const double rate = reference->speeds[slot];
        const double expected = jaxhil_curve_force(curve, reference->depths[slot] - reference->shift * rate,
                                                   rate, reference->deepest[slot]);
        const double modelled = 0.5 * (path->expected + expected);
        const double gap = (impulse - path->impulse) - (read - path->read) * modelled;
        missing = reference->replay * (gap / ticks);
        path->impulse = impulse;
        path->read = read;
        path->expected = expected;
    }
    const double duration = ticks * reference->period;
    if (path->free) {
        path->depth += duration * path->speed;
        return;
    }
    const double half = 0.5 * duration;
    const double before = curve->damping + curve->depth_damping * path->depth / jaxhil_map_reach;
    const double middle = (path->speed - half * (path->force + missing)) / (1.0 + before * half);
    const double depth = path->depth + duration * middle;
    double drag = curve->damping;
    double force = 0.0;
    if (depth > path->deepest) {
        path->deepest = depth;
    }
    if (depth > 0.0) {
        drag += curve->depth_damping * depth / jaxhil_map_reach;
        force = jaxhil_curve_elastic(curve, depth) - curve->unloading * (path->deepest - depth);
    }
    const double speed = middle - half * (force + missing + drag * middle);
    path->depth = depth;
    path->speed = speed;
    path->force = force;
    path->free = depth <= 0.0 || (speed < 0.0 && force + missing + drag * speed <= 0.0);
}

static void jaxhil_reference_pass(jaxhil_reference_motion *reference) {
    jaxhil_path *behind = &reference->behind;
    for (int step = 0; step < JAXHIL_STRIDE && reference->reached < reference->present; step++) {
        if (reference->reached < 0) {
            reference->reached = 0;
            jaxhil_reference_advance(reference, behind, 0, reference->first / reference->period);
        } else {
            const long left = reference->present - reference->reached;
            const long jump = left >= reference->coarse ? reference->coarse : 1;
            reference->reached += jump;
            jaxhil_reference_advance(reference, behind, reference->reached, (double)jump);
        }
    }
}

static void jaxhil_reference_motion_tick(jaxhil_reference_motion *reference, const jaxhil_curve *curve) {
    jaxhil_path *live = &reference->live;
    reference->present++;
    if (reference->reached >= 0 || reference->number <= JAXHIL_HISTORY) {
        if (reference->reached < 0) {
            reference->behind.curve = *curve;
        }
        jaxhil_reference_pass(reference);
    }
    if (reference->reached == reference->present) {
        *live = reference->behind;
        jaxhil_path_enter(&reference->behind);
        reference->reached = -1;
    } else {
        live->curve = *curve;
        jaxhil_reference_advance(reference, live, reference->present, 1.0);
    }
}
