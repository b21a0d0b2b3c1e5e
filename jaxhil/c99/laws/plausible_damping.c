/* How plausible a damping is: a contact may well have none, and no damping is negative. */
#include <math.h>

#include "entry.c"

/* == Definitions == */

static const double jaxhil_damping_none = 0.35; /* probability that a contact has none */

/* How much better a damping N(mean, variance) goes with one that is 0 or not negative than one N(0, prior) does. */
static double jaxhil_plausible_damping(double mean, double variance, double prior) {
    const double spread = sqrt(variance);
    const double ratio = mean / spread;
    const double density = jaxhil_density(ratio);
    const double known = sqrt(prior > 0.0 ? prior : 1.0);
    return jaxhil_damping_none * (known / spread) * density +
           (1.0 - jaxhil_damping_none) * (2.0 * jaxhil_cumulative(ratio, density));
}
