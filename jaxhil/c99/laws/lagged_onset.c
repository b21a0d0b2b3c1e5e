/* Where a surface was met if the force sensor lags.
 *
 * Since the surface was met, s ago, contact pushes with B + K s; through a sensor that lags by l that is read as
 * B g + K (s - l g), g = 1 - exp(-s/l), and looks as if it were met later. Of a lag, places from l + 3 ticks before where
 * it was met by the readings alone until a tick behind that are tried, with B ~ N(0, 1) and K as the onset has it: the
 * likelihood of the readings has a closed form in five sums over them. Depths in s, forces in 1/s.
 */
#include <math.h>

#include "contact_plane.c"
#include "force_depth_map.c"
#include "history.c"
#include "onset.c"
#include "reintegration.c"

/* == Declarations == */

enum { JAXHIL_WINDOW = 40, JAXHIL_PLACES = 8 }; /* newest readings that count */

/* Readings at depths [s] beyond where the surface was met by them alone, their forces [1/s] and the variance of these
 * [1/s^2]. */
typedef struct {
    double depths[JAXHIL_WINDOW], forces[JAXHIL_WINDOW], variance;
    int number;
} jaxhil_window;

/* == Definitions == */

static const double jaxhil_lagged_before = 3.0, jaxhil_lagged_after = 1.0; /* ticks */
static const double jaxhil_lagged_damping_variance = 1.0;                  /* of B [1/s^2] */
/* Of a map that has its surface elsewhere than where it was met, the preload is as uncertain as this share of the most
 * that the stiffness may be makes it, and the knots are moved by up to `farthest` [s], from the depth `whole` [s] on
 * wholly, before it less: all maps bend at the same places. */
static const double jaxhil_lagged_usual = 0.5, jaxhil_lagged_farthest = 0.004, jaxhil_lagged_whole = 0.015;

/* Where the knots of a map are that are moved by so much [s]. */
static void jaxhil_lagged_knots(double farther, double *knots) {
    for (int j = 0; j < JAXHIL_SEGMENTS; j++) {
        const double share = jaxhil_knots[j] / jaxhil_lagged_whole;
        knots[j] = jaxhil_knots[j] + farther * (share < 1.0 ? share : 1.0);
    }
}

/* The newest readings, of noise with this variance [1/s^2]. */
static void jaxhil_lagged_newest(const jaxhil_meeting *meeting, const jaxhil_history *history,
                                 const jaxhil_scales *scales, double variance, jaxhil_window *window) {
    const long first = history->newest - JAXHIL_WINDOW + 1;
    window->number = 0;
    window->variance = variance;
    for (long tick = first > 0 ? first : 0; tick <= history->newest; tick++) {
        const long slot = tick % JAXHIL_SLOTS;
        if (history->shows[slot]) {
            const double position = jaxhil_history_recall(history, tick)->position;
            const double beyond = jaxhil_scales_beyond(scales, position) - meeting->place;
            window->depths[window->number] = beyond / scales->length;
            window->forces[window->number] = jaxhil_scales_force(scales, history->forces[slot]);
            window->number++;
        }
    }
}

/* Of the readings, met at this place [s], how likely they are: ln of that but for sqrt(determinant). */
static double jaxhil_lagged_evidence(const jaxhil_window *window, double lag, double place, double *determinant) {
    double gg = 0.0, b = 0.0, qq = 0.0, y = 0.0, qy = 0.0;
    for (int i = 0; i < window->number; i++) {
        const double s = window->depths[i] - place;
        if (!(s > 0.0)) {
            continue;
        }
        const double g = 1.0 - jaxhil_exponential(s / lag, JAXHIL_SQUARINGS);
        const double q = s - lag * g;
        const double weighted = g / window->variance, weight = q / window->variance;
        gg += weighted * g;
        b += weighted * q;
        qq += weight * q;
        y += weighted * window->forces[i];
        qy += weight * window->forces[i];
    }
    const double a = 1.0 / jaxhil_lagged_damping_variance + gg;
    const double c = 1.0 / jaxhil_onset_stiffness_variance + qq;
    const double z = jaxhil_onset_stiffness / jaxhil_onset_stiffness_variance + qy;
    *determinant = a * c - b * b;
    return 0.5 * ((c * y * y - 2.0 * (b * y * z) + a * z * z) / *determinant);
}

/* The mean [s] and the variance [s^2] of the place, with a tick [s]. */
static void jaxhil_lagged_onset(const jaxhil_window *window, double lag, double tick, double *mean,
                                double *variance) {
    const double first = lag + jaxhil_lagged_before * tick;
    const double width = first + jaxhil_lagged_after * tick;
    double places[JAXHIL_PLACES], explained[JAXHIL_PLACES], determinant[JAXHIL_PLACES];
    double most = -INFINITY, total = 0.0, once = 0.0, twice = 0.0;
    for (int j = 0; j < JAXHIL_PLACES; j++) {
        places[j] = width * ((double)j / (double)(JAXHIL_PLACES - 1)) - first;
        explained[j] = jaxhil_lagged_evidence(window, lag, places[j], &determinant[j]);
        most = explained[j] > most ? explained[j] : most;
    }
    for (int j = 0; j < JAXHIL_PLACES; j++) {
        const double likely = jaxhil_exponential(most - explained[j], JAXHIL_SQUARINGS) / sqrt(determinant[j]);
        total += likely;
        once += likely * places[j];
        twice += likely * (places[j] * places[j]);
    }
    const double step = width / (double)(JAXHIL_PLACES - 1);
    *mean = once / total;
    *variance = twice / total - *mean * *mean + step * step / 12.0;
}
