/* See contact_law.h. */
#include "contact_law.h"

#include <math.h>

static double larger(double value, double other) {
    return value > other ? value : other;
}

bool contact_law_has_memory(void) {
    return RIG_LAW == LAW_ELASTOPLASTIC;
}

contact_law contact_law_of(int number) {
    contact_law law;
    law.number = number < 0 ? 0 : number < RIG_CONTACTS ? number : RIG_CONTACTS - 1;
    law.deepest = 0.0;
    return law;
}

/* Force of a preloaded contact without penetration [N]. */
static double preload(double rate) {
    return RIG_PRELOAD + RIG_FRICTION * ((double)(rate > 0.0) - (double)(rate < 0.0));
}

/* Force of the layers that the penetration has reached [N]. */
static double layers(const double *stiffness, double depth) {
    double start = 0.0, level = 0.0;
    int layer = 0;
    while (layer < RIG_LAYERS - 1 && depth > rig_depths[layer]) {
        level += stiffness[layer] * (rig_depths[layer] - start);
        start = rig_depths[layer];
        layer++;
    }
    return level + stiffness[layer] * (depth - start);
}

/* Force without the limit that the surfaces only push [N]. */
static double spring(const contact_law *law, double depth, double rate) {
    const double *const slopes = rig_stiffness[law->number];
    const double stiffness = slopes[0], damping = rig_damping[law->number];
    const double relative = depth / RIG_REFERENCE_DEPTH;
    switch (RIG_LAW) {
    case LAW_HUNT_CROSSLEY:
        return stiffness * pow(depth, RIG_EXPONENT) * (1.0 + 1.5 * damping * rate);
    case LAW_PIECEWISE_LINEAR:
        return layers(slopes, depth) + damping * rate;
    case LAW_HARDENING:
        return stiffness * depth * (1.0 + relative * relative) + damping * rate;
    case LAW_DEPTH_DAMPED:
        return stiffness * pow(depth, RIG_EXPONENT) + damping * rate * relative;
    case LAW_ELASTOPLASTIC:
        return depth >= law->deepest
                   ? stiffness * depth
                   : stiffness * law->deepest - stiffness * RIG_UNLOADING_RATIO * (law->deepest - depth);
    case LAW_PRELOADED:
        return preload(rate) + stiffness * depth;
    default:
        return stiffness * depth + damping * rate;
    }
}

double contact_law_force(const contact_law *law, double depth, double rate) {
    if (RIG_LAW == LAW_HUNT_CROSSLEY && !(1.0 + 1.5 * rig_damping[law->number] * rate > 0.0)) {
        return 0.0;
    }
    return RIG_TENSION ? spring(law, depth, rate) : larger(spring(law, depth, rate), 0.0);
}

double contact_law_separation_function(const contact_law *law, double depth, double rate) {
    const double damping = rig_damping[law->number];
    switch (RIG_LAW) {
    case LAW_HUNT_CROSSLEY:
        return 1.0 + 1.5 * damping * rate;
    case LAW_DEPTH_DAMPED:
        return rig_stiffness[law->number][0] * pow(larger(depth, 0.0), RIG_EXPONENT - 1.0) +
               damping * rate / RIG_REFERENCE_DEPTH;
    default:
        return RIG_TENSION ? 1.0 : spring(law, depth, rate);
    }
}

double contact_law_onset_force(const contact_law *law, double rate) {
    const double force = rig_damping[law->number] * rate;
    switch (RIG_LAW) {
    case LAW_HUNT_CROSSLEY:
    case LAW_DEPTH_DAMPED:
    case LAW_ELASTOPLASTIC:
        return 0.0;
    case LAW_PRELOADED:
        return larger(preload(rate), 0.0);
    default:
        return RIG_TENSION ? force : larger(force, 0.0);
    }
}
