/* A force-depth map of unknown contact, identified while it is met: slopes between knots, and dissipation. */
#include <math.h>
#include <stdbool.h>

#include "gains_table.c"

/* == Declarations == */

enum { JAXHIL_SEGMENTS = 12, JAXHIL_PARAMETERS = JAXHIL_SEGMENTS + 5 };
enum { JAXHIL_DAMPING = JAXHIL_SEGMENTS, JAXHIL_DEPTH_DAMPING, JAXHIL_UNLOADING, JAXHIL_FRICTION, JAXHIL_PRELOAD };

/* What counts of a map: slopes [1/s^2], force at the knots [1/s], which begins with the preload, damping and depth
 * damping [1/s], unloading [1/s^2], friction [1/s]. Depth in s (over the approach speed), speed as a fraction of
 * that speed, force in 1/s (over mass and approach speed). */
typedef struct {
    double slopes[JAXHIL_SEGMENTS], at_knots[JAXHIL_SEGMENTS], damping, depth_damping, unloading, friction;
} jaxhil_curve;

/* f(x, v, x_m) = sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j) + (damping + depth_damping x/reach) v
 * - unloading (x_m - x) + friction v/sqrt(v^2 + slow^2) + preload at x > 0, else 0, x_m the deepest point so far;
 * from a Gaussian prior by recursive least squares. What dissipates counts in `curve` with its mean given that it
 * is not negative. */
typedef struct {
    double stiffness, common, wandering, damping, depth_damping, unloading, friction, preload;
    double estimate[JAXHIL_PARAMETERS], covariance[JAXHIL_PARAMETERS][JAXHIL_PARAMETERS];
    jaxhil_curve curve;
    double variance; /* [1/s^2] of the force that it expects where it was read last */
} jaxhil_force_depth_map;

/* One reading, with noise of a `variance` [1/s^2], if the contact `closes`, or the map or the reading tells of contact;
 * `number` segments are pressed in so far, `others` is what else the force is linear in. By how much it was missed,
 * squared and over its variance; while nothing is expected, over the noise's. */
double jaxhil_force_depth_map_learn(jaxhil_force_depth_map *map, const double *pressed, int number,
                                    const double *others, bool closes, double force, double variance);

/* One reading in contact, likewise. */
double jaxhil_force_depth_map_update(jaxhil_force_depth_map *map, double depth, double speed, double deepest,
                                     double force, double variance);

/* == Definitions == */

static const double jaxhil_knots[JAXHIL_SEGMENTS] = {0.0,   0.003, 0.008, 0.015, 0.024, 0.034,
                                                     0.046, 0.06,  0.076, 0.1,   0.14,  0.2};
static const double jaxhil_map_wide = 0.092;     /* s of depth, beyond which slopes wander less and less */
static const double jaxhil_map_slow = 0.03;      /* speed at which friction turns */
static const double jaxhil_map_wandering = 0.03; /* s of depth over which a slope wanders by its spread */
static const double jaxhil_map_reach = 0.03;     /* s of depth at which the depth damping is as strong as named */
static const double jaxhil_map_surface = 1e-12;  /* s of depth: nearer is on the surface, whatever the rounding */
static const double jaxhil_map_outlying = 4.0;   /* times the noise's variance: hardly noise */
static const double jaxhil_map_pi = 3.141592653589793;

/* The mean of N(mean, variance) given that it is not negative, with Boyd's bound of Mills' ratio. */
static double jaxhil_positive_mean(double mean, double variance) {
    if (!(variance > 0.0)) {
        return mean > 0.0 ? mean : 0.0;
    }
    const double spread = sqrt(variance);
    const double ratio = mean / spread;
    const double root = sqrt(ratio * ratio + 2.0 * jaxhil_map_pi);
    if (!(ratio > 0.0)) {
        /* (ratio + root)/pi, without the cancellation far below 0. */
        return spread * (2.0 / (root - ratio));
    }
    const double mills = jaxhil_map_pi / ((jaxhil_map_pi - 1.0) * ratio + root);
    double tail = 1.0 / (1.0 + ratio * ratio / 512.0);
    for (int i = 0; i < 8; i++) {
        tail *= tail;
    }
    const double density = tail / sqrt(2.0 * jaxhil_map_pi);
    return spread * (ratio + density / (1.0 - density * mills));
}

static int jaxhil_segment_of(double depth) {
    int above = 0;
    while (above < JAXHIL_SEGMENTS && jaxhil_knots[above] < depth) {
        above++;
    }
    return above - 1;
}

/* How far [s] each segment is pressed in, of those that are; their number. */
static int jaxhil_pressed(double depth, double *pressed) {
    const int last = jaxhil_segment_of(depth);
    for (int j = 0; j < last; j++) {
        pressed[j] = jaxhil_knots[j + 1] - jaxhil_knots[j];
    }
    pressed[last] = depth - jaxhil_knots[last];
    return last + 1;
}

static double jaxhil_force_depth_map_loss(const jaxhil_force_depth_map *map, int place) {
    return jaxhil_positive_mean(map->estimate[place], map->covariance[place][place]);
}

static void jaxhil_force_depth_map_conclude(jaxhil_force_depth_map *map) {
    jaxhil_curve *curve = &map->curve;
    double reached = map->estimate[JAXHIL_PRELOAD];
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        curve->slopes[j] = map->estimate[j];
        if (j > 0) {
            reached += map->estimate[j - 1] * (jaxhil_knots[j] - jaxhil_knots[j - 1]);
        }
        curve->at_knots[j] = reached;
    }
    curve->damping = jaxhil_force_depth_map_loss(map, JAXHIL_DAMPING);
    curve->depth_damping = jaxhil_force_depth_map_loss(map, JAXHIL_DEPTH_DAMPING);
    curve->unloading = jaxhil_force_depth_map_loss(map, JAXHIL_UNLOADING);
    curve->friction = jaxhil_force_depth_map_loss(map, JAXHIL_FRICTION);
}

/* Over how much depth [s] slopes have wandered at a depth [s]: beyond some, ever less, as (wide/depth)^4. */
static double jaxhil_map_wandered(double depth) {
    const double ratio = jaxhil_map_wide / depth;
    return depth > jaxhil_map_wide ? jaxhil_map_wide * (4.0 - ratio * ratio * ratio) / 3.0 : depth;
}

/* The prior, to the spread of whose preload so much [1/s] is added. */
static void jaxhil_force_depth_map_restart(jaxhil_force_depth_map *map, double preload) {
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        for (int j = 0; j < JAXHIL_PARAMETERS; j++) {
            map->covariance[i][j] = 0.0;
        }
        map->estimate[i] = 0.0;
    }
    map->variance = 0.0;
    for (int i = 0; i < JAXHIL_SEGMENTS; i++) {
        for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
            const double shared = jaxhil_map_wandered(i < j ? jaxhil_knots[i] : jaxhil_knots[j]);
            map->covariance[i][j] = map->common + map->wandering * (shared / jaxhil_map_wandering);
        }
        map->estimate[i] = map->stiffness;
    }
    map->covariance[JAXHIL_DAMPING][JAXHIL_DAMPING] = map->damping;
    map->covariance[JAXHIL_DEPTH_DAMPING][JAXHIL_DEPTH_DAMPING] = map->depth_damping;
    map->covariance[JAXHIL_UNLOADING][JAXHIL_UNLOADING] = map->unloading;
    map->covariance[JAXHIL_FRICTION][JAXHIL_FRICTION] = map->friction;
    map->covariance[JAXHIL_PRELOAD][JAXHIL_PRELOAD] = map->preload + preload * preload;
    jaxhil_force_depth_map_conclude(map);
}

/* With the gains' prior. */
static void jaxhil_force_depth_map_init(jaxhil_force_depth_map *map, const jaxhil_gains *gains) {
    map->stiffness = gains->prior_stiffness;
    map->common = gains->prior_stiffness_spread * gains->prior_stiffness_spread;
    map->wandering = gains->prior_slope_spread * gains->prior_slope_spread;
    map->damping = gains->prior_damping_spread * gains->prior_damping_spread;
    map->depth_damping = gains->prior_depth_damping_spread * gains->prior_depth_damping_spread;
    map->unloading = gains->prior_unloading_spread * gains->prior_unloading_spread;
    map->friction = gains->prior_friction_spread * gains->prior_friction_spread;
    map->preload = gains->prior_preload_spread * gains->prior_preload_spread;
    jaxhil_force_depth_map_restart(map, 0.0);
}

/* Which way the speed goes, from -1 to 1. */
static double jaxhil_turning(double speed) {
    const double ratio = speed / jaxhil_map_slow;
    return ratio / sqrt(1.0 + ratio * ratio);
}

/* phi.theta: the force [1/s] where `number` segments are pressed in so far, and what else it is linear in. */
static double jaxhil_force_depth_map_expected(const jaxhil_force_depth_map *map, const double *pressed, int number,
                                              const double *others) {
    double expected = 0.0;
    for (int j = 0; j < number; j++) {
        expected += pressed[j] * map->estimate[j];
    }
    for (int k = 0; k < JAXHIL_PARAMETERS - JAXHIL_SEGMENTS; k++) {
        expected += others[k] * map->estimate[JAXHIL_SEGMENTS + k];
    }
    return expected;
}

double jaxhil_force_depth_map_learn(jaxhil_force_depth_map *map, const double *pressed, int number,
                                    const double *others, bool closes, double force, double variance) {
    double g[JAXHIL_PARAMETERS];
    const double expected = jaxhil_force_depth_map_expected(map, pressed, number, others);
    const bool nothing = !(closes || expected > 0.0);
    if (nothing && !(force * force > jaxhil_map_outlying * variance)) {
        return force * force / variance;
    }
    double s = variance;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        const double *row = map->covariance[i];
        double product = 0.0;
        for (int j = 0; j < number; j++) {
            product += row[j] * pressed[j];
        }
        for (int k = 0; k < JAXHIL_PARAMETERS - JAXHIL_SEGMENTS; k++) {
            product += row[JAXHIL_SEGMENTS + k] * others[k];
        }
        g[i] = product;
    }
    for (int j = 0; j < number; j++) {
        s += pressed[j] * g[j];
    }
    for (int k = 0; k < JAXHIL_PARAMETERS - JAXHIL_SEGMENTS; k++) {
        s += others[k] * g[JAXHIL_SEGMENTS + k];
    }
    if (!(s > 0.0)) {
        return 0.0;
    }
    const double share = 1.0 / s;
    map->variance = variance * ((s - variance) * share);
    const double innovation = force - expected;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        const double scaled = share * g[i];
        map->estimate[i] += scaled * innovation;
        for (int j = 0; j < JAXHIL_PARAMETERS; j++) {
            map->covariance[i][j] -= scaled * g[j];
        }
    }
    return nothing ? force * force / variance : innovation * innovation * share;
}

double jaxhil_force_depth_map_update(jaxhil_force_depth_map *map, double depth, double speed, double deepest,
                                     double force, double variance) {
    double pressed[JAXHIL_SEGMENTS];
    const int number = jaxhil_pressed(depth, pressed);
    const double others[] = {speed, depth * speed / jaxhil_map_reach, depth - deepest, jaxhil_turning(speed), 1.0};
    const double surprise =
        jaxhil_force_depth_map_learn(map, pressed, number, others, speed > 0.0, force, variance);
    jaxhil_force_depth_map_conclude(map);
    return surprise;
}

/* Force [1/s] that does not depend on how the contact came there, 0 out of contact. */
static double jaxhil_curve_elastic(const jaxhil_curve *curve, double depth) {
    const int segment = jaxhil_segment_of(depth);
    if (segment < 0) {
        return 0.0;
    }
    return curve->at_knots[segment] + curve->slopes[segment] * (depth - jaxhil_knots[segment]);
}

/* What is stored at a depth: the integral of the elastic force. */
static double jaxhil_curve_stored(const jaxhil_curve *curve, double depth) {
    double stored = 0.0;
    for (int j = 0; j < JAXHIL_SEGMENTS && depth > jaxhil_knots[j]; j++) {
        const bool through = j + 1 < JAXHIL_SEGMENTS && depth > jaxhil_knots[j + 1];
        const double width = (through ? jaxhil_knots[j + 1] : depth) - jaxhil_knots[j];
        stored += (curve->at_knots[j] + 0.5 * (curve->slopes[j] * width)) * width;
    }
    return stored;
}

/* Force [1/s], 0 out of contact. */
static double jaxhil_curve_force(const jaxhil_curve *curve, double depth, double speed, double deepest) {
    if (!(depth > 0.0)) {
        return 0.0;
    }
    const double drag = (curve->damping + curve->depth_damping * depth / jaxhil_map_reach) * speed;
    const double back = deepest > depth ? deepest - depth : 0.0;
    const double lost = drag + curve->friction * jaxhil_turning(speed) - curve->unloading * back;
    return jaxhil_curve_elastic(curve, depth) + lost;
}

/* Force [1/s] where a contact entered at speed 1 comes to rest without dissipation, at least 1. At knots where the
 * map pulls the force counts as 0. */
static double jaxhil_curve_peak_force(const jaxhil_curve *curve) {
    double reached = curve->at_knots[0] > 0.0 ? curve->at_knots[0] : 0.0;
    double energy = 0.0, rise = curve->slopes[JAXHIL_SEGMENTS - 1];
    for (int j = 0; j < JAXHIL_SEGMENTS - 1; j++) {
        const double width = jaxhil_knots[j + 1] - jaxhil_knots[j];
        const double force = curve->at_knots[j + 1] > 0.0 ? curve->at_knots[j + 1] : 0.0;
        const double more = energy + 0.5 * (reached + force) * width;
        if (!(more < 0.5)) {
            rise = (force - reached) / width;
            break;
        }
        reached = force;
        energy = more;
    }
    double square = reached * reached;
    if (rise > 0.0) {
        square += 2.0 * rise * (0.5 - energy);
    }
    return square > 1.0 ? sqrt(square) : 1.0;
}
