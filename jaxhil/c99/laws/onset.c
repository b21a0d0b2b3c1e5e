/* Where the hardware's surface is: the tick from which on the force tells of contact.
 *
 * While the numerical model flies freely every tick may be the one in which the hardware met the surface. Since then
 * the force would be y = b + B + K s, s the time since the middle of that tick, K ~ N(K0, s_K^2), B ~ N(0, s_B^2);
 * before, y = b, the sensor's bias. Its evidence against free flight throughout has a closed form in sums over the
 * readings; the surface is found when the evidence of the best tick, with how likely a surface is there, exceeds
 * e^9. The surface is expected at a place with a spread s: of a distance d s from there its density is
 * 1/(pi s (1 + d^2)). The farther back, the fewer ticks are tried; beside the best of them all are, by ever smaller
 * steps. Scaled by approach speed and mass: forces in 1/s, K in 1/s^2.
 */
#include <math.h>
#include <stdbool.h>

#include "force_depth_map.c"
#include "history.c"

/* == Declarations == */

enum { JAXHIL_AGES = 15, JAXHIL_AGE_STEP = 32, JAXHIL_SUMS = 5 };

/* Sums over the readings that the sensor showed since the flight began: 1, the tick m, m^2, y, m y. */
typedef struct {
    double period;
    long watched; /* ticks of this flight */
    double sums[JAXHIL_SLOTS][JAXHIL_SUMS];
} jaxhil_onset;

/* What was found: by how many ticks the surface was met before now, the bias [1/s], ln of the evidence, the most
 * that the stiffness may be [1/s^2], by three standard deviations; by how many ticks it was met `earlier` than in the
 * middle of that tick, in the mean, and the variance of that, where it is not expected anywhere. */
typedef struct {
    long age;
    double bias, evidence, stiffness, earlier, variance;
} jaxhil_found;

/* == Definitions == */

/* The first and the last are not tried. */
static const long jaxhil_ages[JAXHIL_AGES + 2] = {0,  1,  2,  3,  4,  5,  6,   8,  11,
                                                  16, 24, 36, 56, 88, 140, 224, 225};
static const double jaxhil_onset_stiffness = 300.0, jaxhil_onset_stiffness_variance = 160000.0;
static const double jaxhil_onset_jump_variance = 36.0;
static const double jaxhil_onset_certain = 9.0;
static const double jaxhil_onset_wait = 0.004; /* s, and a tick, since then: its stiffness shows */
static const long jaxhil_onset_longest = 65536; /* ticks of a flight, up to which the sums are exact enough */
static const long jaxhil_onset_beside = 8; /* steps to both sides of what was found, together its age */
enum { JAXHIL_SQUARINGS = 10 };

static void jaxhil_onset_restart(jaxhil_onset *onset) {
    onset->watched = 0;
    for (int i = 0; i < JAXHIL_SUMS; i++) {
        onset->sums[0][i] = 0.0;
    }
}

/* One reading [1/s] in flight. */
static void jaxhil_onset_take(jaxhil_onset *onset, double force, bool shown) {
    if (onset->watched == jaxhil_onset_longest) {
        jaxhil_onset_restart(onset);
    }
    const double *before = onset->sums[onset->watched % JAXHIL_SLOTS];
    onset->watched++;
    double *now = onset->sums[onset->watched % JAXHIL_SLOTS];
    const double m = (double)onset->watched;
    const double terms[JAXHIL_SUMS] = {1.0, m, m * m, force, m * force};
    for (int i = 0; i < JAXHIL_SUMS; i++) {
        now[i] = before[i] + (shown ? terms[i] : 0.0);
    }
}

/* ln z, of a positive number that is not extreme. */
static double jaxhil_logarithm(double z) {
    for (int i = 0; i < 10; i++) {
        z = sqrt(z);
    }
    return 2048.0 * (z - 1.0) / (z + 1.0);
}

/* (1 + u/n)^-n, n = 2^squarings: exp(-u), and less steep far out. */
static double jaxhil_exponential(double u, int squarings) {
    double value = 1.0 / (1.0 + u / (double)(1L << squarings));
    for (int i = 0; i < squarings; i++) {
        value = value * value;
    }
    return value;
}

/* ln of the evidence for a surface met `age` ticks ago against none; noise and bias of these variances [1/s^2],
 * the surface `rarity` times less likely there than not. */
static double jaxhil_onset_evidence(const jaxhil_onset *onset, long age, double noise, double unknown,
                                    double rarity, jaxhil_found *found) {
    const double period = onset->period;
    const double *now = onset->sums[onset->watched % JAXHIL_SLOTS];
    const double *then = onset->sums[(onset->watched - age) % JAXHIL_SLOTS];
    const double middle = (double)(onset->watched - age) + 0.5;
    const double known = then[0] * unknown + noise;
    const double b = then[3] * unknown / known;
    const double left = unknown * noise / known;
    const double n = now[0] - then[0];
    const double ticks = (now[1] - then[1]) - middle * n;
    const double squares = (now[2] - then[2]) - middle * (2.0 * (now[1] - then[1]) - middle * n);
    const double force = now[3] - then[3];
    const double moment = (now[4] - then[4]) - middle * force;
    const double s = period * ticks;
    const double y = force - b * n;
    const double p = noise / jaxhil_onset_stiffness_variance + period * period * squares;
    const double jump = jaxhil_onset_jump_variance + left;
    const double r = noise / jump + n;
    const double f = noise * (jaxhil_onset_stiffness / jaxhil_onset_stiffness_variance) +
                     (period * moment - b * s);
    const double determinant = p * r - s * s;
    const double explained = (r * f * f - 2.0 * (s * f * y) + p * y * y) / determinant;
    const double silence = noise + n * left;
    const double occam = determinant * (jaxhil_onset_stiffness_variance * jump) / (noise * silence);
    found->bias = b;
    found->stiffness = ((r * f - s * y) + 3.0 * sqrt(r * noise * determinant)) / determinant;
    if (!(y > 0.0 && determinant > 0.0)) {
        return -INFINITY;
    }
    return 0.5 * (explained / noise -
                  jaxhil_onset_stiffness * jaxhil_onset_stiffness / jaxhil_onset_stiffness_variance -
                  y * y * left / (noise * silence) - jaxhil_logarithm(occam * rarity * rarity));
}

/* How much earlier than found the surface was met, by the ticks beside it. */
static void jaxhil_onset_spread(const jaxhil_onset *onset, double noise, double unknown, jaxhil_found *found) {
    jaxhil_found one;
    const double most = jaxhil_onset_evidence(onset, found->age, noise, unknown, 1.0, &one);
    const long step = 1 + found->age / (2 * jaxhil_onset_beside);
    double total = 1.0, mean = 0.0, square = 0.0; /* of what was found */
    for (long i = -jaxhil_onset_beside; i <= jaxhil_onset_beside; i++) {
        const long age = found->age + i * step;
        if (i == 0 || age < 1 || age >= onset->watched || age > jaxhil_ages[JAXHIL_AGES]) {
            continue;
        }
        const double evidence = jaxhil_onset_evidence(onset, age, noise, unknown, 1.0, &one);
        const double weight =
            evidence > -jaxhil_onset_certain ? jaxhil_exponential(most - evidence, JAXHIL_SQUARINGS) : 0.0;
        const double earlier = (double)(i * step);
        total += weight;
        mean += weight * earlier;
        square += weight * (earlier * earlier);
    }
    found->earlier = mean / total;
    found->variance = square / total - found->earlier * found->earlier;
}
