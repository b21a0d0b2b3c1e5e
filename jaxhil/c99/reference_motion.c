/* The motion that a contact should have had, integrated over again from its entry while the map improves. */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"

/* == Declarations == */

enum {
    JAXHIL_HISTORY = 1024, /* samples kept; a longer contact is not integrated over again */
    JAXHIL_STRIDE = 24     /* steps per tick of the pass from the entry */
};

/* A motion under a map at one sample: depth [s], speed, elastic force [1/s]; of the measured sample there, the
 * force's integral since the entry [ticks/s] and the map's force [1/s]; whether it has separated. */
typedef struct {
    double depth, speed, force, impulse, expected;
    bool free;
    jaxhil_map map;
} jaxhil_path;

/* From depth 0 at speed 1: x' = v, v' = -f, f = F(x, v) + rho [y - F(X, V)], the bracket only as far as the
 * hardware has been measured, until it separates. A pass from the entry makes up to JAXHIL_STRIDE steps of up to
 * 2 ms per tick; when it has caught up with the present it becomes the `live` motion. */
typedef struct {
    double replay, period, first;
    long coarse, number, present, reached;
    jaxhil_path live, behind;
    double impulses[JAXHIL_HISTORY], depths[JAXHIL_HISTORY], speeds[JAXHIL_HISTORY];
} jaxhil_reference_motion;

void jaxhil_reference_motion_init(jaxhil_reference_motion *reference, double replay, double period);

/* A contact whose sample 0, the next tick's, comes `first` [s] after its entry. */
void jaxhil_reference_motion_restart(jaxhil_reference_motion *reference, double first);

/* A measured sample: the force's integral since the entry [ticks/s], depth [s], speed. */
void jaxhil_reference_motion_remember(jaxhil_reference_motion *reference, long index, double impulse,
                                      double depth, double speed);
void jaxhil_reference_motion_tick(jaxhil_reference_motion *reference, const jaxhil_map *map);

/* == Definitions == */

static const double jaxhil_reference_coarse = 0.002; /* s, the longest step of a pass, at least a tick */

static void jaxhil_path_enter(jaxhil_path *path) {
    path->depth = 0.0;
    path->speed = 1.0;
    path->force = 0.0;
    path->impulse = 0.0;
    path->expected = 0.0;
    path->free = false;
}

void jaxhil_reference_motion_init(jaxhil_reference_motion *reference, double replay, double period) {
    const double steps = jaxhil_reference_coarse / period;
    reference->replay = replay;
    reference->period = period;
    /* A pass takes no longer steps than the history is long. */
    reference->coarse = JAXHIL_HISTORY;
    if (steps < (double)JAXHIL_HISTORY) {
        reference->coarse = steps > 1.0 ? (long)floor(steps + 1e-9) : 1;
    }
    for (int slot = 0; slot < JAXHIL_HISTORY; slot++) {
        reference->impulses[slot] = 0.0;
        reference->depths[slot] = 0.0;
        reference->speeds[slot] = 0.0;
    }
    jaxhil_path_enter(&reference->live);
    jaxhil_reference_motion_restart(reference, 0.0);
}

void jaxhil_reference_motion_restart(jaxhil_reference_motion *reference, double first) {
    reference->first = first;
    reference->number = 0;
    reference->present = -1;
    reference->reached = -1;
    jaxhil_path_enter(&reference->behind);
}

void jaxhil_reference_motion_remember(jaxhil_reference_motion *reference, long index, double impulse,
                                      double depth, double speed) {
    const long slot = index % JAXHIL_HISTORY;
    reference->impulses[slot] = impulse;
    reference->depths[slot] = depth;
    reference->speeds[slot] = speed;
    reference->number = index + 1;
}

/* The path to the sample `index`, over so many ticks. */
static void jaxhil_reference_advance(const jaxhil_reference_motion *reference, jaxhil_path *path, long index,
                                     double ticks) {
    const double damping = path->map.damping;
    double missing = 0.0;
    if (index < reference->number && ticks > 0.0) {
        const long slot = index % JAXHIL_HISTORY;
        const double impulse = reference->impulses[slot];
        const double depth = reference->depths[slot];
        double expected = 0.0;
        if (depth > 0.0) {
            expected = jaxhil_map_elastic(&path->map, depth);
            expected += damping * reference->speeds[slot];
        }
        missing =
            reference->replay * ((impulse - path->impulse) / ticks - 0.5 * (path->expected + expected));
        path->impulse = impulse;
        path->expected = expected;
    }
    const double duration = ticks * reference->period;
    if (path->free) {
        path->depth += duration * path->speed;
        return;
    }
    const double half = 0.5 * duration;
    const double drag = damping * half;
    const double middle = (path->speed - half * (path->force + missing)) / (1.0 + drag);
    const double depth = path->depth + duration * middle;
    const double force = depth > 0.0 ? jaxhil_map_elastic(&path->map, depth) : 0.0;
    const double speed = middle - half * (force + missing) - drag * middle;
    path->depth = depth;
    path->speed = speed;
    path->force = force;
    path->free = depth <= 0.0 || (speed < 0.0 && force + missing + damping * speed <= 0.0);
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

void jaxhil_reference_motion_tick(jaxhil_reference_motion *reference, const jaxhil_map *map) {
    jaxhil_path *live = &reference->live;
    reference->present++;
    if (reference->reached >= 0 || reference->number <= JAXHIL_HISTORY) {
        if (reference->reached < 0) {
            reference->behind.map = *map;
        }
        jaxhil_reference_pass(reference);
    }
    if (reference->reached == reference->present) {
        *live = reference->behind;
        jaxhil_path_enter(&reference->behind);
        reference->reached = -1;
    } else {
        live->map = *map;
        jaxhil_reference_advance(reference, live, reference->present, 1.0);
    }
}
