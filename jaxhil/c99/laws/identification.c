/* Weighted recursive identification of contact stiffness and damping from F = k p + b p'. */
#include <stdbool.h>

/* == Declarations == */

/* Weighted recursive least squares with forgetting, in Bierman's factored form ("Factorization Methods for
 * Discrete Sequential Estimation", 1977): P = U D U', U = [[1, u], [0, 1]], D = diag(d1, d2), where d1 and d2
 * never exceed their initial values. Stiffness in N/m and damping in N s/m, covariance in 1/m^2 and s^2/m^2
 * (relative to the force's variance), forgetting in (0, 1]. */
typedef struct {
    double stiffness, damping;
    double u, d1, d2;
    double initial_stiffness, initial_damping, most1, most2, forgetting;
} jaxhil_identification;

/* == Definitions == */

static void jaxhil_identification_restart_covariance(jaxhil_identification *identification) {
    identification->u = 0.0;
    identification->d1 = identification->most1;
    identification->d2 = identification->most2;
}

static void jaxhil_identification_reset(jaxhil_identification *identification) {
    identification->stiffness = identification->initial_stiffness;
    identification->damping = identification->initial_damping;
    jaxhil_identification_restart_covariance(identification);
}

static void jaxhil_identification_init(jaxhil_identification *identification, double stiffness, double damping,
                                       double stiffness_covariance, double damping_covariance,
                                       double forgetting) {
    identification->initial_stiffness = stiffness;
    identification->initial_damping = damping;
    identification->most1 = stiffness_covariance;
    identification->most2 = damping_covariance;
    identification->forgetting = forgetting;
    jaxhil_identification_reset(identification);
}

/* Take in one reading: force [N], signed deflection [m], its rate [m/s] and its weight. False, with the rest
 * left undone, where a divisor is 0. */
static bool jaxhil_identification_update(jaxhil_identification *identification, double force, double deflection,
                                         double rate, double weight) {
    const double u = identification->u;
    double d1 = identification->d1;
    double d2 = identification->d2;
    const double stiffness = identification->stiffness;
    const double damping = identification->damping;
    const double kept = 1.0 - weight * (1.0 - identification->forgetting);

    const double f2 = u * deflection + rate;
    const double g1 = weight * d1 * deflection;
    const double g2 = weight * d2 * f2;
    const double a1 = kept + deflection * g1;
    const double a2 = a1 + f2 * g2;
    const double innovation = force - (stiffness * deflection + damping * rate);

    if (a2 == 0.0) {
        return false;
    }
    identification->stiffness = stiffness + (g1 + g2 * u) / a2 * innovation;
    identification->damping = damping + g2 / a2 * innovation;
    if (a1 == 0.0) {
        return false;
    }
    identification->u = u - g1 * f2 / a1;
    d1 /= a1;
    if (a2 * kept == 0.0) {
        return false;
    }
    d2 *= a1 / (a2 * kept);
    identification->d1 = d1 < identification->most1 ? d1 : identification->most1;
    identification->d2 = d2 < identification->most2 ? d2 : identification->most2;
    return true;
}
