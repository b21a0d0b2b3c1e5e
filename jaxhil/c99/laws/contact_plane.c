/* Where a surface is expected: carried from contact to contact, as each finds it anew. */
#include <math.h>
#include <stdbool.h>

/* == Declarations == */

/* By how much [m] a surface is expected to be deeper than told, and the spread of that. */
typedef struct {
    double place, spread;
} jaxhil_plane;

/* A surface that was met: where it counts as met and, by these readings alone, `place` [m], by the delay that is given,
 * and the variance of that; the speed [m/s] and the pace; a tick on that scale of time [s] and the most that the stiffness
 * may be [1/s^2]. */
typedef struct {
    double plane, place, variance, speed, pace, tick, stiffness;
} jaxhil_meeting;

/* == Definitions == */

static const double jaxhil_plane_late = 0.25;  /* how uncertain the surface is, of the ticks until it was found */
static const double jaxhil_plane_drift = 1e-6; /* m, from contact to contact */
static const double jaxhil_plane_elsewhere = 25.0; /* times the variance of where it is expected */

/* Variance [m^2] of where it is, met so many ticks before that was found, each of this width [m]. */
static double jaxhil_plane_found(double width, long age) {
    const double late = jaxhil_plane_late * (double)age;
    return width * width * (1.0 / 12.0 + late * late);
}

/* It was met between two places [m], with this variance. */
static void jaxhil_plane_learn(jaxhil_plane *plane, double low, double high, double found) {
    const double known = plane->spread * plane->spread;
    const double middle = 0.5 * (low + high);
    const double away = middle - plane->place;
    const bool elsewhere = away * away > jaxhil_plane_elsewhere * (known + found);
    plane->place = elsewhere ? middle : plane->place + away * (known / (known + found));
    plane->spread = sqrt((elsewhere ? found : known * found / (known + found)) +
                         jaxhil_plane_drift * jaxhil_plane_drift);
}
