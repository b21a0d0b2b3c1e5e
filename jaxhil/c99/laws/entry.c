/* How well the surface of each hypothesis goes with the readings about the tick in which it was met.
 *
 * Near the entry a map expects f(x) = f_0 + K x at depth x, by its own surface, and has that surface where its preload
 * P is undone, at x = -P/K; of P, what is known of a true preload beforehand counts as one. Where a surface was told,
 * the place is the mean of both by how certain either is. Readings y_i at depths x_1 < x_2 < .. about the tick: if the
 * surface lies between x_(j-1) and x_j, those from j on are f(x_i), those before 0. With L_j their likelihood, a
 * hypothesis is as likely as sum_j L_j P(x_(j-1) < place < x_j). Where none of them has its surface where the readings
 * begin, as behind a lag, all are less likely, by the root of what the best has of the greatest L_j: a root, as the
 * likelihood of all other readings.
 */
#include <math.h>
#include <stdbool.h>

#include "contact_plane.c"
#include "force_depth_map.c"
#include "lagged_onset.c"
#include "onset.c"

/* == Declarations == */

/* Of the readings beside it, the first. Rows of a covariance are even in length: compilers then take two numbers at a
 * time. */
enum { JAXHIL_DENSITY_SQUARINGS = 8, JAXHIL_BESIDE = 10, JAXHIL_COLUMNS = JAXHIL_PARAMETERS + 1 };

/* Where a contact was entered: of the readings beside it the depths beyond where it was met [s], the forces [1/s],
 * their squares over their variance [1/s^2], and that; by how much it may lie elsewhere [s]; the variance of where it
 * was told [s^2]; the spread of the preload by which a map finds its place [1/s], the share of the preload's variance
 * that this makes, and the variance of a true preload [1/s^2]; that of the delays that a hypothesis stands for
 * [s^2]; by how much the wider preload made the readings less likely. */
typedef struct {
    double depths[JAXHIL_BESIDE], forces[JAXHIL_BESIDE], squares[JAXHIL_BESIDE], variance;
    double farthest, known, preload, placed, genuine, between, level;
    int number;
} jaxhil_entry;

/* By one map: the depth [s] of its surface, the spread of that, and how likely a surface is there; the slope [1/s^2]
 * and the jump [1/s] at the entry, their variances, and twice their covariance. */
typedef struct {
    double place, spread, there, slope, jumps, of_slope, of_jumps, of_both;
} jaxhil_entered;

/* == Definitions == */

static const double jaxhil_entry_readings = 4.0;   /* ticks on either side of where the surface was met */
static const double jaxhil_entry_apart = 3.0, jaxhil_entry_beside = 1.5; /* deviations, and ticks, from there at most */
static const double jaxhil_entry_gentlest = 1.0;   /* 1/s^2: what has less of a slope tells of no place */
static const double jaxhil_entry_elsewhere = 9.0;  /* times the variance of where it is expected: it is not there */
static const double jaxhil_entry_unlikely = 0.1;   /* that it is not, at least */
static const double jaxhil_entry_least = 1e-12;    /* of the likelihood of the best: what is ruled out can come back */
static const double jaxhil_entry_close = 0.999;    /* of a square: the root may be the same, but for rounding */
static const double jaxhil_entry_certain = 10.0;   /* deviations from which on Phi is rounded to 1 */

/* Phi, the normal distribution, of which the density is given but for sqrt(2 pi); Mills' ratio as in positive_mean. */
static double jaxhil_cumulative(double ratio, double density) {
    const double size = fabs(ratio);
    const double mills =
        jaxhil_map_pi / ((jaxhil_map_pi - 1.0) * size + sqrt(size * size + 2.0 * jaxhil_map_pi));
    const double beyond = density * mills * (1.0 / sqrt(2.0 * jaxhil_map_pi));
    return ratio > 0.0 ? 1.0 - beyond : beyond;
}

/* exp(-ratio^2/2). */
static double jaxhil_density(double ratio) {
    return jaxhil_exponential(0.5 * (ratio * ratio), JAXHIL_DENSITY_SQUARINGS);
}

/* It is `known` so well where it was told [m^2], what a `genuine` preload may be [1/s^2], the `step` from delay to delay
 * [s]. */
static void jaxhil_entry_of(jaxhil_entry *entry, const jaxhil_meeting *meeting, const jaxhil_window *window,
                            double known, double genuine, double step) {
    const double length = meeting->speed / meeting->pace, tick = meeting->tick;
    const double spread = sqrt(meeting->variance) / length;
    const double ticks = spread / tick * (spread / tick) - 1.0 / 12.0;
    const double farthest = (jaxhil_entry_apart * sqrt(ticks > 0.0 ? ticks : 0.0) + jaxhil_entry_beside) * tick;
    const double most = jaxhil_entry_readings * tick;
    const double near = most < farthest ? most : farthest;
    const double preload = meeting->stiffness * farthest;
    const double square = preload * preload;
    entry->number = 0;
    for (int i = 0; i < window->number && entry->number < JAXHIL_BESIDE; i++) {
        if (-near < window->depths[i] && window->depths[i] < near) {
            entry->depths[entry->number] = window->depths[i];
            entry->forces[entry->number] = window->forces[i];
            entry->squares[entry->number] = window->forces[i] * window->forces[i] / window->variance;
            entry->number++;
        }
    }
    entry->variance = window->variance;
    entry->farthest = farthest;
    entry->known = known / (length * length);
    entry->preload = preload;
    entry->placed = square > 0.0 ? square / (square + genuine) : 1.0;
    entry->genuine = genuine;
    entry->between = step * step / 12.0;
    entry->level = spread > 0.0 ? farthest / (jaxhil_lagged_usual * spread) : 1.0;
}

/* By a map of this mean and covariance, the surface told at a depth [s]. */
static jaxhil_entered jaxhil_entry_place(const jaxhil_entry *entry, double told, const double *estimate,
                                         double (*covariance)[JAXHIL_COLUMNS]) {
    const double *first = covariance[0], *damping = covariance[JAXHIL_DAMPING];
    const double of_preload = covariance[JAXHIL_PRELOAD][JAXHIL_PRELOAD];
    const bool steep = estimate[0] > jaxhil_entry_gentlest;
    const double k = steep ? estimate[0] : 1.0;
    const double undone = -(estimate[JAXHIL_PRELOAD] / k);
    const double square =
        undone * undone * first[0] + 2.0 * (undone * first[JAXHIL_PRELOAD]) + of_preload;
    const double placed = entry->placed;
    const double found = (placed * placed * square + placed * entry->genuine) / (k * k);
    const double variance = found > 0.0 ? found : 0.0;
    const double own = placed * undone;
    const double away = own - told;
    const double both = entry->known + variance;
    const double gone = away * away / both;
    const bool elsewhere = gone > jaxhil_entry_elsewhere;
    const double there =
        jaxhil_exponential(0.5 * gone, JAXHIL_DENSITY_SQUARINGS) * sqrt(entry->known / both);
    const double share = elsewhere ? 0.0 : variance / both;
    const double spread =
        sqrt((elsewhere ? variance : variance * (entry->known / both)) + entry->between);
    jaxhil_entered one;
    one.place = steep ? own - share * away : 0.0;
    one.spread = spread > 0.0 ? spread : 1.0;
    one.there = steep && there > jaxhil_entry_unlikely ? there : jaxhil_entry_unlikely;
    one.slope = estimate[0];
    one.jumps = estimate[JAXHIL_PRELOAD] + estimate[JAXHIL_DAMPING] + estimate[JAXHIL_FRICTION];
    one.of_slope = first[0];
    one.of_jumps = of_preload + damping[JAXHIL_DAMPING] + 2.0 * damping[JAXHIL_PRELOAD];
    one.of_both = 2.0 * (first[JAXHIL_PRELOAD] + first[JAXHIL_DAMPING]);
    return one;
}

/* No farther from where it was met than it may lie. */
static double jaxhil_entry_near(const jaxhil_entry *entry, double place) {
    const double farthest = entry->farthest;
    return place > farthest ? farthest : (place < -farthest ? -farthest : place);
}

/* Met so much `deeper` [s]: ln L_j but for what is sharp, `since` each reading and since none, and the square of that,
 * `known`; the greatest ln L_j and `most`. What is not a number stays. */
static double jaxhil_entry_since(const jaxhil_entry *entry, const jaxhil_entered *one, double deeper, double most,
                                 double *since, double *known) {
    since[entry->number] = 0.0;
    known[entry->number] = 1.0;
    for (int i = entry->number - 1; i >= 0; i--) {
        const double depth = entry->depths[i] + deeper;
        const double uncertain = one->of_jumps + depth * (one->of_both + depth * one->of_slope);
        const double precision = 1.0 / (entry->variance + (uncertain > 0.0 ? uncertain : 0.0));
        const double missed = entry->forces[i] - (one->jumps + one->slope * depth);
        since[i] = since[i + 1] + 0.5 * (entry->squares[i] - missed * missed * precision);
        known[i] = known[i + 1] * (entry->variance * precision);
        most = since[i] > most || since[i] != since[i] ? since[i] : most;
    }
    return most;
}

/* sum_j L_j P(x_(j-1) < place < x_j), in terms of what is the `most` likely; the `greatest` L_j in these terms, so far.
 */
static double jaxhil_entry_began(const jaxhil_entry *entry, const jaxhil_entered *one, double deeper, double most,
                                 const double *since, const double *known, double *greatest) {
    const bool finite = most < INFINITY && entry->variance > 0.0 && entry->variance < INFINITY;
    double total = 0.0, before = 0.0;
    for (int i = 0; i <= entry->number; i++) {
        double below = 1.0;
        if (i < entry->number) {
            const double ratio = (entry->depths[i] + deeper - one->place) / one->spread;
            below = ratio > jaxhil_entry_certain ? 1.0 : jaxhil_cumulative(ratio, jaxhil_density(ratio));
        }
        /* None where the hardware went back; an exponential is not formed where it counts for nothing. */
        const double within = below > before ? below - before : 0.0;
        if (within > 0.0 || known[i] > jaxhil_entry_close * (*greatest * *greatest) || !finite) {
            const double likely = jaxhil_exponential(most - since[i], JAXHIL_SQUARINGS) * sqrt(known[i]);
            total += likely * within;
            *greatest = likely > *greatest || likely != likely ? likely : *greatest;
        }
        before = below;
    }
    return total;
}
