/* The motion that a contact should have had, integrated over again from its entry while the map improves. */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"
#include "history.c"

/* == Declarations == */

enum { JAXHIL_STRIDE = 24 }; /* steps per tick of the pass from the entry */
/* ticks of a contact, up to which it is integrated over again */
enum { JAXHIL_LONGEST = (JAXHIL_SLOTS - 2) * (1 << 2 * (JAXHIL_LEVELS - 1)) };

/* A contact's scales: the clearance of two surfaces [m]; the surface's side, 1 or -1, and its place [m] beyond where
 * it was told; approach speed [m/s]; that over the pace [m]; mass times it times the pace [N]; the bias [N]. */
typedef struct {
    double clearance, side, plane, speed, length, weight, bias;
} jaxhil_scales;

/* A motion under a curve of its own, at one sample: depth [s], speed, deepest point so far [s], force without
 * damping [1/s]; of the measured sample there its integrals (jaxhil_sample), the deepest point so far [s] and the
 * map's force [1/s]; whether it has separated. */
typedef struct {
    double depth, speed, deepest, force, impulse, shown, farthest, expected;
    bool free;
    jaxhil_curve curve;
} jaxhil_path;

/* From depth 0 at speed 1: x' = v, v' = -f, f = F(x, v, x_m) + rho [y - F(X, V, X_m)], rho = `replay`, the bracket
 * only as far as the hardware has been measured and y could be read, until it separates. A pass from the entry
 * makes up to JAXHIL_STRIDE steps per tick, of up to 2 ms, or from one sample of the history to the next; when it
 * has caught up with the present it becomes the `live` motion. Samples count by the hardware's ticks: the last
 * before its own entry, then one `since` that [ticks], and so on; the present lies `beyond` [ticks] such a sample.
 * The force is older by `shift` [s] than it was taken for, the surface `deeper` [s] than it was met: it belongs to the depth
 * X - shift V - deeper. */
typedef struct {
    double replay, shift, deeper, period, since, beyond;
    long coarse, entry, present, reached;
    jaxhil_scales scales;
    jaxhil_sample start; /* that at `entry` */
    jaxhil_path live, behind;
} jaxhil_reference_motion;

/* == Definitions == */

static const double jaxhil_reference_coarse = 0.002; /* s, the longest step of a pass, at least a tick */

/* Depth [s] at a position [m]. */
static double jaxhil_scales_beyond(const jaxhil_scales *scales, double position) {
    return scales->side < 0.0 ? -scales->clearance - position : position;
}

static double jaxhil_scales_depth(const jaxhil_scales *scales, double position) {
    return (jaxhil_scales_beyond(scales, position) - scales->plane) / scales->length;
}

static double jaxhil_scales_rate(const jaxhil_scales *scales, double velocity) {
    return scales->side * velocity / scales->speed;
}

static double jaxhil_scales_force(const jaxhil_scales *scales, double force) {
    return scales->side * (force - scales->bias) / scales->weight;
}

static void jaxhil_path_enter(jaxhil_path *path, const jaxhil_sample *sample) {
    path->depth = 0.0;
    path->speed = 1.0;
    path->deepest = 0.0;
    path->force = 0.0;
    path->impulse = sample->impulse;
    path->shown = sample->shown;
    path->farthest = 0.0;
    path->expected = 0.0;
    path->free = false;
}

static void jaxhil_reference_motion_init(jaxhil_reference_motion *reference, double period) {
    reference->replay = 0.0;
    reference->shift = 0.0;
    reference->deeper = 0.0;
    reference->period = period;
    reference->coarse = 1;
    while (2.0 * (double)reference->coarse * period <= jaxhil_reference_coarse * (1.0 + 1e-9)) {
        reference->coarse *= 2;
    }
}

/* Before a tick at which the hardware has met the surface `since` [ticks] before the sample after `entry`, the
 * numerical model `depth` [s] ago: until the first pass is done, it should go on as it does. */
static void jaxhil_reference_motion_begin(jaxhil_reference_motion *reference, const jaxhil_history *history,
                                          long entry, double since, double depth) {
    const double all = depth / reference->period - since;
    const double ticks = all < (double)JAXHIL_LONGEST ? all : (double)JAXHIL_LONGEST;
    const double whole = ticks > 0.0 ? floor(ticks) : 0.0;
    reference->entry = entry;
    reference->reached = entry;
    reference->since = since;
    reference->present = entry + (long)whole;
    reference->beyond = ticks > 0.0 ? ticks - whole : 0.0;
    reference->start = *jaxhil_history_recall(history, entry);
    jaxhil_path_enter(&reference->behind, &reference->start);
    jaxhil_path_enter(&reference->live, &reference->start);
    reference->live.depth = depth - reference->period;
    reference->live.free = true;
}

/* What was measured and the map does not explain, as the path goes on to the sample `index`: its mean [1/s] over so
 * many ticks. */
static double jaxhil_reference_missing(const jaxhil_reference_motion *reference, const jaxhil_history *history,
                                       jaxhil_path *path, long index, double ticks) {
    const jaxhil_sample *sample = jaxhil_history_recall(history, index);
    const jaxhil_scales *scales = &reference->scales;
    const double rate = jaxhil_scales_rate(scales, sample->velocity);
    const double depth = jaxhil_scales_depth(scales, sample->position) - (reference->shift * rate + reference->deeper);
    if (depth > path->farthest) {
        path->farthest = depth;
    }
    const double expected = jaxhil_curve_force(&path->curve, depth, rate, path->farthest);
    const double shown = sample->shown - path->shown;
    const double part = shown < ticks ? shown : ticks;
    const double impulse = (sample->impulse - path->impulse) - scales->bias * shown;
    const double gap = scales->side * impulse / scales->weight - part * (0.5 * (path->expected + expected));
    path->impulse = sample->impulse;
    path->shown = sample->shown;
    path->expected = expected;
    return reference->replay * (gap / ticks);
}

/* The path to the sample `index`, over so many ticks. */
static void jaxhil_reference_advance(const jaxhil_reference_motion *reference, const jaxhil_history *history,
                                     jaxhil_path *path, long index, double ticks) {
    const jaxhil_curve *curve = &path->curve;
    double missing = 0.0;
    if (index <= history->newest && ticks > 0.0) {
        missing = jaxhil_reference_missing(reference, history, path, index, ticks);
    }
    const double duration = ticks * reference->period;
    if (path->free) {
        path->depth += duration * path->speed;
        return;
    }
    const double half = 0.5 * duration;
    const double before = curve->damping + curve->depth_damping * path->depth / jaxhil_map_reach;
    const double rubbed = curve->friction * jaxhil_turning(path->speed);
    const double middle = (path->speed - half * (path->force + rubbed + missing)) / (1.0 + before * half);
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
    const double rubbing = depth > 0.0 ? curve->friction * jaxhil_turning(middle) : 0.0;
    const double speed = middle - half * (force + rubbing + missing + drag * middle);
    path->depth = depth;
    path->speed = speed;
    path->force = force;
    path->free = depth <= 0.0 || (speed < 0.0 && force + rubbing + missing + drag * speed <= 0.0);
}

/* The sample to go on to from `index`: as far as is measured, one that is kept. */
static long jaxhil_reference_next(const jaxhil_reference_motion *reference, const jaxhil_history *history,
                                  long index) {
    long next = index + reference->coarse;
    if (index < history->newest) {
        const long kept = jaxhil_history_stride(history, index);
        const long stride = kept > reference->coarse ? kept : reference->coarse;
        next = ((index + 1) / stride + 1) * stride - 1;
        next = next < history->newest ? next : history->newest;
    }
    return next < reference->present ? next : reference->present;
}

static void jaxhil_reference_pass(jaxhil_reference_motion *reference, const jaxhil_history *history) {
    jaxhil_path *behind = &reference->behind;
    for (int step = 0; step < JAXHIL_STRIDE && reference->reached < reference->present; step++) {
        const long next = jaxhil_reference_next(reference, history, reference->reached);
        double ticks = (double)(next - reference->reached);
        if (reference->reached == reference->entry) {
            ticks += reference->since - 1.0;
        }
        reference->reached = next;
        jaxhil_reference_advance(reference, history, behind, next, ticks);
    }
}

static void jaxhil_reference_motion_tick(jaxhil_reference_motion *reference, const jaxhil_history *history,
                                         const jaxhil_curve *curve) {
    jaxhil_path *live = &reference->live;
    reference->present++;
    const bool whole = history->newest - reference->entry < JAXHIL_LONGEST;
    if (reference->reached > reference->entry || whole) {
        if (reference->reached == reference->entry) {
            reference->behind.curve = *curve;
            reference->behind.force = curve->at_knots[0];
            reference->behind.expected = curve->at_knots[0] + (curve->damping + curve->friction);
        }
        jaxhil_reference_pass(reference, history);
    }
    if (reference->reached == reference->present) {
        jaxhil_reference_advance(reference, history, &reference->behind, reference->present, reference->beyond);
        *live = reference->behind;
        jaxhil_path_enter(&reference->behind, &reference->start);
        reference->reached = reference->entry;
    } else {
        live->curve = *curve;
        jaxhil_reference_advance(reference, history, live, reference->present, 1.0);
    }
}
