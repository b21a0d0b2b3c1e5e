/* A force-depth map of unknown contact, identified while it is met: slopes between knots, and damping. */
#include <math.h>
#include <stdbool.h>

/* == Declarations == */

enum { JAXHIL_SEGMENTS = 12, JAXHIL_PARAMETERS = 13 };

/* What of a map a motion needs: slopes [1/s^2], force at the knots [1/s], damping [1/s]. Depth in s (over the
 * approach speed), speed as a fraction of that speed, force in 1/s (over mass and approach speed). */
typedef struct {
    double slopes[JAXHIL_SEGMENTS], at_knots[JAXHIL_SEGMENTS], damping;
} jaxhil_map;

/* f(x, v) = sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j) + damping v at x > 0, else 0, from a
 * Gaussian prior by recursive least squares; the damping of `now` is the mean given that it is not negative. */
typedef struct {
    double stiffness, prior_damping, common, wandering, damping_variance;
    double estimate[JAXHIL_PARAMETERS], covariance[JAXHIL_PARAMETERS][JAXHIL_PARAMETERS];
    jaxhil_map now;
} jaxhil_force_depth_map;

void jaxhil_force_depth_map_init(jaxhil_force_depth_map *map, double stiffness, double common_spread,
                                 double wandering_spread, double damping, double damping_spread);
void jaxhil_force_depth_map_restart(jaxhil_force_depth_map *map);

/* One reading in contact, with noise of a `variance` [1/s^2]. */
void jaxhil_force_depth_map_update(jaxhil_force_depth_map *map, double depth, double speed, double force,
                                   double variance);

/* By which share the variance of the force at a depth, 10 ms or deeper, is less than the prior's. */
double jaxhil_force_depth_map_learnt(const jaxhil_force_depth_map *map, double depth, double speed);

/* Force [1/s] without damping, and with it; 0 out of contact. */
double jaxhil_map_elastic(const jaxhil_map *map, double depth);
double jaxhil_map_force(const jaxhil_map *map, double depth, double speed);

/* == Definitions == */

static const double jaxhil_knots[JAXHIL_SEGMENTS] = {0.0,  0.002, 0.005, 0.01,  0.016, 0.024,
                                                     0.032, 0.04,  0.05,  0.062, 0.076, 0.092};
static const double jaxhil_map_wandering = 0.03;  /* s of depth over which a slope wanders by its spread */
static const double jaxhil_map_shallowest = 0.01; /* s of depth by which it is judged what has been learnt */
static const double jaxhil_map_outlying = 4.0;    /* times the noise's variance: hardly noise */
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
        return spread * ((ratio + root) / jaxhil_map_pi);
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

static void jaxhil_force_depth_map_conclude(jaxhil_force_depth_map *map) {
    double reached = 0.0;
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        map->now.slopes[j] = map->estimate[j];
        if (j > 0) {
            reached += map->estimate[j - 1] * (jaxhil_knots[j] - jaxhil_knots[j - 1]);
        }
        map->now.at_knots[j] = reached;
    }
    map->now.damping = jaxhil_positive_mean(map->estimate[JAXHIL_SEGMENTS],
                                            map->covariance[JAXHIL_SEGMENTS][JAXHIL_SEGMENTS]);
}

void jaxhil_force_depth_map_init(jaxhil_force_depth_map *map, double stiffness, double common_spread,
                                 double wandering_spread, double damping, double damping_spread) {
    const double common = common_spread * stiffness;
    const double wandering = wandering_spread * stiffness;
    map->stiffness = stiffness;
    map->prior_damping = damping;
    map->common = common * common;
    map->wandering = wandering * wandering;
    map->damping_variance = damping_spread * damping_spread;
    jaxhil_force_depth_map_restart(map);
}

void jaxhil_force_depth_map_restart(jaxhil_force_depth_map *map) {
    for (int i = 0; i < JAXHIL_SEGMENTS; i++) {
        for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
            const double shared = i < j ? jaxhil_knots[i] : jaxhil_knots[j];
            map->covariance[i][j] = map->common + map->wandering * (shared / jaxhil_map_wandering);
        }
        map->covariance[i][JAXHIL_SEGMENTS] = 0.0;
        map->covariance[JAXHIL_SEGMENTS][i] = 0.0;
        map->estimate[i] = map->stiffness;
    }
    map->covariance[JAXHIL_SEGMENTS][JAXHIL_SEGMENTS] = map->damping_variance;
    map->estimate[JAXHIL_SEGMENTS] = map->prior_damping;
    jaxhil_force_depth_map_conclude(map);
}

void jaxhil_force_depth_map_update(jaxhil_force_depth_map *map, double depth, double speed, double force,
                                   double variance) {
    double pressed[JAXHIL_SEGMENTS], g[JAXHIL_PARAMETERS];
    const int number = jaxhil_pressed(depth, pressed);
    double expected = 0.0;
    for (int j = 0; j < number; j++) {
        expected += pressed[j] * map->estimate[j];
    }
    expected += speed * map->estimate[JAXHIL_SEGMENTS];
    if (!(expected > 0.0 || force * force > jaxhil_map_outlying * variance)) {
        return;
    }
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        double product = 0.0;
        for (int j = 0; j < number; j++) {
            product += map->covariance[i][j] * pressed[j];
        }
        g[i] = product + map->covariance[i][JAXHIL_SEGMENTS] * speed;
    }
    double s = variance;
    for (int j = 0; j < number; j++) {
        s += pressed[j] * g[j];
    }
    s += speed * g[JAXHIL_SEGMENTS];
    if (!(s > 0.0)) {
        return;
    }
    const double share = 1.0 / s;
    const double innovation = force - expected;
    for (int i = 0; i < JAXHIL_PARAMETERS; i++) {
        const double scaled = share * g[i];
        map->estimate[i] += scaled * innovation;
        for (int j = 0; j < JAXHIL_PARAMETERS; j++) {
            map->covariance[i][j] -= scaled * g[j];
        }
    }
    jaxhil_force_depth_map_conclude(map);
}

double jaxhil_force_depth_map_learnt(const jaxhil_force_depth_map *map, double depth, double speed) {
    double pressed[JAXHIL_SEGMENTS];
    if (!(depth > jaxhil_map_shallowest)) {
        depth = jaxhil_map_shallowest;
    }
    const int number = jaxhil_pressed(depth, pressed);
    const double *last = map->covariance[JAXHIL_SEGMENTS];
    double left = 0.0;
    double crossed = 0.0;
    for (int i = 0; i < number; i++) {
        const double *row = map->covariance[i];
        double product = 0.0;
        for (int j = 0; j < number; j++) {
            product += row[j] * pressed[j];
        }
        left += pressed[i] * product;
        crossed += pressed[i] * (row[JAXHIL_SEGMENTS] + last[i]);
    }
    left += speed * crossed + speed * last[JAXHIL_SEGMENTS] * speed;
    double wandered = 0.0;
    for (int j = 1; j < number; j++) {
        const double beyond = depth - jaxhil_knots[j];
        wandered += (jaxhil_knots[j] - jaxhil_knots[j - 1]) / jaxhil_map_wandering * (beyond * beyond);
    }
    const double before = map->common * (depth * depth) + map->wandering * wandered +
                          map->damping_variance * (speed * speed);
    return before > 0.0 ? 1.0 - left / before : 0.0;
}

double jaxhil_map_elastic(const jaxhil_map *map, double depth) {
    const int segment = jaxhil_segment_of(depth);
    if (segment < 0) {
        return 0.0;
    }
    return map->at_knots[segment] + map->slopes[segment] * (depth - jaxhil_knots[segment]);
}

double jaxhil_map_force(const jaxhil_map *map, double depth, double speed) {
    return depth > 0.0 ? jaxhil_map_elastic(map, depth) + map->damping * speed : 0.0;
}
