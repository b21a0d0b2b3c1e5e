/* Whether the force rises at the onset as a damper's jump that the sensor smooths.
 *
 * A damped contact's force is B + K s since the onset, s ago; through a sensor that lags by l it is read as
 * I (1 - exp(-s/l)) + K s, with I = B - K l. The onset may lie at several places p around where the surface was met.
 * Of each lag and place I ~ N(0, s_I^2) and K ~ N(K_0, s_K^2), and the likelihood of the readings on the way in has a
 * closed form in five sums over them. Without a lag I may have either sign, as where contact begins softly; only a jump,
 * I > 0, speaks for a lag. The odds for one are those of the sum over the places, and of the contacts before. Where I is
 * next to nothing nobody can tell: the force of a damper B = K l is read as that of contact without one.
 */
#include <math.h>
#include <stdbool.h>

#include "onset.c"

/* == Declarations == */

enum { JAXHIL_LAGS = 3, JAXHIL_PLACES = 11, JAXHIL_JUMPS = JAXHIL_LAGS * JAXHIL_PLACES };

/* Of each lag and place both [s]; weighted sums over the readings beyond the place: of g^2, g s, s^2, g y, s y, with
 * g = 1 - exp(-s/l). Of each lag its likelihood in this contact and in those before; the odds for a lag; whether the
 * readings on the way in are over. */
typedef struct {
    double lag[JAXHIL_JUMPS], place[JAXHIL_JUMPS];
    double jumps[JAXHIL_JUMPS], mixed[JAXHIL_JUMPS], squares[JAXHIL_JUMPS];
    double force[JAXHIL_JUMPS], moment[JAXHIL_JUMPS];
    double likelihood[JAXHIL_LAGS], carried[JAXHIL_LAGS], odds;
    bool over;
} jaxhil_jump;

/* == Definitions == */

static const double jaxhil_jump_lags[JAXHIL_LAGS] = {0.0, 0.001, 0.003}; /* s */
static const double jaxhil_jump_step = 0.0005; /* s from place to place, at least a tick */
static const int jaxhil_jump_first = -6;       /* of the places, in steps */
static const double jaxhil_jump_way = 0.012;   /* s of depth whose readings count */
static const double jaxhil_jump_variance = 4.0;
static const double jaxhil_jump_least = 1e-6; /* of a likelihood: what one contact rules out, others may show */
static const double jaxhil_jump_certain = 20.0;

static void jaxhil_jump_reset(jaxhil_jump *jump) {
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        jump->likelihood[l] = 1.0;
        jump->carried[l] = 1.0;
    }
    jump->odds = 0.0;
    jump->over = true;
}

/* Another contact, with a tick [s] of its own scale of time, slower by `pace`. */
static void jaxhil_jump_begin(jaxhil_jump *jump, double tick, double pace) {
    const double least = jaxhil_jump_step * pace;
    const double step = tick > least ? tick : least;
    double best = 0.0;
    for (int h = 0; h < JAXHIL_JUMPS; h++) {
        jump->lag[h] = jaxhil_jump_lags[h / JAXHIL_PLACES] * pace;
        jump->place[h] = (double)(jaxhil_jump_first + h % JAXHIL_PLACES) * step;
        jump->jumps[h] = 1.0 / jaxhil_jump_variance;
        jump->mixed[h] = 0.0;
        jump->squares[h] = 1.0 / jaxhil_onset_stiffness_variance;
        jump->force[h] = 0.0;
        jump->moment[h] = jaxhil_onset_stiffness / jaxhil_onset_stiffness_variance;
    }
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        jump->carried[l] *= jump->likelihood[l];
        jump->likelihood[l] = 1.0;
        best = jump->carried[l] > best ? jump->carried[l] : best;
    }
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        const double share = jump->carried[l] / best;
        jump->carried[l] = share > jaxhil_jump_least ? share : jaxhil_jump_least;
    }
    jump->over = false;
}

/* The likelihood of each lag by all readings so far, and the odds. */
static void jaxhil_jump_weigh(jaxhil_jump *jump) {
    double determinant[JAXHIL_JUMPS], explained[JAXHIL_JUMPS];
    bool possible[JAXHIL_JUMPS];
    double most = -INFINITY;
    for (int h = 0; h < JAXHIL_JUMPS; h++) {
        const double a = jump->jumps[h], b = jump->mixed[h], c = jump->squares[h];
        const double y = jump->force[h], z = jump->moment[h];
        determinant[h] = a * c - b * b;
        explained[h] = 0.5 * ((c * y * y - 2.0 * (b * y * z) + a * z * z) / determinant[h]);
        possible[h] = h < JAXHIL_PLACES || c * y - b * z > 0.0;
        if (possible[h] && explained[h] > most) {
            most = explained[h];
        }
    }
    double other = 0.0;
    for (int l = 0; l < JAXHIL_LAGS; l++) {
        double total = 0.0;
        for (int h = l * JAXHIL_PLACES; h < (l + 1) * JAXHIL_PLACES; h++) {
            const double likely = jaxhil_exponential(most - explained[h], JAXHIL_SQUARINGS);
            total += possible[h] ? likely / sqrt(determinant[h]) : 0.0;
        }
        jump->likelihood[l] = total;
        other += l > 0 ? total * jump->carried[l] : 0.0;
    }
    jump->odds = other / ((double)(JAXHIL_LAGS - 1) * (jump->likelihood[0] * jump->carried[0]));
}

/* A reading: depth [s], speed, force [1/s], its variance [1/s^2]. */
static void jaxhil_jump_take(jaxhil_jump *jump, double depth, double rate, double force, double variance) {
    jump->over = jump->over || !(rate > 0.0) || depth > jaxhil_jump_way;
    if (jump->over) {
        return;
    }
    for (int h = 0; h < JAXHIL_JUMPS; h++) {
        const double s = depth - jump->place[h];
        if (!(s > 0.0)) {
            continue;
        }
        const bool lags = jump->lag[h] > 0.0;
        const double g = lags ? 1.0 - jaxhil_exponential(s / jump->lag[h], JAXHIL_SQUARINGS) : 1.0;
        const double weighted = g / variance;
        const double weight = s / variance;
        jump->jumps[h] += weighted * g;
        jump->mixed[h] += weighted * s;
        jump->squares[h] += weight * s;
        jump->force[h] += weighted * force;
        jump->moment[h] += weight * force;
    }
    jaxhil_jump_weigh(jump);
}

/* Whether the odds say so. */
static bool jaxhil_jump_smoothed(const jaxhil_jump *jump) {
    return jump->odds > jaxhil_jump_certain;
}
