/* The retrospective reference: identify the contact, work out what should have happened, and pay it back.
 * In contact F_c = f_0 + (y - F(X, V)) + f_e, f_0 = max(F(x_d, v_d), 0), F the force-depth map identified on
 * delay-aligned readings (X, V, y); separated F_c = f_e until the hardware has left the surface for 6 ms, then
 * 0. f_e = clip(gate [w^2 (x_d - x_r) + 2 z w (v_d - T f_0/2 - v_r)], -limit, limit), (x_r, v_r) the motion
 * that the contact should have had since its entry. Scaled by approach speed and equivalent mass.
 */
#include <math.h>
#include <stdbool.h>

#include "filters.c"
#include "force_depth_map.c"
#include "gains_table.c"
#include "reference_motion.c"
#include "surfaces.c"

/* == Declarations == */

/* What stands behind the last command; unsure: less than half of what the prior leaves open is learnt;
 * saturated: the correction is at its limit. */
enum { JAXHIL_OUT_OF_CONTACT, JAXHIL_IDENTIFIED, JAXHIL_UNSURE, JAXHIL_SATURATED };

typedef struct {
    double period, clearance, mass, share, floor, frequency, ratio, limit;
    jaxhil_delay_line line;
    jaxhil_force_depth_map map;
    jaxhil_reference_motion reference;
    double middle, last, side, speed, gone, squares, count, first, fraction, impulse, moved;
    double sample, sample_depth, sample_speed;
    long offset, ticks;
    bool whole, touched, started;
    int status;
    double samples[JAXHIL_IDENTIFICATION_DELAY_SAMPLES];
} jaxhil_law;

/* == Definitions == */

static const double jaxhil_farewell = 0.006;   /* s for which it goes on after the hardware has left */
static const double jaxhil_longest_lag = 0.1;  /* s for which it waits for hardware that has not touched yet */
static const double jaxhil_sure = 0.5;         /* of the prior's variance that has to be learnt */

static void jaxhil_law_reset(jaxhil_law *law) {
    law->side = 0.0;
    law->speed = 0.0;
    law->touched = false;
    law->gone = 0.0;
    law->squares = 0.0;
    law->count = 0.0;
    law->first = 0.0;
    law->fraction = 0.0;
    law->offset = 0;
    law->ticks = 0;
    law->impulse = 0.0;
    law->moved = 0.0;
    law->sample = 0.0;
    law->sample_depth = 0.0;
    law->sample_speed = 0.0;
    law->started = false;
    law->status = JAXHIL_OUT_OF_CONTACT;
}

static bool jaxhil_law_init(jaxhil_law *law, const jaxhil_gains *gains) {
    const double period = gains->control_period;
    const double delay = gains->identification_delay;
    /* The line delays by a tick less, so that the speed can be a difference about the middle. */
    const bool whole = delay > period;
    law->period = period;
    law->clearance = gains->clearance;
    law->mass = gains->equivalent_mass;
    law->share = whole ? 1.0 : delay / period;
    law->floor = gains->force_noise_floor;
    law->frequency = gains->reference_frequency;
    law->ratio = gains->reference_damping_ratio;
    law->limit = gains->correction_limit;
    law->middle = 0.0;
    law->last = 0.0;
    jaxhil_force_depth_map_init(&law->map, gains->prior_stiffness, gains->prior_stiffness_spread,
                                gains->prior_slope_spread, gains->prior_damping,
                                gains->prior_damping_spread);
    jaxhil_reference_motion_init(&law->reference, gains->force_replay, period);
    jaxhil_law_reset(law);
    law->whole = whole;
    /* The line delays by less than the capacity allows: a delay is refused like that of the other laws. */
    if (!(floor(delay / period + 1e-9) <= (double)(JAXHIL_IDENTIFICATION_DELAY_SAMPLES - 2))) {
        return false;
    }
    return jaxhil_delay_line_init(&law->line, law->samples, JAXHIL_IDENTIFICATION_DELAY_SAMPLES,
                                  whole ? delay - period : 0.0, period);
}

/* Position [m] and velocity [m/s] of the hardware, as old as the force. */
static void jaxhil_law_align(jaxhil_law *law, double measured, double velocity_desired, double *position,
                             double *velocity) {
    const double period = law->period;
    double newest = measured;
    if (law->whole) {
        if (!law->started) {
            jaxhil_delay_line_start(&law->line, law->samples, measured, velocity_desired);
        }
        newest = jaxhil_delay_line_step(&law->line, law->samples, measured);
    }
    if (!law->started) {
        const double stride = period * velocity_desired;
        law->middle = newest - stride;
        law->last = newest - 2.0 * stride;
        law->started = true;
    }
    *position = newest + law->share * (law->middle - newest);
    *velocity = (newest - law->last) / (2.0 * period);
    law->last = law->middle;
    law->middle = newest;
}

/* A reading out of contact, if it is one: it tells how noisy the force is. */
static void jaxhil_law_take_noise(jaxhil_law *law, double force, double bent) {
    if (bent == 0.0) {
        law->squares += force * force;
        law->count += 1.0;
    }
}

/* The hardware's entry: where its samples fall on the reference's grid. */
static void jaxhil_law_touch(jaxhil_law *law, double depth, double rate) {
    const double period = law->period;
    double since = 0.5 * period;
    if (rate > 0.0) {
        since = depth / rate;
        if (!(since <= period)) {
            since = period;
        }
    }
    const double shift = (law->first - since) / period;
    const double whole = floor(shift);
    law->fraction = shift - whole;
    law->offset = -1 - (long)whole;
    law->ticks = 0;
    law->touched = true;
}

/* This tick's sample, moved to the reference's grid, into its history. */
static void jaxhil_law_remember(jaxhil_law *law, double force, double depth, double rate) {
    const double fraction = law->fraction;
    const double moved = law->sample + fraction * (force - law->sample);
    const long index = law->ticks + law->offset;
    law->ticks++;
    if (index == 0) {
        law->impulse = 0.5 * moved * law->first / law->period;
    } else if (index > 0) {
        law->impulse += 0.5 * (law->moved + moved);
    }
    law->moved = moved;
    if (index >= 0) {
        jaxhil_reference_motion_remember(&law->reference, index, law->impulse,
                                         law->sample_depth + fraction * (depth - law->sample_depth),
                                         law->sample_speed + fraction * (rate - law->sample_speed));
    }
}

/* The command over M v0 [1/s]; whether the numerical model has separated. */
static double jaxhil_law_follow(jaxhil_law *law, bool enters, double x, double v, double depth, double rate,
                                double force, double weight, bool *separated) {
    const double period = law->period;
    const jaxhil_map *map = &law->map.now;
    if (enters) {
        jaxhil_force_depth_map_restart(&law->map);
        law->first = x;
        jaxhil_reference_motion_restart(&law->reference, x);
        law->sample = force;
        law->sample_depth = depth - period * rate;
        law->sample_speed = rate;
    }
    if (depth > 0.0) {
        if (!law->touched) {
            jaxhil_law_touch(law, depth, rate);
        }
        const double scale = (law->count > 0.0 ? law->count : 1.0) * (weight * weight);
        const double mean = scale > 0.0 ? law->squares / scale : 0.0;
        jaxhil_force_depth_map_update(&law->map, depth, rate, force, law->floor * law->floor + mean);
    }
    jaxhil_reference_motion_tick(&law->reference, map);

    double own = jaxhil_map_force(map, x, v);
    *separated = x <= 0.0 || (v < 0.0 && own <= 0.0);
    if (!(own > 0.0)) {
        own = 0.0;
    }
    const double frequency = law->frequency;
    const double limit = law->limit;
    const double gate = jaxhil_force_depth_map_learnt(&law->map, x, v);
    double correction = gate * (frequency * frequency * (x - law->reference.live.depth) +
                                2.0 * law->ratio * frequency *
                                    (v - 0.5 * period * own - law->reference.live.speed));
    law->status = gate >= jaxhil_sure ? JAXHIL_IDENTIFIED : JAXHIL_UNSURE;
    if (correction > limit) {
        correction = limit;
        law->status = JAXHIL_SATURATED;
    } else if (correction < -limit) {
        correction = -limit;
        law->status = JAXHIL_SATURATED;
    }
    double command = correction;
    if (!*separated) {
        command = own + (force - jaxhil_map_force(map, depth, rate)) + correction;
    }
    if (law->touched) {
        jaxhil_law_remember(law, force, depth, rate);
    }
    law->sample = force;
    law->sample_depth = depth;
    law->sample_speed = rate;
    return command;
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    const double period = law->period;
    const double clearance = law->clearance;
    double position, velocity;
    jaxhil_law_align(law, position_measured, velocity_desired, &position, &velocity);
    const double bent = jaxhil_deflection(position, clearance);
    const double touching = jaxhil_deflection(position_desired, clearance);
    const double now = touching > 0.0 ? 1.0 : (touching < 0.0 ? -1.0 : 0.0);
    const bool enters = now != 0.0 && now != law->side;
    if (enters) {
        const double approach = now * velocity_desired;
        const bool sound = law->mass * approach > 0.0 && fabs(touching) <= 2.0 * period * approach;
        law->side = now;
        law->speed = sound ? approach : 0.0;
        law->touched = false;
        law->gone = 0.0;
    }
    const double side = law->side;
    if (side == 0.0) {
        jaxhil_law_take_noise(law, force_measured, bent);
        law->status = JAXHIL_OUT_OF_CONTACT;
        return 0.0;
    }
    const double speed = law->speed;
    const double scale = speed > 0.0 ? speed : 1.0;
    const double weight = law->mass * scale;
    const double x = (side < 0.0 ? -clearance - position_desired : position_desired) / scale;
    const double v = side * velocity_desired / scale;
    const double depth = (side < 0.0 ? -clearance - position : position) / scale;
    const double rate = side * velocity / scale;
    const double force = bent * side < 0.0 ? 0.0 : side * force_measured / weight;
    if (!law->touched && !(speed > 0.0 && depth > 0.0)) {
        jaxhil_law_take_noise(law, force_measured, bent);
    }
    if (!enters) {
        law->gone += 1.0;
    }
    if (depth > 0.0) {
        law->gone = 0.0;
    }
    bool separated = x <= 0.0;
    double command = separated ? 0.0 : force;
    if (speed > 0.0) {
        command = jaxhil_law_follow(law, enters, x, v, depth, rate, force, weight, &separated);
    } else {
        law->status = JAXHIL_UNSURE;
    }
    const double patience = law->touched || !(speed > 0.0) ? jaxhil_farewell : jaxhil_longest_lag;
    if (separated && law->gone * period > patience * (1.0 + 1e-9)) {
        law->side = 0.0;
        law->status = JAXHIL_OUT_OF_CONTACT;
        return 0.0;
    }
    return side * weight * command;
}

static double jaxhil_law_position_command(jaxhil_law *law, double position, double velocity,
                                          double acceleration) {
    (void)law, (void)velocity, (void)acceleration;
    return position;
}

static void jaxhil_law_identified(const jaxhil_law *law, double *stiffness, double *damping) {
    (void)law;
    *stiffness = 0.0;
    *damping = 0.0;
}

static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_law_reset(law);
}
