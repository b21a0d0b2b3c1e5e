/* How plausible a damping is: a contact may well have none, and no damping is negative. */
#include <math.h>

#include "force_depth_map.c"
#include "onset.c"

/* == Definitions == */

static const double jaxhil_damping_none = 0.5; /* probability that a contact has none */
enum { JAXHIL_DENSITY_SQUARINGS = 8 };

/* How much better a damping N(mean, variance) goes with one that is 0 or not negative than one N(0, prior) does. */
static double jaxhil_plausible_damping(double mean, double variance, double prior) {
    const double spread = sqrt(variance);
    const double ratio = mean / spread;
    const double density = jaxhil_exponential(0.5 * (ratio * ratio), JAXHIL_DENSITY_SQUARINGS);
    const double size = fabs(ratio);
    const double mills =
        jaxhil_map_pi / ((jaxhil_map_pi - 1.0) * size + sqrt(size * size + 2.0 * jaxhil_map_pi));
    const double beyond = density * mills * (2.0 / sqrt(2.0 * jaxhil_map_pi));
    const double at_least_0 = ratio > 0.0 ? 2.0 - beyond : beyond;
    const double known = sqrt(prior > 0.0 ? prior : 1.0);
    return jaxhil_damping_none * (known / spread) * density + (1.0 - jaxhil_damping_none) * at_least_0;
}
