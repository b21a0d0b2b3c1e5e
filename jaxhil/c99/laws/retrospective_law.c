/* What the retrospective references share: identify the contact, work out what should have happened, pay it back.
 * In contact F_c = f_0 + (y - F(X, V)) + f_e, f_0 = max(F(x_d, v_d), 0), F the force-depth map identified on
 * delay-aligned readings (X, V, y); separated F_c = f_e until the hardware has left the surface for 6 ms, then
 * 0. f_e = clip(c (v_d - T f_0/2 - v_r), -limit p, limit p), v_r the speed of the motion that the contact should
 * have had since its entry, p the peak force that the map predicts. Scaled by approach speed and equivalent mass.
 */
#include <math.h>
#include <stdbool.h>

#include "doubts.c"
#include "filters.c"
#include "gains_table.c"
#include "hardware_samples.c"
#include "reintegration.c"
#include "surfaces.c"

/* == Declarations == */

typedef struct {
    double period, clearance, mass, share, force_noise, dead_zone, floor, velocity_gain, limit, replay, strength;
    double middle, last, side, speed, gone, squares, count, deepest, hardware_deepest, plane, surface;
    jaxhil_delay_line line;
    jaxhil_learnt learnt;
    jaxhil_reference_motion reference;
    jaxhil_hardware_samples hardware;
    jaxhil_doubts doubts;
    long elapsed;
    bool whole, entered, started;
    int status;
    double samples[JAXHIL_IDENTIFICATION_DELAY_SAMPLES];
} jaxhil_law;

/* == Definitions == */

static const double jaxhil_farewell = 0.006;   /* s for which it goes on after the hardware has left */
static const double jaxhil_longest_lag = 0.1;  /* s for which it waits for hardware that is not in contact yet */
static const double jaxhil_seen = 8.0;         /* readings out of contact that show how noisy the force is */
static const double jaxhil_outstanding = 16.0; /* times the noise's variance: what hardly is noise */

/* All but what was learnt of earlier contacts. */
static void jaxhil_law_restart(jaxhil_law *law) {
    law->side = 0.0;
    law->speed = 0.0;
    law->entered = false;
    law->gone = 0.0;
    law->squares = 0.0;
    law->count = 0.0;
    jaxhil_hardware_samples_reset(&law->hardware);
    law->deepest = 0.0;
    law->hardware_deepest = 0.0;
    law->elapsed = 0;
    law->plane = 0.0;
    law->surface = 0.0;
    jaxhil_doubts_restart(&law->doubts);
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
    law->force_noise = gains->force_noise;
    law->dead_zone = gains->dead_zone;
    law->floor = gains->force_noise_floor;
    law->velocity_gain = gains->velocity_gain;
    law->limit = gains->correction_limit;
    law->replay = gains->force_replay;
    law->strength = gains->replay_noise * gains->replay_noise;
    law->middle = 0.0;
    law->last = 0.0;
    jaxhil_doubts_start(&law->doubts, 0.0, 0.0);
    jaxhil_learnt_init(&law->learnt, gains);
    jaxhil_reference_motion_init(&law->reference, period);
    law->hardware.period = period;
    jaxhil_law_restart(law);
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
        jaxhil_doubts_start(&law->doubts, measured - stride, stride);
        law->started = true;
    }
    jaxhil_doubts_move(&law->doubts, measured);
    *position = newest + law->share * (law->middle - newest);
    *velocity = (newest - law->last) / (2.0 * period);
    law->last = law->middle;
    law->middle = newest;
}

/* A reading out of contact: it tells how noisy the force is. */
static void jaxhil_law_take_noise(jaxhil_law *law, double force) {
    law->squares += force * force;
    law->count += 1.0;
}

/* The force's variance [N^2]: the known one, or what readings out of contact show if that is more. */
static double jaxhil_law_noise(const jaxhil_law *law) {
    const double known = law->force_noise * law->force_noise;
    const double seen = law->squares / (law->count > 0.0 ? law->count : 1.0);
    return seen > known ? seen : known;
}

/* A reading [N] out of contact while one is under way: noise, or the hardware, met too early. */
static void jaxhil_law_sort_out(jaxhil_law *law, double force, double depth, double weight) {
    const double least = law->floor * weight;
    const double usual = jaxhil_law_noise(law) + least * least;
    if (!(law->count >= jaxhil_seen && force * force > jaxhil_outstanding * usual)) {
        jaxhil_law_take_noise(law, force);
        return;
    }
    law->doubts.early++;
    if (law->doubts.early == 1) {
        law->surface = -depth;
    }
    if (law->doubts.early > jaxhil_early) {
        law->plane = law->surface;
    }
}

/* f_e [1/s], for the speed of the model in the middle of the next period; `status` judges it. */
static double jaxhil_law_repayment(jaxhil_law *law, const jaxhil_curve *curve, double speed, double deepest,
                                   double zone) {
    const double peak = jaxhil_curve_peak_force(curve);
    const double limit = law->limit * peak;
    const double correction = law->velocity_gain * (speed - law->reference.live.speed);
    law->status = jaxhil_doubts_status(&law->doubts, curve, peak, deepest, jaxhil_learnt_variance(&law->learnt),
                                       zone, law->speed);
    if (!(correction > limit || correction < -limit)) {
        return correction;
    }
    law->status = law->status == JAXHIL_IDENTIFIED ? JAXHIL_SATURATED : law->status;
    return correction > limit ? limit : -limit;
}

/* The command over M v0 [1/s]; whether the numerical model has separated. */
static double jaxhil_law_follow(jaxhil_law *law, bool enters, double x, double v, double given, double depth,
                                double rate, double force, bool hidden, double weight, bool *separated) {
    const double period = law->period;
    const jaxhil_curve *curve = jaxhil_learnt_curve(&law->learnt);
    jaxhil_hardware_samples *hardware = &law->hardware;
    law->elapsed++;
    if (enters) {
        jaxhil_learnt_begin(&law->learnt);
        jaxhil_reference_motion_restart(&law->reference, x);
        jaxhil_hardware_samples_begin(hardware, x, force, !hidden, given - period * rate, rate);
        law->elapsed = 0;
        law->deepest = 0.0;
        law->hardware_deepest = 0.0;
    }
    if (x > law->deepest) {
        law->deepest = x;
    }
    if (depth > law->hardware_deepest) {
        law->hardware_deepest = depth;
    }
    const double deepest = law->hardware_deepest;

    const double zone = law->dead_zone / weight;
    const double square = weight * weight;
    const double noise = square > 0.0 ? jaxhil_law_noise(law) / square : 0.0;
    const double variance = law->floor * law->floor + noise;
    if (depth > 0.0) {
        if (!law->entered) {
            law->entered = true;
            jaxhil_hardware_samples_enter(hardware, depth, rate);
            law->doubts.late = hardware->first + (double)law->elapsed * period;
        }
        if (!hidden) {
            jaxhil_doubts_read(&law->doubts, depth, deepest, force, variance);
        }
    }
    law->reference.shift = jaxhil_learnt_shift(&law->learnt);
    jaxhil_learnt_read(&law->learnt, given, rate, deepest, force, variance, hidden, zone);
    const double expected = jaxhil_curve_force(curve, depth, rate, deepest);
    if (hidden) {
        force = expected > zone ? zone : (expected > 0.0 ? expected : 0.0);
    }
    const double whole = law->strength + noise;
    law->reference.replay = whole > 0.0 ? law->replay * law->strength / whole : 0.0;
    jaxhil_reference_motion_tick(&law->reference, curve);

    double own = jaxhil_curve_force(curve, x, v, law->deepest);
    *separated = x <= 0.0 || (v < 0.0 && own <= 0.0);
    if (!(own > 0.0)) {
        own = 0.0;
    }
    const double correction = jaxhil_law_repayment(law, curve, v - 0.5 * period * own, deepest, zone);
    jaxhil_hardware_samples_take(hardware, &law->reference, law->entered, force, !hidden, given, rate, deepest);
    return *separated ? correction : own + (force - expected) + correction;
}

/* The numerical model is beyond another surface: a contact begins. */
static void jaxhil_law_meet(jaxhil_law *law, double side, double depth, double velocity) {
    const double approach = side * velocity;
    const bool sound = law->mass * approach > 0.0 && fabs(depth) <= 2.0 * law->period * approach;
    law->side = side;
    law->speed = sound ? approach : 0.0;
    law->entered = false;
    law->gone = 0.0;
    law->plane = 0.0;
    jaxhil_doubts_restart(&law->doubts);
}

static double jaxhil_law_step(jaxhil_law *law, double force_measured, double position_desired,
                              double velocity_desired, double position_measured) {
    const double period = law->period;
    const double clearance = law->clearance;
    double position, velocity;
    jaxhil_law_align(law, position_measured, velocity_desired, &position, &velocity);
    const double bent = jaxhil_deflection(position, clearance);
    const double reach = jaxhil_deflection(position_desired, clearance);
    const double now = reach > 0.0 ? 1.0 : (reach < 0.0 ? -1.0 : 0.0);
    const bool enters = now != 0.0 && now != law->side;
    if (enters) {
        jaxhil_law_meet(law, now, reach, velocity_desired);
    }
    const double side = law->side;
    if (side == 0.0) {
        if (bent == 0.0) {
            jaxhil_law_take_noise(law, force_measured);
        }
        law->status = JAXHIL_OUT_OF_CONTACT;
        return 0.0;
    }
    const double speed = law->speed;
    const double scale = speed > 0.0 ? speed : 1.0;
    const double weight = law->mass * scale;
    const double x = (side < 0.0 ? -clearance - position_desired : position_desired) / scale;
    const double v = side * velocity_desired / scale;
    const double given = (side < 0.0 ? -clearance - position : position) / scale + law->plane;
    const double rate = side * velocity / scale;
    const double shifted = given - jaxhil_learnt_shift(&law->learnt) * rate;
    const double depth = shifted >= -jaxhil_map_surface && shifted <= jaxhil_map_surface ? 0.0 : shifted;
    const double zone = law->dead_zone;
    bool hidden = false;
    double force = 0.0;
    if (!(bent * side < 0.0)) {
        hidden = zone > 0.0 && force_measured == 0.0;
        if (force_measured > 0.0) {
            force = side * (force_measured + zone) / weight;
        } else if (force_measured < 0.0) {
            force = side * (force_measured - zone) / weight;
        }
    }
    if (!law->entered && !(speed > 0.0 && depth > 0.0) && bent == 0.0) {
        jaxhil_law_sort_out(law, force_measured, given, weight);
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
        command = jaxhil_law_follow(law, enters, x, v, given, depth, rate, force, hidden, weight,
                                    &separated);
    } else {
        law->status = JAXHIL_UNSURE;
    }
    const double patience = law->entered || !(speed > 0.0) ? jaxhil_farewell : jaxhil_longest_lag;
    if (separated && law->gone * period > patience * (1.0 + 1e-9)) {
        law->side = 0.0;
        law->status = JAXHIL_OUT_OF_CONTACT;
        return 0.0;
    }
    return side * weight * command;
}

#define JAXHIL_LAW_HAS_STATUS
static int jaxhil_law_own_status(const jaxhil_law *law) {
    return law->status;
}

#define JAXHIL_LAW_HAS_RESET
static void jaxhil_law_reset(jaxhil_law *law) {
    jaxhil_law_restart(law);
    jaxhil_learnt_reset(&law->learnt);
}

#define JAXHIL_LAW_HAS_NEXT_CONTACT
static void jaxhil_law_next_contact(jaxhil_law *law) {
    jaxhil_law_restart(law);
}
