/* Virtual contact: spring and damper on the commanded motion, beside the real contact (EPOS):
 * F_c = F + k_v d + b_v v_d while the numerical model's position is beyond a surface, by d; else F.
 */
#include <stdbool.h>

#include "gains_table.c"
#include "surfaces.c"

/* == Declarations == */

typedef struct {
    double stiffness, damping, clearance;
} jaxhil_law;

/* == Definitions == */

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    law->stiffness = gains->virtual_stiffness;
    law->damping = gains->virtual_damping;
    law->clearance = gains->clearance;
    return true;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    (void)position_measured;
    const double depth = jaxhil_deflection(position_desired, law->clearance);
    if (depth == 0.0) {
        return force_measured;
    }
    return force_measured + (law->stiffness * depth + law->damping * velocity_desired);
}
